"""Dyna-Q and Dyna-Q+: learning a model of the environment, and planning on it."""

from __future__ import annotations

import math
from typing import Any, ClassVar, NamedTuple

import numpy as np
import torch as th
from stable_baselines3.common.policies import BasePolicy

from rl_yardstick.agents.common.settings import NOT_NEGATIVE, step_size, whole
from rl_yardstick.agents.compiled.loop import by_type, by_type_or_this
from rl_yardstick.agents.compiled.references import next_uniform
from rl_yardstick.agents.tabular.algorithm import QTablePolicy, TabularAlgorithm
from rl_yardstick.agents.tabular.q_learning_and_sarsa import QLearning
from rl_yardstick.agents.tabular.updates import (
    TabularAgent,
    best_value,
    learning_in_turn,
    room_at,
    update,
)
from rl_yardstick.machine_code.compiling import inlined
from rl_yardstick.mdp.transition_model import Bools, Floats, Ints

# The learnt model of the environment: the last outcomes of each pair of state and action.
#
# Compiled functions. A pair is the number ``obs * A + action``.


class LearntModel(NamedTuple):
    """The last K outcomes of each pair, with equal probabilities."""

    next_obs: Ints  # shape (S, A, K)
    rewards: Floats  # shape (S, A, K)
    terminated: Bools  # whether they ended the episode, shape (S, A, K)
    counts: Ints  # number of all outcomes, including dropped ones, shape (S, A)
    # The pairs that planning draws from, in the order of their first visit, shape (S * A,).
    pairs: Ints
    n_pairs: Ints  # the number of these pairs, shape (1,)


@inlined
def note_outcome(model: Any, env: Any) -> None:
    """Store the environment's last step; a full pair loses its oldest outcome."""
    place = model.counts[env.obs, env.action] % model.next_obs.shape[2]
    model.next_obs[env.obs, env.action, place] = env.next_obs
    model.rewards[env.obs, env.action, place] = env.reward
    model.terminated[env.obs, env.action, place] = env.terminated
    model.counts[env.obs, env.action] += 1


@inlined
def add_pair(model: Any, obs: int, action: int) -> None:
    """Add a pair to those that planning draws from."""
    if model.n_pairs[0] < len(model.pairs):  # also with numbers from a damaged file
        model.pairs[model.n_pairs[0]] = obs * model.counts.shape[1] + action
        model.n_pairs[0] += 1


class ModelArray(NamedTuple):
    """An array of a learnt model, which begins full of its least value."""

    shape: tuple[int, ...]
    end: int = 2**62  # integers must be below this
    least: int = 0  # and at least this
    kind: Any = np.int64


