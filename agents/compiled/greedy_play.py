"""Episodes that an agent plays on compiled environments, learning nothing."""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np

from agents.compiled.env_state import COMPENSATED_SUM, EnvStates
from agents.compiled.episodes import Episodes
from agents.compiled.generators import handles_of
from agents.compiled.kept_worlds import World
from agents.compiled.loop import EpisodeLog, learn_from_last_step, run_block
from agents.compiled.training_records import EPISODE, PROGRESS
from mdp.array_types import Bools, Ints
from mdp.machine_code import inlined

# Some hundredths of a second with networks: what a signal waits for.
STEPS_AT_ONCE = 4096


class Plan(NamedTuple):
    """Does at each number that is observed what is written down.

    Attributes:
        actions: one for each number, shape (S,).
    """

    actions: Ints

    @inlined
    def act(self, env: Any, progress: Any) -> None:
        """Look it up."""
        env.action = self.actions[env.obs]

    @inlined
    def learn_from_step(self, envs: Any, progress: Any) -> None:
        """Nothing is learnt; the next observations are there."""
        for i in range(len(envs)):
            envs[i].obs = envs[i].new_obs


def play_episodes(
    world: World, player: Any, states: EnvStates, observations: Any, wanted: Ints
) -> Episodes:
    """Play on environments that have just been reset.

    All of them step until each has ended as many episodes as are wanted of it, so that their
    generators end where the library's `evaluate_policy` would leave them. The environments
    themselves stay where they are.

    Args:
        world: their compiled counterpart.
        player: what acts, such as `Plan`.
        states: the environments.
        observations: what they show, shape (n_envs, ...).
        wanted: of each environment, shape (n_envs,).

    Returns:
        These episodes, in the order in which they ended.
    """
    states.read()
    states.take_observations(observations)
    n_envs = len(wanted)
    # Handles do not keep the generators alive that they stand for.
    generators = [env.unwrapped.np_random for env in states.vec_env.envs]
    handles, progress = handles_of(generators), np.zeros(1, dtype=PROGRESS)
    log = EpisodeLog(
        np.zeros(STEPS_AT_ONCE * n_envs, dtype=EPISODE), np.empty((STEPS_AT_ONCE, n_envs))
    )
    ended: Any = np.zeros(0, dtype=EPISODE)
    while n_missing := _n_missing(ended["env"], wanted):
        # Before so many more have ended, not all can be there.
        limits = STEPS_AT_ONCE, n_missing, COMPENSATED_SUM
        run_block(world, player, states.records, handles, progress[0], log, *limits)
        learn_from_last_step(player, states.records, progress[0])
        ended = np.concatenate([ended, log.episodes[: progress["logged_episodes"][0]]])
    return Episodes.of(ended[_are_first(ended["env"], wanted)])


def _n_missing(envs: Ints, wanted: Ints) -> int:
    """How many episodes are still to end, of those that are wanted."""
    return int((wanted - np.bincount(envs, minlength=len(wanted))).clip(0).sum())


def _are_first(envs: Ints, wanted: Ints) -> Bools:
    """Which episodes are among the first of their environment, as many as are wanted of it."""
    chosen = np.zeros(len(envs), dtype=np.bool_)
    for i, n_episodes in enumerate(wanted):
        chosen[np.flatnonzero(envs == i)[:n_episodes]] = True
    return chosen
