"""The study of Optuna's that a tuning is: opened, and held to what it was begun with."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any

from pipeline.errors import UserError, shown
from tuning.trial_queue import turn

if TYPE_CHECKING:
    from optuna import Study
    from optuna.samplers import BaseSampler
    from optuna.storages import BaseStorage

ASKED = "asked"
SPACE = "search_space"
_MOST_NAMED = 3


def open_study(
    name: str,
    root: Path,
    storage: BaseStorage,
    sampler: BaseSampler,
    asked: Mapping[str, Any],
    *,
    is_cost: bool,
) -> Study:
    """The study of that name, a new one where there is none.

    Args:
        name: of the study.
        root: the folder of the tuning.
        storage: where it is kept.
        sampler: what suggests settings.
        asked: what makes it this tuning and no other, as JSON.
        is_cost: whether the lower value is the better.

    Raises:
        UserError: if there is one that was asked for something else.
    """
    import optuna

    optuna.logging.set_verbosity(optuna.logging.ERROR)
    with turn(root):
        study = optuna.create_study(
            study_name=name,
            storage=storage,
            sampler=sampler,
            pruner=optuna.pruners.NopPruner(),  # what is hopeless is said by `tuning.pruning`
            direction="minimize" if is_cost else "maximize",
            load_if_exists=True,
        )
        before = study.user_attrs.get(ASKED)
        if before is None:
            study.set_user_attr(ASKED, dict(asked))
        elif before != asked:
            raise UserError(_difference(name, before, asked))
    return study


def _difference(name: str, before: Any, asked: Mapping[str, Any]) -> str:
    there, now = _flat(before), _flat(asked)
    named = [
        # Distributions as JSON are no reading matter.
        key
        if key.startswith(SPACE)
        else f"{key}: {shown(there.get(key))} there, {shown(now.get(key))} now"
        for key in {**there, **now}
        if there.get(key) != now.get(key)
    ]
    words = "; ".join(named[:_MOST_NAMED])
    words += f"; and {len(named) - _MOST_NAMED} more" if len(named) > _MOST_NAMED else ""
    return f"{name}: the tuning there is another ({words}): --name NAME makes one of its own"


def _flat(asked: object) -> dict[str, Any]:
    """Settings as they are called, hyperparameters and parts of the space among them."""
    flat: dict[str, Any] = {}
    for key, value in asked.items() if isinstance(asked, Mapping) else ():
        if isinstance(value, Mapping):
            flat |= {f"{key} {inner}": item for inner, item in value.items()}
        else:
            flat[key] = value
    return flat
