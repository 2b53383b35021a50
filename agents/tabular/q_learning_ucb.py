"""Q-learning with upper confidence bounds."""

from __future__ import annotations

import math
from typing import Any

import numpy as np

from agents.common.setting_checks import check_at_least, check_finite, settings_of
from agents.tabular.optimistic_algorithm import OptimisticAlgorithm
from agents.tabular.temporal_difference import TabularAgent
from agents.tabular.value_tables import best_value
from machine_code.compiling import inlined


@inlined
def optimistic_update(agent: TabularAgent, env: Any) -> float:
    """Move one entry towards its target and a bonus for what is seldom tried; its TD error."""
    settings, tables = agent.settings, agent.tables
    tables.visit_counts[0, env.obs, env.action] += 1
    count = tables.visit_counts[0, env.obs, env.action]
    target = env.reward + settings.bonus_scale / math.sqrt(count)
    if not env.terminated:
        best = best_value(tables, env.next_obs, agent.room)
        target += settings.gamma * min(best, settings.highest_worth)
    size = (settings.steps_remembered + 1.0) / (settings.steps_remembered + count)
    td_error = target - tables.values[0, env.obs, env.action]
    tables.values[0, env.obs, env.action] += size * td_error
    return float(td_error)


@inlined
def learn_with_bonus(agent: TabularAgent, envs: Any, progress: Any) -> None:
    """An update for each environment, in order."""
    total_error = 0.0
    for i in range(len(envs)):
        total_error += abs(optimistic_update(agent, envs[i]))
        envs[i].obs = envs[i].new_obs
    progress.mean_td_error = total_error / len(envs)


class QLearningUCB(OptimisticAlgorithm):
    """Q-learning with a bonus of ``bonus_scale`` / sqrt(N) in the target of a pair's N-th update.

    As Jin and others have it ("Is Q-learning provably efficient?", 2018), next states count for
    ``value_bound`` at most, and step sizes are (H + 1) / (H + N). As in Dong and others
    ("Q-learning with UCB exploration is sample efficient for infinite-horizon MDP", 2020), it
    discounts and has one table for all times. They prove that for rewards in [0, 1], with
    probability 1 - p, the policy is within epsilon of the best on all steps but
    O(S A / (epsilon^2 (1 - gamma)^7)), up to logarithms: with a scale of
    c sqrt(H ln(S A (N + 1) (N + 2) / p)) / (1 - gamma), which is far more than what serves here,
    and with values that never rise again. For this agent nothing is proven; what it keeps is why
    that works: a pair looks better than it is until it was tried often, and so does all that leads
    there.

    Args:
        args: as in `OptimisticAlgorithm`.
        bonus_scale: c of the bonus c / sqrt(N).
        horizon: H of the step sizes: the first estimates are forgotten after some H visits. By
            default 1 / (1 - gamma); 0 makes the mean of all targets.
        kwargs: as in `OptimisticAlgorithm`.

    Raises:
        ValueError: as `OptimisticAlgorithm`, and if ``gamma`` is 1 and there is no ``horizon``.
    """

    parameters = {"bonus_scale": np.float64, "steps_remembered": np.float64}  # noqa: RUF012
    learn_from_step = learn_with_bonus

    def __init__(
        self, *args: Any, bonus_scale: float = 0.1, horizon: float | None = None, **kwargs: Any
    ) -> None:
        self.bonus_scale = bonus_scale
        self.horizon = horizon
        super().__init__(*args, **kwargs)

    def _check_arguments(self) -> None:
        super()._check_arguments()
        check_at_least(0.0, settings_of(self, "bonus_scale", "horizon"))
        check_finite(settings_of(self, "bonus_scale"))
        if self.horizon is not None:
            check_finite(settings_of(self, "horizon"))
        elif self.gamma == 1:
            raise ValueError("horizon has to be given where gamma is 1")

    @property
    def steps_remembered(self) -> float:
        """H of the step sizes."""
        if self.horizon is None:
            return 1.0 / (1.0 - self.gamma) if self.gamma < 1 else math.inf
        return self.horizon
