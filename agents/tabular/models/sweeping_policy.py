"""The policy of prioritised sweeping, whose model file holds what it was about to update."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, ClassVar

import numpy as np

from agents.tabular.models.model_policy import ModelPolicy
from agents.tabular.models.sweeping_model import NONE, SweepingModel


class SweepingPolicy(ModelPolicy):
    """Greedy in a table, with a `SweepingModel` beside it."""

    model_type: ClassVar[Any] = SweepingModel

    def _nothing_learnt(self, n_states: int, n_actions: int, n: int) -> dict[str, Any]:
        arrays = super()._nothing_learnt(n_states, n_actions, n)
        del arrays["pairs"], arrays["n_pairs"]
        n_pairs = n_states * n_actions
        none = {"first_into": n_states, "behind": n_pairs, "before": n_pairs, "place": n_pairs}
        return {
            **arrays,
            **{name: np.full(size, NONE, dtype=np.int64) for name, size in none.items()},
            "queue": np.zeros(n_pairs, dtype=np.int64),
            "n_queued": np.zeros(1, dtype=np.int64),
            "urgency": np.zeros(n_pairs),
        }

    def _places(self, n_states: int, n_pairs: int) -> Mapping[str, tuple[int, int]]:
        places = super()._places(n_states, n_pairs)
        links = dict.fromkeys(("first_into", "behind", "before"), (NONE, n_pairs))
        return {
            **{name: places[name] for name in ("next_obs", "counts")},
            **links,
            "queue": (0, n_pairs),
            "n_queued": (0, n_pairs + 1),
            "place": (NONE, n_pairs),
        }

    def check_places(self) -> None:
        """Refuse a model that points beside its tables, or whose lists and queue are none.

        Raises:
            ValueError: saying what is wrong.
        """
        super().check_places()
        if not _is_queue(self.model):
            raise ValueError("holds no queue: model_queue and model_place disagree")
        if not _are_lists(self.model):
            raise ValueError(
                "holds no lists of what leads to a state: model_behind and model_before"
            )


def _is_queue(model: SweepingModel) -> bool:
    """Whether each pair in the queue has its place there, and the others have none."""
    queued = model.queue[: int(model.n_queued[0])]
    places = np.full(len(model.queue), NONE)
    places[queued] = np.arange(len(queued))
    return np.array_equal(places, model.place) and len(np.unique(queued)) == len(queued)


def _are_lists(model: SweepingModel) -> bool:
    """Whether each list is of the pairs that lead to its state, and comes to an end.

    That it ends follows from each pair's having one before it, but for the first.
    """
    leads = ((model.counts > 0) & ~model.terminated[..., 0]).ravel()
    goal = np.where(leads, model.next_obs.ravel(), NONE)
    pairs = np.flatnonzero(leads)
    before, behind = model.before[pairs], model.behind[pairs]
    is_first, is_last = before == NONE, behind == NONE
    firsts = model.first_into[goal[pairs]]
    inner, rest = pairs[~is_first], pairs[~is_last]
    n_lists = len(np.unique(goal[pairs]))
    return bool(
        (firsts[is_first] == pairs[is_first]).all()
        and (model.behind[before[~is_first]] == inner).all()
        and (model.before[behind[~is_last]] == rest).all()
        and (goal[behind[~is_last]] == goal[rest]).all()
        and is_first.sum() == n_lists == (model.first_into != NONE).sum()
    )
