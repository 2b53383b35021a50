"""Prioritised sweeping."""

from __future__ import annotations

from typing import Any

import numpy as np

from agents.common.setting_checks import check_at_least, check_finite, check_whole, settings_of
from agents.common.step_sizes import step_size
from agents.tabular.models.model_keeping import MOST_PLANNING, ModelKeeper
from agents.tabular.models.sweeping_model import NONE, enqueue, most_urgent, remember_step
from agents.tabular.models.sweeping_policy import SweepingPolicy
from agents.tabular.temporal_difference import TabularAgent
from agents.tabular.value_tables import best_value
from machine_code.compiling import inlined


@inlined
def expected_error(agent: TabularAgent, pair: int) -> float:
    """The TD error of a pair, as the model has its outcome."""
    model, values = agent.memory, agent.tables.values
    obs, action = pair // values.shape[2], pair % values.shape[2]
    target = model.rewards[obs, action, 0]
    if not model.terminated[obs, action, 0]:
        following = best_value(agent.tables, model.next_obs[obs, action, 0], agent.room)
        target += agent.settings.gamma * following
    return float(target - values[0, obs, action])


@inlined
def notice(agent: TabularAgent, pair: int) -> float:
    """Queue a pair if its error is above the threshold; returns the error."""
    error = expected_error(agent, pair)
    if abs(error) > agent.settings.threshold:
        enqueue(agent.memory, pair, abs(error))
    return error


@inlined
def sweep(agent: TabularAgent, progress: Any) -> None:
    """Update the most urgent pair, and queue what leads to its state."""
    model, tables = agent.memory, agent.tables
    pair = most_urgent(model)
    obs, action = pair // tables.values.shape[2], pair % tables.values.shape[2]
    count = tables.visit_counts[0, obs, action]
    size = step_size(progress.learning_rate, agent.settings.averages_samples, max(count, 1))
    tables.values[0, obs, action] += size * expected_error(agent, pair)
    leading = model.first_into[obs]
    while leading != NONE:
        notice(agent, leading)
        leading = model.behind[leading]


@inlined
def sweep_all(agent: TabularAgent, progress: Any) -> None:
    """As many updates as the settings allow and the queue holds."""
    for _ in range(agent.settings.planning_steps):
        if agent.memory.n_queued[0] == 0:
            break
        sweep(agent, progress)


@inlined
def remember_and_sweep(agent: TabularAgent, envs: Any, progress: Any) -> None:
    """For each environment, in order: remember its step, and update what that makes urgent."""
    total_error = 0.0
    for i in range(len(envs)):
        env = envs[i]
        if not (env.terminated and agent.settings.skip_terminal_update):
            remember_step(agent.memory, env)
            agent.tables.visit_counts[0, env.obs, env.action] += 1
            pair = env.obs * agent.tables.values.shape[2] + env.action
            total_error += abs(notice(agent, pair))
            sweep_all(agent, progress)
        env.obs = env.new_obs
    progress.mean_td_error = total_error / len(envs)


class PrioritizedSweeping(ModelKeeper):
    """Updates first what would change most (Sutton and Barto, section 8.4).

    A step that surprises is queued by the size of its TD error, and so are the pairs that lead to
    a state whenever its values change: news of a goal run backwards from it. All updates come
    from the queue. Its model holds the last outcome of each pair of state and action, which is all
    where nothing is random; elsewhere values follow whatever happened last. First done by Moore and
    Atkeson ("Prioritized sweeping", 1993).

    Updates by planning are not counted: ``"sample_average"`` is 1/N after N real visits.

    Args:
        args: as in `TabularAlgorithm`.
        planning_steps: updates after each step of an environment, at most.
        threshold: how large an error has to be to be queued.
        kwargs: as in `TabularAlgorithm`.
    """

    policy_aliases = {"QTablePolicy": SweepingPolicy}  # noqa: RUF012
    parameters = {"planning_steps": np.int64, "threshold": np.float64}  # noqa: RUF012
    learn_from_step = remember_and_sweep

    def __init__(
        self, *args: Any, planning_steps: int = 5, threshold: float = 1e-4, **kwargs: Any
    ) -> None:
        self.planning_steps = planning_steps
        self.threshold = threshold
        super().__init__(*args, **kwargs)

    def _check_arguments(self) -> None:
        super()._check_arguments()
        check_whole(0, settings_of(self, "planning_steps"), MOST_PLANNING)
        check_at_least(0.0, settings_of(self, "threshold"))
        check_finite(settings_of(self, "threshold"))
