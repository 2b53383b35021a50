"""Episodes that an agent plays on compiled environments without learning.

They equal the episodes of the library's `evaluate_policy`: the same generators, which end in the
same state.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np

from rl_yardstick.agents.compiled.env_states import COMPENSATED_SUM, EnvStates
from rl_yardstick.agents.compiled.generators import handles_of
from rl_yardstick.agents.compiled.loop import EpisodeLog, learn_from_last_step, run_block
from rl_yardstick.agents.compiled.records import Episodes, record_in_monitors
from rl_yardstick.agents.compiled.worlds import EPISODE, PROGRESS
from rl_yardstick.machine_code.compiling import inlined
from rl_yardstick.mdp.transition_model import Bools, Ints

# Some hundredths of a second with networks, for which a signal may have to wait.
STEPS_AT_ONCE = 4096


class Plan(NamedTuple):
    """A player with a fixed action for each observed number."""

    actions: Ints  # one for each number, shape (S,)

    @inlined
    def act(self, env: Any, progress: Any) -> None:
        """Look the action up."""
        env.action = self.actions[env.obs]

    @inlined
    def learn_from_step(self, envs: Any, progress: Any) -> None:
        """Learn nothing; move on to the next observations."""
        for i in range(len(envs)):
            envs[i].obs = envs[i].new_obs


def play_episodes(
    world: Any, player: Any, states: EnvStates, observations: Any, wanted: Ints
) -> Episodes:
    """Play the wanted numbers of episodes on environments that have just been reset.

    All environments step until each has ended its number of episodes. The environments, their
    generators and their Monitors end in the state in which `evaluate_policy` would leave them.
    """
    states.read()
    states.take_observations(observations)
    n_envs = len(wanted)
    # Handles do not keep their generators alive.
    generators = [env.unwrapped.np_random for env in states.vec_env.envs]
    handles, progress = handles_of(generators), np.zeros(1, dtype=PROGRESS)
    log = EpisodeLog(
        np.zeros(STEPS_AT_ONCE * n_envs, dtype=EPISODE),
        np.empty((STEPS_AT_ONCE, n_envs)),
    )
    ended: Any = np.zeros(0, dtype=EPISODE)
    while n_missing := _n_missing(ended["env"], wanted):
        # At least this many more episodes must end.
        limits = STEPS_AT_ONCE, n_missing, COMPENSATED_SUM
        n_steps = run_block(world, player, states.records, handles, progress[0], log, *limits)
        learn_from_last_step(player, states.records, progress[0])
        if hasattr(player, "check"):
            player.check()
        new = log.episodes[: progress["logged_episodes"][0]]
        states.keep_rewards(Episodes.of(new), log.rewards[:n_steps])
        ended = np.concatenate([ended, new])
    n_done = int(progress["num_timesteps"][0]) // n_envs
    record_in_monitors(states.monitors, Episodes.of(ended), n_done)
    states.write()
    return Episodes.of(ended[_are_first(ended["env"], wanted)])


def _n_missing(envs: Ints, wanted: Ints) -> int:
    """The number of wanted episodes that have not ended yet."""
    return int((wanted - np.bincount(envs, minlength=len(wanted))).clip(0).sum())


def _are_first(envs: Ints, wanted: Ints) -> Bools:
    """Which episodes are among the first ``wanted`` of their environment."""
    chosen = np.zeros(len(envs), dtype=np.bool_)
    for i, n_episodes in enumerate(wanted):
        chosen[np.flatnonzero(envs == i)[:n_episodes]] = True
    return chosen
