"""Compares an agent's values, advantages and gradients with the exact ones of its current policy.

The exact values are those of the training environment, under the agent's discount and without the
time limit, because agents bootstrap there.
"""

from __future__ import annotations

import csv
import io
from contextlib import closing
from dataclasses import dataclass, field
from functools import cached_property
from pathlib import Path
from typing import Any, cast

import numpy as np
import torch as th
from numpy.typing import NDArray
from stable_baselines3.common.base_class import BaseAlgorithm
from stable_baselines3.common.buffers import RolloutBuffer
from stable_baselines3.common.on_policy_algorithm import OnPolicyAlgorithm

from rl_yardstick.agents import policies
from rl_yardstick.agents.common.callbacks import BlockCallback
from rl_yardstick.agents.linear.policy_gradients import SoftmaxAlgorithm
from rl_yardstick.agents.planning import PlanningAgent
from rl_yardstick.envs import known_models
from rl_yardstick.mdp import TransitionModel, state_visitation
from rl_yardstick.mdp.gaps import PolicyValues, discounted_values, expected_estimates
from rl_yardstick.mdp.transition_model import Bools, Floats, Ints
from rl_yardstick.pipeline.environments import make_single_env
from rl_yardstick.pipeline.evaluation.exact import OfLastPolicy, is_wrapped_as_vector
from rl_yardstick.pipeline.files import write_text
from rl_yardstick.pipeline.run import MEANINGS
from rl_yardstick.pipeline.spec import TrainSpec

# Agents that always learn the values of their exploring policy.
EXPLORING = (
    *("sarsa", "expected_sarsa", "n_step_sarsa", "sarsa_lambda", "monte_carlo"),
    "semi_gradient_sarsa",
)
# Gradients are computed for at most this many minibatches of a rollout.
MOST_MINIBATCHES = 32
# In larger models, even one comparison takes too long.
MOST_OUTCOMES = 1_000_000


@dataclass(frozen=True)
class KnownWorld:
    """The environment that an agent trains on, with its exact model."""

    model: TransitionModel
    observations: NDArray[Any]  # of each state, states along the first axis
    horizon: int  # the time limit, for visit counts
    masks: Bools | None  # action masks, shape (S, A), for agents that use them
    is_limited: bool = True  # whether ``horizon`` limits training; else only evaluations
    _values: dict[float, OfLastPolicy[PolicyValues]] = field(default_factory=dict)  # by discount

    @cached_property
    def visits(self) -> OfLastPolicy[Floats]:
        """The function from a policy (S, A) to the share of its steps in each state, shape (S,)."""

        def shares(policy: Floats) -> Floats:
            is_fixed = (policy.max(axis=1) == 1).all()
            given = policy.argmax(axis=1) if is_fixed else policy  # faster
            visits = state_visitation(self.model, given, self.horizon)
            return np.asarray(visits / visits.sum())

        return OfLastPolicy(shares)

    def values(self, policy: Floats, discount: float) -> PolicyValues:
        """The exact values of a policy (S, A)."""
        new = OfLastPolicy(lambda asked: discounted_values(self.model, asked, discount))
        return self._values.setdefault(discount, new)(policy)

    @cached_property
    def numbers(self) -> dict[bytes, int]:
        """The index of each state, by the bytes of its observation."""
        rows = np.ascontiguousarray(self.observations.reshape(len(self.observations), -1))
        return {row.tobytes(): number for number, row in enumerate(rows)}

    def states_of(self, observations: NDArray[Any], n_rows: int) -> Ints:
        """The indices of the states with these ``n_rows`` observations, shape (n_rows,)."""
        rows = np.ascontiguousarray(observations.reshape(n_rows, -1), self.observations.dtype)
        return np.array([self.numbers[row.tobytes()] for row in rows], np.int64)