class ModelPolicy(QTablePolicy):
    """Greedy in a table, with a learnt model of the environment beside it."""

    model_type: ClassVar[Any] = LearntModel  # the model's NamedTuple of arrays
    sizes = (*QTablePolicy.sizes, "outcomes_kept")

    def __init__(self, *args: Any, outcomes_kept: int = 1, **kwargs: Any) -> None:
        super().__init__(*args, **kwargs)
        self.outcomes_kept = outcomes_kept
        arrays = self._arrays()
        for name in self.model_type._fields:
            begin = np.full(arrays[name].shape, arrays[name].least, arrays[name].kind)
            self.register_buffer(f"model_{name}", th.from_numpy(begin))

    def _arrays(self) -> dict[str, ModelArray]:
        """The arrays of a model by name; its type says which ones it has."""
        n_states, n_actions = self.visit_counts.shape[1:]
        n_pairs, shape = n_states * n_actions, (n_states, n_actions, self.outcomes_kept)
        return {
            "next_obs": ModelArray(shape, n_states),
            "rewards": ModelArray(shape, kind=np.float64),
            "terminated": ModelArray(shape, kind=np.bool_),
            "counts": ModelArray(shape[:2]),
            "pairs": ModelArray((n_pairs,), n_pairs),
            "n_pairs": ModelArray((1,), n_pairs + 1),
            "tried_at": ModelArray(shape[:2]),
            "time": ModelArray((1,)),
        }

    @property
    def model(self) -> Any:
        """The model, as arrays that share the memory of the policy."""
        buffers: Any = self._buffers
        names: tuple[str, ...] = self.model_type._fields
        return self.model_type(*(buffers[f"model_{name}"].numpy() for name in names))

    def load_state_dict(self, state_dict: Any, strict: bool = True, assign: bool = False) -> Any:
        """Load a table and a model."""
        held = state_dict.get("model_next_obs")
        if getattr(held, "ndim", 0) == 3 and held.shape[2] != self.outcomes_kept:
            raise ValueError(
                f"holds a model with room for {held.shape[2]} outcomes of each pair of state and "
                f"action, and the settings ask for {self.outcomes_kept}: leave them as they were"
            )
        result = super().load_state_dict(state_dict, strict, assign)
        self.check_places()
        return result

    def check_places(self) -> None:
        """Raise ValueError for a model with indices out of range."""
        arrays, model = self._arrays(), self.model
        for name in model._fields:
            numbers, array = getattr(model, name), arrays[name]
            fits = (numbers >= array.least) & (numbers < array.end)
            if array.kind is np.int64 and not fits.all():
                raise ValueError(f"holds no model for these observations and actions: model_{name}")


class ModelKeeper(TabularAlgorithm):
    """Passes the model in its policy to compiled functions as ``agent.memory``."""

    policy_aliases: ClassVar[dict[str, type[BasePolicy]]] = {"QTablePolicy": ModelPolicy}
    policy: ModelPolicy
    learn_from_step = learning_in_turn
    outcomes_kept: int = 1  # number of outcomes in the model for each pair of state and action

    def _memory_in_use(self) -> Any:
        return self.policy.model


@by_type
def remember(agent: TabularAgent, env: Any) -> None:
    """Update the model with the environment's last step."""
    raise NotImplementedError


@by_type_or_this
def imagined_reward(agent: TabularAgent, obs: int, action: int, reward: float) -> float:
    """The reward in planning, given the model's ``reward``."""
    return reward


@inlined
def remember_outcome(agent: TabularAgent, env: Any) -> None:
    """Store the outcome; planning draws from tried pairs."""
    if agent.memory.counts[env.obs, env.action] == 0:
        add_pair(agent.memory, env.obs, env.action)
    note_outcome(agent.memory, env)


@inlined
def imagine_step(agent: TabularAgent, progress: Any) -> None:
    """Learn from the model's outcome of a random pair.

    The remainder of the random number that draws the pair draws one of its outcomes.
    """
    settings, tables, model = agent.settings, agent.tables, agent.memory
    drawn = next_uniform(agent.rng) * model.n_pairs[0]
    pair = model.pairs[int(drawn)]
    obs, action = pair // tables.values.shape[2], pair % tables.values.shape[2]
    # The model of an untried pair: it stays in its state, with reward 0.
    reward, next_obs, goes_on = 0.0, obs, True
    if model.counts[obs, action] > 0:
        n_kept = min(model.counts[obs, action], model.next_obs.shape[2])
        k = int((drawn - int(drawn)) * n_kept)
        reward, next_obs = model.rewards[obs, action, k], model.next_obs[obs, action, k]
        goes_on = not model.terminated[obs, action, k]
    target = imagined_reward(agent, obs, action, reward)
    if goes_on:
        target += settings.gamma * best_value(tables, next_obs, agent.room)
    count = max(tables.visit_counts[0, obs, action], 1)
    size = step_size(progress.learning_rate, settings.averages_samples, count)
    tables.values[0, obs, action] += size * (target - tables.values[0, obs, action])


