"""Episodes of an evaluation on compiled code, for agents that were trained so.

They are the episodes of `pipeline.evaluation.sampled.evaluate`: the same seeds, starts and order.
Tables and tiles act by the same bits; networks by the compiled forward pass, and by the library's
`predict` where two actions are so close that rounding could decide.
"""

from __future__ import annotations

from contextlib import nullcontext
from dataclasses import dataclass
from typing import Any, cast

import numpy as np
from gymnasium.envs.classic_control import CartPoleEnv, MountainCarEnv
from stable_baselines3.common.base_class import BaseAlgorithm
from stable_baselines3.common.vec_env import DummyVecEnv, VecEnv

from agents.compiled.compile_envs import NotCompilable, monitor_of
from agents.compiled.episodes import DECIMALS
from agents.compiled.greedy_play import play_episodes
from agents.networks.matrix_products import one_thread
from agents.networks.network_worlds import NetworkEnvStates, network_world
from pipeline.evaluation.policy_kinds import is_network
from pipeline.evaluation.sampled import Evaluation
from pipeline.finite_numbers import check_numbers


@dataclass(frozen=True)
class CompiledCopy:
    """Environments to evaluate on, and their compiled counterpart.

    Attributes:
        env: the environments.
        world: what `agents.compiled.loop` steps.
        seen: how its observations are read.
    """

    env: DummyVecEnv
    world: Any
    seen: Any


def compiled_copy(env: VecEnv) -> CompiledCopy | None:
    """What can be evaluated on in compiled code; None where that is not possible.

    Environments whose states can be counted are left out: there, evaluation is exact, or there are
    so many states that to look at all of them takes longer than to play.
    """
    if not isinstance(env, DummyVecEnv) or any(monitor_of(each) is None for each in env.envs):
        return None
    if not isinstance(env.envs[0].unwrapped, CartPoleEnv | MountainCarEnv):
        return None
    try:
        return CompiledCopy(env, *network_world(env))
    except NotCompilable:
        return None


def evaluate_compiled(
    model: BaseAlgorithm, copy: CompiledCopy, n_episodes: int, seed: int | None
) -> Evaluation:
    """Play ``n_episodes`` by the best actions; arguments as of `evaluate`.

    Raises:
        NotFiniteError: if a return is not finite.
    """
    env, n_envs = copy.env, copy.env.num_envs
    if seed is not None:
        env.seed(seed)
    # As the library shares them out.
    wanted = (n_episodes + np.arange(n_envs)) // n_envs
    states = NetworkEnvStates(env, copy.world, copy.seen)
    player = cast(Any, model).greedy_player(copy.seen)
    with one_thread() if is_network(model) else nullcontext():
        found = play_episodes(copy.world, player, states, env.reset(), wanted)
    # As Monitor tells them.
    returns = np.array([round(total, DECIMALS) for total in found.returns.tolist()])
    when = f"in the evaluation at step {model.num_timesteps:,}"
    check_numbers(returns, "return", when)
    return Evaluation(returns, found.lengths, None)
