"""Queries agents' policies in all states at once, and says for which agents this fails."""

from __future__ import annotations

import sys
from collections.abc import Callable
from typing import Any

import numpy as np
import torch as th
from gymnasium import spaces
from numpy.typing import NDArray
from stable_baselines3.common.base_class import BaseAlgorithm
from stable_baselines3.common.distributions import CategoricalDistribution
from stable_baselines3.common.policies import ActorCriticPolicy

from rl_yardstick.agents.bandits.rules import PreferenceBandit
from rl_yardstick.agents.bandits.tables import ValueBandit
from rl_yardstick.agents.common.exploration import BOLTZMANN
from rl_yardstick.agents.linear.algorithm import TileAlgorithm, tiles_of_all, vectors_of
from rl_yardstick.agents.linear.policy_gradients import SoftmaxAlgorithm
from rl_yardstick.agents.own_classes import parameters_of
from rl_yardstick.agents.plain import PlainAgent, rows_of
from rl_yardstick.agents.planning import PlanningAgent, RandomAgent
from rl_yardstick.agents.tabular.algorithm import QTablePolicy, TabularAlgorithm
from rl_yardstick.mdp.transition_model import Bools, Floats, Ints


def is_of_library(module: str) -> bool:
    """Whether a module's agents accept any number of observations at once, and hide no memory."""
    return module.partition(".")[0] in ("rl_yardstick", "stable_baselines3", "sb3_contrib")


def is_network(model: BaseAlgorithm) -> bool:
    """Whether the agent's policy is a network."""
    policy = getattr(model, "policy", None)
    return isinstance(policy, th.nn.Module) and next(policy.parameters(), None) is not None


def has_memory(agent: BaseAlgorithm) -> bool:
    """Whether the agent's policy is recurrent, and depends on earlier observations too."""
    # If sb3-contrib is not imported, no policy can be of its classes.
    module = sys.modules.get("sb3_contrib.common.recurrent.policies")
    return module is not None and isinstance(
        getattr(agent, "policy", None), module.RecurrentActorCriticPolicy
    )


def takes_masks(model: Any) -> bool:
    """Whether `predict` takes ``action_masks``, and the agent uses them."""
    takes = "action_masks" in parameters_of(model.__class__, "predict")
    return takes and bool(getattr(model, "mask_actions", True))


# The most input numbers of a network per call, and in total; above, playing episodes is faster than
# querying all states.
MOST_AT_ONCE = 1 << 26
MOST_NUMBERS = 400_000_000
# The most steps x states of a plan that depends on the time step.
MOST_PLANNED = 1 << 27
# The most states x steps if actions are random, because these reach many states.
MOST_AT_RANDOM = 30_000_000


def obstacle(
    agent: BaseAlgorithm,
    observations: NDArray[Any],
    masks: Bools | None,
    horizon: int,
    deterministic: bool = True,
) -> str:
    """Why exact evaluation is impossible, or slower than playing; empty if it is fine."""
    n_states = len(observations)
    if reason := _cannot_be_asked(agent, masks):
        return reason
    if is_network(agent) and n_states * spaces.flatdim(agent.observation_space) > MOST_NUMBERS:
        return f"querying a network in {n_states:,} states takes longer than playing"
    if isinstance(agent, PlanningAgent):
        if agent.policy.is_stationary or n_states * horizon <= MOST_PLANNED:
            return ""
        return f"a plan for {horizon:,} steps in {n_states:,} states is too large"
    is_random = isinstance(agent, RandomAgent) or not deterministic
    if is_random and n_states * horizon > MOST_AT_RANDOM:
        return f"random actions reach too many of {n_states:,} states in {horizon:,} steps"
    return ""


