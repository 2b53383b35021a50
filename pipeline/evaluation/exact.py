"""Exact evaluation: what an agent's policy is worth, computed instead of sampled.

Where the transition model of the environment is known, the policy is asked for every state at once,
and its return under the time limit follows by arithmetic, without evaluation noise.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np
import torch as th
from numpy.typing import NDArray
from stable_baselines3.common.base_class import BaseAlgorithm

from agents.planning import PlanningAgent
from agents.reference import RandomAgent
from agents.tabular.tabular_algorithm import TabularAlgorithm
from envs.known_models import (
    action_masks_of_states,
    model_check,
    observations_of_states,
    success_outcomes,
    time_limit,
    transition_model,
)
from envs.layout import GridLayout, grid_layout
from mdp import (
    TransitionModel,
    baseline_return,
    finite_horizon_optimum,
    optimal_choices,
    policy_return,
)
from mdp.array_types import Bools, Floats
from pipeline.environments import make_single_env
from pipeline.evaluation.mask_telling import takes_masks
from pipeline.evaluation.policy_kinds import has_memory
from pipeline.evaluation.sampled import KNOWN_LIBRARIES, Evaluation, Yardstick
from pipeline.train_spec import TrainSpec

# Beyond this, episodes are sampled: exact evaluation would take longer than training.
MAX_STATES = 20_000


@dataclass(frozen=True)
class ExactEvaluator:
    """Evaluates agents on an environment whose model is known.

    Attributes:
        model: the dynamics of the environment that agents are evaluated on.
        observations: what an agent observes in each state, states along the first axis.
        horizon: the time limit.
        success: the outcomes that count as success, shape (S, A, K), or None.
        yardstick: the best possible and the baseline's return.
        layout: where the states lie on a map, for grid worlds.
        masks: what may be done in each state, bool of shape (S, A), or None where that is not
            known; for agents that are told.
    """

    model: TransitionModel
    observations: NDArray[Any]
    horizon: int
    success: Bools | None
    yardstick: Yardstick
    layout: GridLayout | None = None
    masks: Bools | None = None

    def __call__(self, agent: BaseAlgorithm, deterministic: bool = True) -> Evaluation:
        """The exact worth of the agent's policy as it is."""
        policy = self.policy(agent, deterministic)
        result = policy_return(self.model, policy, self.horizon, success=self.success)
        rate = result.success_rate
        return Evaluation(
            returns=np.array([result.expected_return]),
            lengths=np.array([result.expected_length]),
            successes=None if rate is None else np.array([rate]),
            exact_std=float(np.sqrt(result.return_variance)),
            yardstick=self.yardstick,
        )

    @cached_property
    def optimum(self) -> tuple[Floats, Bools]:
        """What each state is worth at best, shape (S,), and its optimal actions, shape (S, A)."""
        return optimal_choices(self.model, self.horizon)

    def policy(self, agent: BaseAlgorithm, deterministic: bool) -> NDArray[Any]:
        """The agent's policy: of shape (S, A), or (horizon, S) where it depends on the time."""
        if isinstance(agent, PlanningAgent):
            steps = np.arange(self.horizon)[:, None]
            return agent.policy.actions_after(self.observations[None], steps)
        return policy_matrix(agent, self.observations, deterministic, self.masks)

    def obstacle(self, agent: BaseAlgorithm) -> str:
        """Why the agent's policy cannot be had by asking it for every state; empty where it can."""
        return _obstacle(agent, self.masks)


def exact_evaluator(spec: TrainSpec) -> ExactEvaluator | None:
    """The exact evaluator of a run, or None where episodes have to be sampled."""
    if _is_wrapped_as_vector(spec):
        return None
    env = make_single_env(spec)
    try:
        model, observations = transition_model(env), observations_of_states(env)
        horizon = time_limit(env)
        if model is None or observations is None or horizon is None:
            return None
        if model.n_states > MAX_STATES:
            return None
        masks = action_masks_of_states(env)
        success, layout = success_outcomes(env), grid_layout(env)
    finally:
        env.close()
    if layout is not None and layout.n_states != model.n_states:
        layout = None  # a grid world of somebody's own has states that are no cells
    yardstick = Yardstick(
        optimum=float(finite_horizon_optimum(model, horizon).start_value),
        baseline=float(baseline_return(model, horizon)),
    )
    return ExactEvaluator(model, observations, horizon, success, yardstick, layout, masks)


