"""Dyna-Q."""

from __future__ import annotations

from typing import Any

import numpy as np

from agents.common.setting_checks import check_whole, settings_of
from agents.common.step_sizes import step_size
from agents.compiled.dispatch import CompiledOnlyError, by_type
from agents.compiled.generators import next_uniform
from agents.tabular.models.learnt_models import add_pair, n_kept, note_outcome
from agents.tabular.models.model_keeping import MOST_PLANNING, ModelKeeper
from agents.tabular.q_learning import QLearning
from agents.tabular.temporal_difference import TabularAgent, update
from agents.tabular.value_tables import best_value
from machine_code.compiling import inlined


@by_type
def remember(agent: TabularAgent, env: Any) -> None:
    """Let the model know the environment's last step."""
    raise CompiledOnlyError


@by_type
def imagined_reward(agent: TabularAgent, obs: int, action: int, reward: float) -> float:
    """What planning takes for the reward where the model says ``reward``."""
    raise CompiledOnlyError


@inlined
def remember_outcome(agent: TabularAgent, env: Any) -> None:
    """Keep the outcome; planning draws from what was tried."""
    if agent.memory.counts[env.obs, env.action] == 0:
        add_pair(agent.memory, env.obs, env.action)
    note_outcome(agent.memory, env)


@inlined
def remembered_reward(agent: TabularAgent, obs: int, action: int, reward: float) -> float:
    """The reward that there was."""
    return reward


@inlined
def imagine_step(agent: TabularAgent, progress: Any) -> None:
    """Learn from what the model says of a pair that is drawn at random.

    What is left of the number that draws the pair draws one of its outcomes.
    """
    settings, tables, model = agent.settings, agent.tables, agent.memory
    drawn = next_uniform(agent.rng) * model.n_pairs[0]
    pair = model.pairs[int(drawn)]
    obs, action = pair // tables.values.shape[2], pair % tables.values.shape[2]
    # What was never tried is taken to lead nowhere and to earn nothing.
    reward, next_obs, goes_on = 0.0, obs, True
    if model.counts[obs, action] > 0:
        k = int((drawn - int(drawn)) * n_kept(model, obs, action))
        reward, next_obs = model.rewards[obs, action, k], model.next_obs[obs, action, k]
        goes_on = not model.terminated[obs, action, k]
    target = imagined_reward(agent, obs, action, reward)
    if goes_on:
        target += settings.gamma * best_value(tables, next_obs, agent.room)
    count = max(tables.visit_counts[0, obs, action], 1)
    size = step_size(progress.learning_rate, settings.averages_samples, count)
    tables.values[0, obs, action] += size * (target - tables.values[0, obs, action])


@inlined
def learn_and_plan(agent: TabularAgent, envs: Any, progress: Any) -> None:
    """For each environment, in order: learn from its step, remember it, and plan."""
    total_error = 0.0
    for i in range(len(envs)):
        env = envs[i]
        if not (env.terminated and agent.settings.skip_terminal_update):
            total_error += abs(update(agent, env, progress))
            remember(agent, env)
            for _ in range(agent.settings.planning_steps):
                imagine_step(agent, progress)
        env.obs = env.new_obs
    progress.mean_td_error = total_error if len(envs) == 1 else total_error / len(envs)


class DynaQ(ModelKeeper, QLearning):
    """Q-learning that learns from remembered steps as well (Sutton and Barto, section 8.2).

    After each step it does ``planning_steps`` updates more, on pairs of state and action that are
    drawn, each as likely as the others, from those that were tried. (The book draws the state
    first.) The book's model holds the last outcome of a pair, which is all where nothing is random;
    elsewhere ``outcomes_kept`` lets it hold more, of which an update draws one. Without planning
    this is Q-learning, to the last bit.

    Updates by planning are not counted: ``"sample_average"`` is 1/N after N real visits.

    Args:
        args: as in `TabularAlgorithm`.
        planning_steps: updates from the model after each step of an environment.
        outcomes_kept: as in `ModelKeeper`.
        kwargs: as in `TabularAlgorithm`.
    """

    parameters = {"planning_steps": np.int64}  # noqa: RUF012
    learn_from_step = learn_and_plan
    remember = remember_outcome
    imagined_reward = remembered_reward

    def __init__(
        self, *args: Any, planning_steps: int = 5, outcomes_kept: int = 1, **kwargs: Any
    ) -> None:
        self.planning_steps = planning_steps
        self.outcomes_kept = outcomes_kept
        super().__init__(*args, **kwargs)

    def _check_arguments(self) -> None:
        super()._check_arguments()
        check_whole(0, settings_of(self, "planning_steps"), MOST_PLANNING)
        check_whole(1, settings_of(self, "outcomes_kept"))