@inlined
def learn_and_plan(agent: TabularAgent, env: Any, progress: Any, i: int) -> float:
    """Learn from the environment's step, remember it, and plan."""
    if env.terminated and agent.settings.skip_terminal_update:
        return 0.0
    error = abs(update(agent, env, progress))
    remember(agent, env)
    for _ in range(agent.settings.planning_steps):
        imagine_step(agent, progress)
    return error


class DynaQ(ModelKeeper, QLearning):
    """Q-learning with planning on a learnt model (Sutton and Barto, section 8.2).

    After each step it does ``planning_steps`` more updates, on pairs of state and action drawn
    uniformly from those that were tried. (The book draws the state first.) The book's model has the
    last outcome of a pair, which is enough in deterministic environments; for stochastic ones,
    ``outcomes_kept`` stores more outcomes, of which an update draws one. Without planning this is
    Q-learning, bit for bit.

    Updates by planning are not counted: ``"sample_average"`` is 1/N after N real visits.

    Args:
        planning_steps: updates from the model after each step of an environment.
        outcomes_kept: as in `ModelKeeper`.
    """

    parameters = {"planning_steps": np.int64}  # noqa: RUF012
    ranges = {"planning_steps": whole(0), "outcomes_kept": whole(1)}  # noqa: RUF012
    learn_in = learn_and_plan
    remember = remember_outcome

    def __init__(
        self, *args: Any, planning_steps: int = 5, outcomes_kept: int = 1, **kwargs: Any
    ) -> None:
        self.planning_steps = planning_steps
        self.outcomes_kept = outcomes_kept
        super().__init__(*args, **kwargs)


class DatedModel(NamedTuple):
    """A model with the times of its outcomes."""

    next_obs: Ints
    rewards: Floats
    terminated: Bools
    counts: Ints
    pairs: Ints
    n_pairs: Ints
    tried_at: Ints  # time of the last try of a pair, 0 for never, shape (S, A)
    time: Ints  # steps of all environments so far, shape (1,)


@inlined
def remember_outcome_and_time(agent: TabularAgent, env: Any) -> None:
    """Store the outcome and its time; planning draws from all actions of visited states."""
    model = agent.memory
    seen = 0
    for action in range(model.counts.shape[1]):
        seen += model.counts[env.obs, action]
    if seen == 0:
        room = room_at(agent.tables, env.obs, agent.room)
        for k in range(len(room.values)):
            add_pair(model, env.obs, room.actions[k])
    note_outcome(model, env)
    model.time[0] += 1
    model.tried_at[env.obs, env.action] = model.time[0]


@inlined
def reward_for_trying(agent: TabularAgent, obs: int, action: int, reward: float) -> float:
    """The reward, plus a bonus that grows with the time since the last try."""
    idle = agent.memory.time[0] - agent.memory.tried_at[obs, action]
    return float(reward + agent.settings.kappa * math.sqrt(idle))


class DatedModelPolicy(ModelPolicy):
    """The policy of Dyna-Q+."""

    model_type: ClassVar[Any] = DatedModel


class DynaQPlus(DynaQ):
    """Dyna-Q with an exploration bonus, for changing environments (Sutton and Barto, section 8.3).

    In planning, a pair that was not tried for t steps gets a bonus of ``kappa`` * sqrt(t). Planning
    uses all actions of visited states; the model of an untried pair is that it stays in its state
    with reward 0 (the book's footnote). The values include the bonus, so they overestimate, and the
    greedy policy may be worse: the less, the smaller ``kappa``.

    Time is counted in steps of all environments together.

    Args:
        kappa: weight of the bonus.
    """

    policy_aliases = {"QTablePolicy": DatedModelPolicy}  # noqa: RUF012
    parameters = {"kappa": np.float64}  # noqa: RUF012
    ranges = {"kappa": NOT_NEGATIVE}  # noqa: RUF012
    remember = remember_outcome_and_time
    imagined_reward = reward_for_trying

    def __init__(self, *args: Any, kappa: float = 0.001, **kwargs: Any) -> None:
        self.kappa = kappa
        super().__init__(*args, **kwargs)
