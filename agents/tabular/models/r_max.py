"""R-max."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, ClassVar

import numpy as np

from agents.common.setting_checks import check_above_zero, check_finite, check_whole, settings_of
from agents.tabular.models.counted_models import (
    CountedModel,
    count_outcome,
    note_known_state,
    replan,
)
from agents.tabular.models.model_keeping import ModelKeeper
from agents.tabular.models.model_policy import ModelPolicy
from agents.tabular.optimistic_algorithm import OptimisticAlgorithm
from agents.tabular.temporal_difference import TabularAgent
from agents.tabular.value_tables import best_value
from machine_code.compiling import inlined


@inlined
def learn_and_replan(agent: TabularAgent, envs: Any, progress: Any) -> None:
    """For each environment, in order: count its step, and plan if that makes its pair known."""
    model, total_error = agent.memory, 0.0
    for i in range(len(envs)):
        env = envs[i]
        following = 0.0 if env.terminated else best_value(agent.tables, env.next_obs, agent.room)
        target = env.reward + agent.settings.gamma * following
        total_error += abs(target - agent.tables.values[0, env.obs, env.action])
        agent.tables.visit_counts[0, env.obs, env.action] += 1
        if model.counts[env.obs, env.action] < model.tallies.shape[2]:
            count_outcome(model, env)
            if model.counts[env.obs, env.action] == model.tallies.shape[2]:
                note_known_state(model, env.obs)
                replan(agent)
        env.obs = env.new_obs
    progress.mean_td_error = total_error / len(envs)


class CountedModelPolicy(ModelPolicy):
    """The policy of R-max."""

    model_type: ClassVar[Any] = CountedModel

    def _nothing_learnt(self, n_states: int, n_actions: int, n: int) -> dict[str, Any]:
        arrays = super()._nothing_learnt(n_states, n_actions, n)
        del arrays["pairs"], arrays["n_pairs"]
        return {
            **arrays,
            "tallies": np.zeros((n_states, n_actions, n), dtype=np.int64),
            "states": np.zeros(n_states, dtype=np.int64),
            "n_states": np.zeros(1, dtype=np.int64),
        }

    def _places(self, n_states: int, n_pairs: int) -> Mapping[str, tuple[int, int]]:
        most = self.outcomes_kept + 1
        limits = {"states": (0, n_states), "n_states": (0, n_states + 1)}
        return {"next_obs": (0, n_states), "counts": (0, most), "tallies": (0, most), **limits}

    def check_places(self) -> None:
        """Refuse a model that points beside its tables, or whose counts are none.

        Raises:
            ValueError: saying what is wrong.
        """
        super().check_places()
        if not np.array_equal(self.model.tallies.sum(axis=2), self.model.counts):
            raise ValueError("holds no counts: model_tallies and model_counts disagree")


class RMax(ModelKeeper, OptimisticAlgorithm):
    """R-max (Brafman and Tennenholtz, 2002): what is not known is as good as can be.

    A pair of state and action is known once it was tried ``known_after`` times; from then on its
    outcomes are taken to be what was seen, and no longer counted. Pairs that are not known are
    worth ``value_bound`` (in the paper they lead to a state that earns the most for ever). Whenever
    a pair becomes known, the optimum of that model is worked out anew, by sweeps over the states in
    which something is known. The agent does what is best in it, and so either earns nearly the most
    that can be earned, or comes to what it does not know.

    With enough tries it is probably approximately correct: of rewards in [0, 1], with probability
    1 - p, it does worse than within epsilon of the best on at most
    O(S^2 A / (epsilon^3 (1 - gamma)^6)) steps, up to logarithms (Strehl, Li and Littman,
    "Reinforcement learning in finite MDPs: PAC analysis", 2009; Kakade, 2003). The ``known_after``
    of that proof, in the order of S / (epsilon^2 (1 - gamma)^4), is far more than what serves here.
    Where nothing is random, one try is enough.

    Planning takes the longer the closer ``gamma`` is to 1, and is done once for each pair.

    Args:
        args: as in `OptimisticAlgorithm`.
        known_after: m, the number of tries after which a pair is known.
        tolerance: how far values may be from the optimum of the model.
        kwargs: as in `OptimisticAlgorithm`.

    Raises:
        ValueError: as `OptimisticAlgorithm`, and if ``gamma`` is 1.
    """

    policy_aliases = {"QTablePolicy": CountedModelPolicy}  # noqa: RUF012
    parameters = {"tolerance": np.float64}  # noqa: RUF012
    learn_from_step = learn_and_replan

    def __init__(
        self, *args: Any, known_after: int = 10, tolerance: float = 1e-4, **kwargs: Any
    ) -> None:
        self.known_after = known_after
        self.tolerance = tolerance
        super().__init__(*args, **kwargs)

    def _check_arguments(self) -> None:
        super()._check_arguments()
        if self.gamma == 1:
            raise ValueError("gamma must be below 1, so that planning comes to an end")
        check_whole(1, settings_of(self, "known_after"))
        check_above_zero(settings_of(self, "tolerance"))
        check_finite(settings_of(self, "tolerance"))

    @property
    def outcomes_kept(self) -> int:  # type: ignore[override]
        """Room for as many outcomes as a pair can have had."""
        return self.known_after