def known_world(spec: TrainSpec, agent: BaseAlgorithm) -> KnownWorld | str:
    """The world for comparing the agent's values with exact ones; or why that is impossible."""
    if isinstance(agent, PlanningAgent):
        return "a planner's values are exact already"
    if not isinstance(getattr(agent, "gamma", None), int | float):
        return f"{spec.algo} has no discount, so there are no values to compare"
    if is_wrapped_as_vector(spec):
        return "a VecEnv wrapper changes what the agent sees"
    with closing(make_single_env(spec, training=True)) as env:
        model, horizon = known_models.transition_model(env), known_models.time_limit(env)
        observations = None if model is None else known_models.observations_of_states(env)
        masks = None if observations is None else known_models.action_masks_of_states(env)
    if model is None or observations is None:
        return f"the exact model of {spec.env_id} is not known"
    is_limited = horizon is not None
    if horizon is None:
        with closing(make_single_env(spec)) as env:
            horizon = known_models.time_limit(env)
        assert horizon is not None
    if model.prob.size > MOST_OUTCOMES:
        return f"{spec.env_id} has {model.prob.size:,} outcomes, which are too many"
    if reason := policies.obstacle(agent, observations, masks, horizon, deterministic=False):
        return reason
    if policies.own_values(agent, observations) is None:
        return f"{spec.algo} has no values"
    masks = masks if policies.takes_masks(agent) else None
    world = KnownWorld(model, observations, horizon, masks, is_limited)
    # Compiled functions are loaded before the training begins.
    first = np.eye(model.n_actions)[np.zeros(model.n_states, np.int64)]
    world.values(first, 0.5)
    world.visits(first)
    return world


def recorder_of(path: Path, spec: TrainSpec, agent: BaseAlgorithm) -> CriticRecorder | str:
    """The recorder of a training; or a line on why there is none."""
    world = known_world(spec, agent)
    if isinstance(world, str):
        return world
    explores = learns_exploring_values(spec, agent) or isinstance(agent, SoftmaxAlgorithm)
    if not isinstance(agent, OnPolicyAlgorithm):
        return CriticRecorder(path, world, explores=explores)
    has_rollouts = type(agent.rollout_buffer) is RolloutBuffer or policies.takes_masks(agent)
    has_rollouts &= len(world.numbers) == world.model.n_states  # observations tell states apart
    return (RolloutRecorder if has_rollouts else CriticRecorder)(path, world, explores=True)


def learns_exploring_values(spec: TrainSpec, agent: BaseAlgorithm) -> bool:
    """Whether a table or tiles learn the values of the exploring policy, not of the greedy one."""
    return spec.algo in EXPLORING or getattr(agent, "target_policy", "") == "exploring"