def why_not_exact(agent: BaseAlgorithm, observations: NDArray[Any]) -> str:
    """Say why an agent cannot be asked for all states at once; empty where it can.

    Agents of this project and of Stable-Baselines3 can. Of others, what `predict` returns is looked
    at: it has to be one action a state, the same when it is asked again, and nothing to remember.

    Args:
        agent: any agent with discrete actions.
        observations: what it observes in each state, states along the first axis.
    """
    if type(agent).__module__.partition(".")[0] in KNOWN_LIBRARIES:
        return ""
    try:
        asked = [agent.predict(observations, deterministic=True) for _ in range(2)]
        first, second = (np.asarray(actions) for actions, _ in asked)
    except Exception as error:  # noqa: BLE001  # a stranger's code can fail in any way
        return f"predict takes no batch of observations ({type(error).__name__})"
    if first.shape != observations.shape[:1]:
        return f"predict returns actions of shape {first.shape} for {len(observations)} states"
    if any(state is not None for _, state in asked):
        return "predict remembers what it saw before"
    return "" if np.array_equal(first, second) else "predict draws its actions at random"


def model_refusal(spec: TrainSpec) -> str | None:
    """Why the model that the environment brings is not believed, in one line; None if it is.

    None too where it brings none, or where it would not serve the evaluation of such a run.
    """
    if _is_wrapped_as_vector(spec):
        return None
    env = make_single_env(spec)
    try:
        check = model_check(env)
    finally:
        env.close()
    return None if check is None else check.refusal


def _is_wrapped_as_vector(spec: TrainSpec) -> bool:
    """Whether the agent sees the environment through something around all of its copies."""
    special = spec.hyperparams
    return bool(special.normalize is not None or special.frame_stack or special.vec_env_wrapper)


def policy_matrix(
    agent: BaseAlgorithm,
    observations: NDArray[Any],
    deterministic: bool = True,
    masks: Bools | None = None,
) -> Floats:
    """The agent's policy as probabilities of shape (S, A).

    Args:
        agent: any agent with discrete actions whose policy depends on the observation alone.
        observations: what it observes in each state, states along the first axis.
        deterministic: its best actions rather than what it samples.
        masks: what may be done in each state, bool of shape (S, A), for agents that are told.

    Raises:
        TypeError: if the probabilities that the agent acts with are not known.
    """
    obstacle = _obstacle(agent, masks)
    if obstacle:
        raise TypeError(f"{type(agent).__name__}: {obstacle}")
    n_states, n_actions = len(observations), int(agent.action_space.n)  # type: ignore[attr-defined]
    told: Any = {} if masks is None or not takes_masks(agent) else {"action_masks": masks}
    if isinstance(agent, RandomAgent):
        return np.full((n_states, n_actions), 1 / n_actions)
    if deterministic:
        actions, _ = agent.predict(observations, deterministic=True, **told)
        return np.eye(n_actions)[np.asarray(actions, dtype=np.int64)]
    if isinstance(agent, TabularAlgorithm):
        return np.asarray(agent.action_probabilities()[observations])
    policy = getattr(agent, "policy", None)
    if hasattr(policy, "get_distribution"):
        return _actor_probabilities(policy, observations, told)
    if _is_epsilon_greedy(agent):
        epsilon = float(vars(agent)["exploration_rate"])
        greedy = policy_matrix(agent, observations, masks=masks)
        allowed = told.get("action_masks", np.ones(greedy.shape, dtype=np.bool_))
        random = epsilon * allowed / allowed.sum(axis=1, keepdims=True)
        return np.asarray(random + (1 - epsilon) * greedy)
    raise TypeError(f"the action probabilities of {type(agent).__name__} are not known")


def _is_epsilon_greedy(agent: BaseAlgorithm) -> bool:
    """Whether it is DQN or QR-DQN, which may not be installed and is no subclass of it."""
    homes = ("stable_baselines3.dqn.", "sb3_contrib.qrdqn.")
    return any(base.__module__.startswith(homes) for base in type(agent).__mro__)


def _obstacle(agent: BaseAlgorithm, masks: Bools | None) -> str:
    if has_memory(agent):
        return "it acts by what it remembers, not by the state alone"
    if masks is None and takes_masks(agent):
        return "which actions are valid in each state is not known"
    return ""


def _actor_probabilities(policy: Any, observations: NDArray[Any], told: dict[str, Any]) -> Floats:
    """The probabilities of an actor with a softmax over its actions, shape (S, A)."""
    with th.no_grad():
        tensor, _ = policy.obs_to_tensor(observations)
        distribution = policy.get_distribution(tensor, **told).distribution
    return np.asarray(distribution.probs.cpu().numpy(), dtype=np.float64)
