"""Spaces of settings to search: read from files, asked by Optuna, and back from settings.

``search_spaces/ALGO.yml`` maps environment ids to ranges and choices, see
`docs/search-spaces.md`. What an environment's entry says replaces what ``default`` says of the same
name; null takes it out.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

from pipeline.errors import UserError, shown
from pipeline.settings.hyperparams import override
from pipeline.settings.yaml import read_yaml
from tuning.dimensions import LEFT_OUT, Pick, same
from tuning.flat_settings import flat_items, nested, with_mappings
from tuning.number_ranges import spread
from tuning.space_checks import check_against_agent, defaults_of
from tuning.space_entries import Conditional, check_names, check_order, read_conditional

if TYPE_CHECKING:
    from optuna.distributions import BaseDistribution
    from optuna.trial import BaseTrial

# Of a range; so many that hardly any whole numbers are as far apart.
_PARTS = 98

_FOLDER = Path(__file__).resolve().parents[1] / "search_spaces"


@dataclass(frozen=True)
class SearchSpace:
    """What a search chooses for one agent on one environment.

    Attributes:
        entries: dimensions and their conditions by name, in the order in which they are asked.
        defaults: what a setting is where none is said; those not named are just left out.
        widened: names of the dimensions that `including` made wider.
    """

    entries: Mapping[str, Conditional]
    defaults: Mapping[str, Any]
    widened: tuple[str, ...] = ()

    @property
    def keys(self) -> tuple[str, ...]:
        """The settings that the space decides, inner ones dotted: ``policy_kwargs.net_arch``."""
        dimensions = (entry.dimension for entry in self.entries.values())
        return tuple(dict.fromkeys(key for dimension in dimensions for key in dimension.keys))

    def suggest(self, trial: BaseTrial) -> dict[str, Any]:
        """Settings in the form of hyperparameter files, to be put into an entry by `merged`.

        Args:
            trial: of Optuna; a FixedTrial does too. Only what exists under what was chosen before
                is asked for.
        """
        return nested(self._chosen(lambda name, ends: _ask(trial, name, ends)))

    def at(self, params: Mapping[str, Any]) -> dict[str, Any]:
        """The settings under parameters, of which there may be more than those that exist."""
        return nested(self._chosen(lambda name, _: params[name]))

    def _chosen(self, pick: Pick) -> dict[str, Any]:
        """Flat settings."""
        words: dict[str, Any] = {}

        def noting(name: str, ends: BaseDistribution) -> Any:
            words[name] = pick(name, ends)
            return words[name]

        chosen: dict[str, Any] = {}
        for entry in self.entries.values():
            if _is_there(entry, words):
                chosen.update(entry.dimension.settings(noting))
        return chosen

    def distributions(self) -> dict[str, BaseDistribution]:
        """All of Optuna's parameters, those that exist under a condition too."""
        found: dict[str, BaseDistribution] = {}
        for entry in self.entries.values():
            found.update(entry.dimension.distributions())
        return found

    def grid(self, n: int) -> dict[str, list[Any]]:
        """Values for Optuna's GridSampler: all words, and at most ``n`` of each number."""
        found: dict[str, list[Any]] = {}
        for entry in self.entries.values():
            found.update(entry.dimension.grid(n))
        return found

    def params_of(self, settings: Mapping[str, Any]) -> dict[str, Any]:
        """The parameters that make `suggest` say these settings, for ``study.enqueue_trial``.

        Args:
            settings: an entry of hyperparameters. What it leaves out is at its default.

        Raises:
            UserError: if they lie outside of the space, see `including`.
        """
        flat = self._flat(settings)
        params: dict[str, Any] = {}
        for entry in self.entries.values():
            if not _is_there(entry, params):
                continue
            try:
                params.update(entry.dimension.params_of(flat))
            except LookupError as error:
                name = entry.dimension.name
                raise UserError(
                    f"{name}: the search space does not hold {shown(flat.get(name))}"
                ) from error
        return params

    def including(self, settings: Mapping[str, Any]) -> SearchSpace:
        """The space, as much wider as it takes to hold these settings; see ``widened``."""
        flat = self._flat(settings)
        params: dict[str, Any] = {}
        entries, widened = {}, []
        for name, entry in self.entries.items():
            wider = entry
            if _is_there(entry, params):
                wider = replace(entry, dimension=entry.dimension.including(flat))
                params.update(wider.dimension.params_of(flat))
            if wider != entry:
                widened.append(name)
            entries[name] = wider
        return replace(self, entries=entries, widened=(*self.widened, *widened))

    def merged(self, shipped: Mapping[str, Any], settings: Mapping[str, Any]) -> dict[str, Any]:
        """An entry of hyperparameters with chosen settings in it.

        What the space decides and the settings do not hold is taken out: it exists under
        conditions that are not met.

        Args:
            shipped: the entry before.
            settings: what `suggest` returned.
        """
        kept = with_mappings(shipped, self.keys)
        for key in self.keys:
            outer, _, inner = key.partition(".")
            if inner and isinstance(kept.get(outer), dict):
                kept[outer] = {k: v for k, v in kept[outer].items() if k != inner}
            elif not inner:
                kept.pop(outer, None)
        changes = {
            key: {**kept[key], **value}
            if isinstance(value, dict) and isinstance(kept.get(key), dict)
            else value
            for key, value in settings.items()
        }
        return {key: value for key, value in override(kept, changes).items() if value != {}}

    def _flat(self, settings: Mapping[str, Any]) -> dict[str, Any]:
        given = dict(flat_items(with_mappings(settings, self.keys), self.keys))
        return {
            key: self.defaults.get(key, LEFT_OUT) if value is LEFT_OUT else value
            for key, value in given.items()
        }