class CriticRecorder(BlockCallback):
    """Writes ``diagnosis.csv``: a row for each comparison of the agent.

    With ``explores``, the agent learns the values of its exploring policy, not of its greedy one.
    """

    def __init__(self, path: Path, world: KnownWorld, *, explores: bool) -> None:
        super().__init__()
        self.path, self.world, self.explores = path, world, explores
        self.rows: list[dict[str, float]] = []

    def _on_step(self) -> bool:
        return True

    def judge(self, timesteps: int) -> None:
        """Compare the agent at an evaluation."""
        self._append(timesteps, self.figures())

    def finish(self, timesteps: int) -> None:
        """Compare the agent at the end of training, and write the file."""
        if not self.rows or self.rows[-1]["timesteps"] < timesteps:
            self._append(timesteps, self.figures())
        known = {name for row in self.rows for name in row}
        names = ["timesteps", *(name for name in MEANINGS if name in known)]
        text = io.StringIO()
        table = csv.DictWriter(text, names, restval="", lineterminator="\n")
        table.writeheader()
        table.writerows(self.rows)
        write_text(self.path, text.getvalue())

    def _append(self, timesteps: int, figures: dict[str, float]) -> None:
        finite = {name: value for name, value in figures.items() if np.isfinite(value)}
        self.rows.append({"timesteps": timesteps, **finite})
        for name, value in finite.items():
            self.model.logger.record(f"diagnosis/{name}", value)

    def policy(self) -> Floats:
        """The target policy of the agent's values, as probabilities of shape (S, A)."""
        world, agent = self.world, self.model
        if self.explores:
            found = policies.policy_matrix(agent, world.observations, False, world.masks)
            # Probabilities in float32 do not sum to exactly 1.
            return np.asarray(found / found.sum(axis=1, keepdims=True))
        actions = policies.best_actions(agent, world.observations, world.masks)
        return np.eye(world.model.n_actions)[actions]

    def figures(self) -> dict[str, float]:
        """The columns for the current agent."""
        world, policy = self.world, self.policy()
        exact = world.values(policy, float(self.model.gamma))  # type: ignore[attr-defined]
        believed, visits = policies.own_values(self.model, world.observations), world.visits(policy)
        assert believed is not None
        reachable = world.model.reachable
        allowed = np.broadcast_to(reachable[:, None], policy.shape)
        if world.masks is not None:
            allowed = allowed & world.masks
        values, found = believed, {}
        if believed.ndim == 2:
            values = (policy * believed).sum(axis=1)
            n_allowed = np.maximum(allowed.sum(axis=1, keepdims=True), 1)
            alike, by_visits = allowed.astype(np.float64), visits[:, None] * allowed / n_allowed
            weights: dict[str, Floats] = {"": alike, "_visited": np.asarray(by_visits)}
            errors = believed - exact.action_values
            own_advantages = believed - values[:, None]
            for end, weight in weights.items():
                found[f"q_error{end}"] = root_mean_square(errors, weight)
                of_advantages = root_mean_square(own_advantages - exact.advantages, weight)
                found[f"advantage_error{end}"] = of_advantages
            if not self.explores:
                found["overestimation"] = weighted_mean(values - exact.values, visits)
        found["v_error"] = root_mean_square(values - exact.values, reachable.astype(np.float64))
        found["v_error_visited"] = root_mean_square(values - exact.values, visits)
        if self.explores:
            logs = np.log(np.where(policy > 0, policy, 1.0))
            found["entropy"] = float(visits @ -(policy * logs).sum(axis=1))
        return found


def weighted_mean(numbers: Floats, weights: Floats) -> float:
    """The weighted mean of the finite numbers; NaN if none has a positive weight."""
    known = np.isfinite(numbers) & (weights > 0)
    total = weights[known].sum()
    return float(weights[known] @ numbers[known] / total) if total > 0 else float("nan")


def root_mean_square(numbers: Floats, weights: Floats) -> float:
    """The weighted root mean square of the finite numbers; NaN as in `weighted_mean`."""
    return float(np.sqrt(weighted_mean(numbers**2, weights)))


# --- rollouts -------------------------------------------------------------------------------------