def why_not_exact(agent: BaseAlgorithm, observations: NDArray[Any]) -> str:
    """Why `predict` fails for all states at once, or empty; tries it for the user's agents."""
    if is_of_library(type(agent).__module__):
        return ""
    try:
        if isinstance(agent, PlainAgent):
            return agent.why_not_exact(observations)
        asked = [agent.predict(observations, deterministic=True) for _ in range(2)]
        first, second = (np.asarray(actions) for actions, _ in asked)
    except Exception as error:  # noqa: BLE001  # a stranger's code can fail in any way
        return f"asked in all states, it raises {type(error).__name__}: {error}"
    if first.shape != observations.shape[:1]:
        return f"predict returns actions of shape {first.shape} for {len(observations)} states"
    if any(state is not None for _, state in asked):
        return "predict depends on earlier observations"
    return "" if np.array_equal(first, second) else "predict draws its actions at random"


def policy_matrix(
    agent: BaseAlgorithm,
    observations: NDArray[Any],
    deterministic: bool = True,
    masks: Bools | None = None,
) -> Floats:
    """The agent's policy as probabilities of shape (S, A); TypeError if they are not known.

    ``observations`` has the states along its first axis, ``masks`` the shape (S, A).
    """
    if reason := _cannot_be_asked(agent, masks):
        raise TypeError(f"{type(agent).__name__}: {reason}")
    n_states, n_actions = len(observations), int(agent.action_space.n)  # type: ignore[attr-defined]
    if isinstance(agent, RandomAgent):
        return np.full((n_states, n_actions), 1 / n_actions)
    if deterministic:
        return np.eye(n_actions)[best_actions(agent, observations, masks)]
    if isinstance(agent, TabularAlgorithm):
        return np.asarray(agent.action_probabilities()[observations])
    if isinstance(agent, TileAlgorithm | ValueBandit | PreferenceBandit):
        return agent.action_probabilities(observations)
    policy: Any = getattr(agent, "policy", None)
    if hasattr(policy, "get_distribution"):  # an actor with a softmax over actions
        return _of_network(
            agent,
            observations,
            lambda seen, **told: policy.get_distribution(seen, **told).distribution.probs,
            masks,
        )
    # DQN, and QR-DQN, which may not be installed and is not a subclass of DQN.
    homes = ("stable_baselines3.dqn.", "sb3_contrib.qrdqn.")
    if any(base.__module__.startswith(homes) for base in type(agent).__mro__):
        epsilon = float(vars(agent)["exploration_rate"])
        greedy = policy_matrix(agent, observations, masks=masks)
        is_told = masks is not None and takes_masks(agent)
        allowed: Any = masks if is_told else np.ones(greedy.shape, dtype=np.bool_)
        random = epsilon * allowed / allowed.sum(axis=1, keepdims=True)
        return np.asarray(random + (1 - epsilon) * greedy)
    raise TypeError(f"the action probabilities of {type(agent).__name__} are not known")


def acts_by(agent: BaseAlgorithm) -> str:
    """The stochastic policy of `policy_matrix`, in words."""
    if isinstance(agent, PlanningAgent | RandomAgent):
        return "the same policy"
    draws = isinstance(agent, SoftmaxAlgorithm | PreferenceBandit)
    if draws or hasattr(agent.policy, "get_distribution"):
        return "its own distribution"
    is_softmax = getattr(agent, "strategy", None) == BOLTZMANN
    rate = getattr(agent, "exploration_rate", 0.0)
    return f"{'temperature' if is_softmax else 'epsilon'} {rate:g}"


def best_actions(
    agent: BaseAlgorithm, observations: NDArray[Any], masks: Bools | None = None
) -> Ints:
    """The agent's greedy action in each state, shape (S,)."""
    if reason := _cannot_be_asked(agent, masks):
        raise TypeError(f"{type(agent).__name__}: {reason}")
    # Reading a plain table is faster than `predict`, which would take most of an evaluation.
    is_ours = type(agent).predict is TabularAlgorithm.predict and not takes_masks(agent)
    table: object = agent.policy if is_ours else None
    if isinstance(table, QTablePolicy) and type(table) is QTablePolicy:
        return np.asarray(table.allowed_values(observations).argmax(axis=1))

    def predicted(observations: NDArray[Any], **told: Any) -> NDArray[Any]:
        return np.asarray(agent.predict(observations, deterministic=True, **told)[0])

    return _in_parts(agent, observations, masks, predicted).astype(np.int64)