def read_search_space(algo: str, env_id: str, path: Path | str | None = None) -> SearchSpace:
    """Read what a search chooses for an agent on an environment.

    Args:
        algo: the agent, whose file is ``search_spaces/<algo>.yml``.
        env_id: the environment; of ``envs:Warehouse-v0`` the part after the colon counts.
        path: another file to read.

    Raises:
        UserError: if the file cannot be read, is not of this format, says nothing to search, or
            chooses what the agent does not take.
    """
    path = _FOLDER / f"{algo}.yml" if path is None else Path(path)
    if not path.is_file():
        raise UserError(f"{path}: there is no such file: name one with --search-space FILE")
    where, said = _entry(path, env_id.partition(":")[2] or env_id)
    entries = {name: read_conditional(name, value, where) for name, value in said.items()}
    if not entries:
        raise UserError(f"{where}: there is nothing to search for {algo}")
    check_names(entries, where)
    check_order(entries, where)
    space = SearchSpace(entries, {})
    space = replace(space, defaults=defaults_of(algo, space.keys))
    check_against_agent(algo, corners(space), where)
    _check_between(algo, space, where)
    return space


def _check_between(algo: str, space: SearchSpace, where: str) -> None:
    """Make sure that an agent takes what lies between the ends of ranges, too.

    Raises:
        UserError: where it needs whole numbers, and the ends are not written as such.
    """
    from optuna.distributions import FloatDistribution

    for name, kind in space.distributions().items():
        if isinstance(kind, FloatDistribution):
            between = _with_one(space, _ends(space)[0], name, spread(kind, _PARTS)[1])
            try:
                check_against_agent(algo, [between], where)
            except UserError as error:
                raise UserError(f"{error}: write low and high without a point") from error


def _entry(path: Path, env_id: str) -> tuple[str, dict[str, Any]]:
    """Where an environment's entry stands, and what it says together with the default."""
    file = read_yaml(path)
    for name, entry in file.items() if isinstance(file, dict) else [("", None)]:
        is_entry = isinstance(entry, dict) and all(isinstance(key, str) for key in entry)
        if not (isinstance(name, str) and (is_entry or entry is None)) or not name:
            raise UserError(
                f"{path}: must map environment ids to names of settings and their ranges"
            )
    own = (file.get(env_id) or {}) if env_id in file else {}
    if env_id not in file and "default" not in file:
        raise UserError(f"{path}: no entry for {shown(env_id)}, and no default")
    both = {**(file.get("default") or {}), **own}
    where = f"{path}: {env_id if env_id in file else 'default'}"
    return where, {name: value for name, value in both.items() if value is not None}


def corners(space: SearchSpace) -> Iterator[dict[str, Any]]:
    """Settings at the ends of the space: all low, all high, and each end and word by itself."""
    lowest, highest = _ends(space)
    yield space.at(lowest)
    yield space.at(highest)
    yield from steps_aside(space, lowest)


def steps_aside(space: SearchSpace, params: Mapping[str, Any]) -> Iterator[dict[str, Any]]:
    """Settings that differ from those under the parameters by one end or word."""
    base = {**_ends(space)[0], **params}  # with those that exist under other conditions
    for changed, values in space.grid(2).items():
        for value in values:
            yield _with_one(space, base, changed, value)


def _ends(space: SearchSpace) -> tuple[dict[str, Any], dict[str, Any]]:
    """The lowest and the highest parameters."""
    grid = space.grid(2)
    return {name: v[0] for name, v in grid.items()}, {name: v[-1] for name, v in grid.items()}


def _with_one(
    space: SearchSpace, params: Mapping[str, Any], changed: str, value: Any
) -> dict[str, Any]:
    """Settings under the parameters but for one, with the words under which that one is there."""
    return space.at({**params, **_needed(space, changed), changed: value})


def _needed(space: SearchSpace, param: str) -> dict[str, Any]:
    """The words of other choices under which a parameter is there."""
    needed: dict[str, Any] = {}
    open_names = [name for name, e in space.entries.items() if param in e.dimension.distributions()]
    while open_names:
        for other, words in space.entries[open_names.pop()].when.items():
            needed[other] = words[0]
            open_names.append(other)
    return needed


def _is_there(entry: Conditional, chosen: Mapping[str, Any]) -> bool:
    return all(
        other in chosen and any(same(chosen[other], word) for word in words)
        for other, words in entry.when.items()
    )


def _ask(trial: BaseTrial, name: str, distribution: BaseDistribution) -> Any:
    from optuna.distributions import CategoricalDistribution, FloatDistribution, IntDistribution

    match distribution:
        case FloatDistribution():
            low, high = distribution.low, distribution.high
            return trial.suggest_float(name, low, high, log=distribution.log)
        case IntDistribution():
            low, high = distribution.low, distribution.high
            return trial.suggest_int(name, low, high, log=distribution.log)
        case CategoricalDistribution():
            return trial.suggest_categorical(name, distribution.choices)
    raise TypeError(distribution)