class RolloutRecorder(CriticRecorder):
    """Compares agents such as PPO and A2C at the end of a rollout, before they update.

    Until then, the policy is the same as during the whole rollout and the evaluation within it.
    """

    asked_at: int | None = None  # the time step of the evaluation

    def judge(self, timesteps: int) -> None:
        self.asked_at = timesteps

    def _on_rollout_end(self) -> None:
        if self.asked_at is None:
            return
        timesteps, self.asked_at = self.asked_at, None
        self._append(timesteps, {**self.figures(), **self.rollout_figures(timesteps)})
        self.model.logger.record("time/total_timesteps", timesteps, exclude="tensorboard")
        self.model.logger.dump(timesteps)

    def rollout_figures(self, seed: int) -> dict[str, float]:
        """The columns on the errors of the rollout's advantages and of its policy gradient."""
        world, agent = self.world, cast(Any, self.model)
        buffer = agent.rollout_buffer
        n_steps, n_envs = buffer.rewards.shape
        states = world.states_of(buffer.observations, n_steps * n_envs)
        actions = buffer.actions.reshape(-1).astype(np.int64)
        estimates = buffer.advantages.reshape(-1).astype(np.float64)
        policy, critic = self.policy(), policies.own_values(agent, world.observations)
        exact = world.values(policy, float(agent.gamma))
        times = np.arange(n_steps)[:, None]
        begun = np.maximum.accumulate(np.where(buffer.episode_starts > 0, times, 0))
        n_left = np.broadcast_to(n_steps - times, begun.shape)
        if world.is_limited:
            n_left = np.minimum(n_left, world.horizon - (times - begun))
        assert critic is not None
        discounts, steps = (agent.gamma, agent.gae_lambda), (states, actions, n_left.reshape(-1))
        expected, shared = expected_estimates(world.model, policy, critic, *discounts, steps)
        biases, ones = expected - shared - exact.advantages[states, actions], np.ones(len(states))
        errors = {"gae_bias": biases, "gae_offset": shared, "gae_std": estimates - expected}
        found = {name: root_mean_square(values, ones) for name, values in errors.items()}
        visits = world.visits(policy)[:, None]
        true = np.where((visits > 0) & (policy > 0), visits * policy * exact.advantages, 0.0)
        if np.isfinite(true).all():
            batches = minibatches(agent, estimates, seed)
            found |= self.gradient_figures(true, states, actions, batches)
        return found

    def gradient_figures(
        self, true: Floats, states: Ints, actions: Ints, batches: list[tuple[Ints, Floats]]
    ) -> dict[str, float]:
        """Cosine similarity and signal-to-noise ratio of minibatch gradients.

        A policy gradient is a weighted sum over states and actions of the gradients of the log
        probabilities; ``true`` contains the weights of the exact one, shape (S, A).
        """
        shown = np.flatnonzero((np.bincount(states, minlength=len(true)) > 0) | true.any(axis=1))
        place = np.full(len(true), -1)
        place[shown] = np.arange(len(shown))
        weights = np.zeros((len(batches) + 1, len(shown), true.shape[1]))
        for weight, (steps, advantages) in zip(weights, batches, strict=False):
            at = place[states[steps]], actions[steps]
            np.add.at(weight, at, advantages / len(steps))
        weights[-1] = true[shown]
        *found, exact = _gradients(self.model.policy, self.world, shown, weights)
        norm, sizes = np.linalg.norm(exact), np.linalg.norm(found, axis=1)
        cosines = (np.array(found) @ exact)[sizes > 0] / (norm * sizes[sizes > 0])
        noise = ((np.array(found) - exact) ** 2).sum(axis=1).mean()
        return {
            "gradient_cosine": float(cosines.mean()) if len(cosines) and norm > 0 else np.nan,
            "gradient_snr": float(norm**2 / noise) if noise > 0 else np.nan,
        }


def minibatches(agent: Any, estimates: Floats, seed: int) -> list[tuple[Ints, Floats]]:
    """The steps and advantages of each minibatch in an epoch over a rollout.

    If the agent normalises advantages, they are only centred here, because their scale only acts
    as a step size.
    """
    n = len(estimates)
    size = min(agent.batch_size, n) if hasattr(agent, "n_epochs") else n
    # A separate generator, so that the agent's own order does not change.
    order = np.random.default_rng(seed).permutation(n)
    found = []
    for begin in range(0, min(n - size + 1, MOST_MINIBATCHES * size), size):
        steps = order[begin : begin + size]
        is_centred = getattr(agent, "normalize_advantage", False) and size > 1
        centre = estimates[steps].mean() if is_centred else 0.0
        found.append((steps, estimates[steps] - centre))
    return found


def _gradients(policy: Any, world: KnownWorld, shown: Ints, weights: Floats) -> Floats:
    """Gradients in the parameters for n sets of weights (n, states, A), shape (n, parameters)."""
    told = {} if world.masks is None else {"action_masks": world.masks[shown]}
    tensor, _ = policy.obs_to_tensor(world.observations[shown])
    logs = policy.get_distribution(tensor, **told).distribution.logits
    parameters = [p for p in policy.parameters() if p.requires_grad]
    found = []
    for weight in th.as_tensor(weights, dtype=logs.dtype, device=logs.device):
        kept: Any = {"retain_graph": True, "allow_unused": True}
        slopes: Any = th.autograd.grad(logs, parameters, weight, **kept)
        found.append(th.cat([slope.reshape(-1) for slope in slopes if slope is not None]))
    return np.asarray(th.stack(found).double().cpu().numpy())