def _of_network(
    agent: BaseAlgorithm,
    observations: NDArray[Any],
    asked: Callable[..., th.Tensor],
    masks: Bools | None = None,
) -> Floats:
    """The results of a function of tensors of observations, float64."""
    policy: Any = agent.policy

    def numbers(part: NDArray[Any], **told: Any) -> NDArray[Any]:
        with th.no_grad():
            found = asked(policy.obs_to_tensor(part)[0], **told)
        return np.asarray(found.cpu().numpy(), dtype=np.float64)

    return _in_parts(agent, observations, masks, numbers)


def _in_parts(
    agent: BaseAlgorithm,
    observations: NDArray[Any],
    masks: Bools | None,
    asked: Callable[..., NDArray[Any]],
) -> NDArray[Any]:
    """Call ``asked`` on batches of observations that a network can take."""
    n_states = len(observations)
    n_rows = n_states
    if is_network(agent):
        n_rows = max(MOST_AT_ONCE // max(spaces.flatdim(agent.observation_space), 1), 1)
    told: Any = {} if masks is None or not takes_masks(agent) else {"action_masks": masks}
    if n_states <= n_rows:
        return asked(observations, **told)
    parts = [slice(i, i + n_rows) for i in range(0, n_states, n_rows)]
    found = [asked(observations[p], **{name: m[p] for name, m in told.items()}) for p in parts]
    return np.concatenate(found)


def _cannot_be_asked(agent: BaseAlgorithm, masks: Bools | None) -> str:
    if has_memory(agent):
        return "its actions depend on earlier observations, not on the state alone"
    if masks is None and takes_masks(agent):
        return "which actions are valid in each state is not known"
    return ""


def action_figures(agent: BaseAlgorithm, observations: Any) -> tuple[str, Floats] | None:
    """The agent's figures for each action at the observation of one environment, or None.

    Returns "value", "score" or "probability", and the numbers, shape (A,).
    """
    policy: Any = agent.policy
    if not isinstance(agent.action_space, spaces.Discrete):
        return None
    for word, name in (("value", "q_table"), ("score", "scores")):
        table = getattr(policy, name, None)
        if table is not None and isinstance(agent.observation_space, spaces.Discrete):
            row = int(np.asarray(observations).reshape(-1)[0])
            return word, np.asarray(table)[row if len(table) > 1 else 0]
    if isinstance(agent, SoftmaxAlgorithm):
        return "probability", agent.action_probabilities(observations)[0]
    # A recurrent policy would need its hidden state.
    if isinstance(policy, ActorCriticPolicy) and not hasattr(policy, "lstm_actor"):
        with th.no_grad():
            distribution = policy.get_distribution(policy.obs_to_tensor(observations)[0])
        if not isinstance(distribution, CategoricalDistribution):
            return None
        return "probability", distribution.distribution.probs[0].cpu().numpy()
    values = own_values(agent, observations)
    return None if values is None or values.ndim == 1 else ("value", values[0])


def own_values(agent: BaseAlgorithm, observations: NDArray[Any]) -> Floats | None:
    """The agent's own values of actions (S, A) or states (S,); None if it has none.

    ``observations`` has the states along its first axis.
    """
    policy: Any = agent.policy
    if isinstance(agent, PlainAgent):
        return agent.values_at(rows_of(observations))
    if isinstance(agent, TabularAlgorithm):
        return np.asarray(policy.q_table[observations])
    if isinstance(agent, SoftmaxAlgorithm):
        if not len(policy.state_weights):
            return None
        active = tiles_of_all(policy.tiles, vectors_of(policy.observation_space, observations))
        return np.asarray(policy.state_weights.numpy()[active].sum(axis=1))
    if isinstance(agent, TileAlgorithm):
        return np.asarray(policy.sums(observations))
    if not is_network(agent) or has_memory(agent):
        return None
    if hasattr(policy, "q_net"):
        return _of_network(agent, observations, policy.q_net)
    if hasattr(policy, "quantile_net"):
        return _of_network(agent, observations, lambda seen: policy.quantile_net(seen).mean(dim=1))
    if hasattr(policy, "predict_values"):
        return _of_network(agent, observations, lambda seen: policy.predict_values(seen)[:, 0])
    return None
