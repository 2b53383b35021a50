"""What an agent has seen of its environment: the last outcomes of each pair of state and action.

Compiled functions. A pair is the number ``obs * A + action``.
"""

from __future__ import annotations

from typing import Any, NamedTuple

from machine_code.compiling import inlined
from mdp.array_types import Bools, Floats, Ints


class LearntModel(NamedTuple):
    """The last K outcomes of each pair, each as likely as the others.

    Attributes:
        next_obs: where they led, shape (S, A, K).
        rewards: what they earned, shape (S, A, K).
        terminated: whether they ended the episode, shape (S, A, K).
        counts: how many there have been, those that were dropped included, shape (S, A).
        pairs: those that planning draws from, in the order in which they were met, shape (S * A,).
        n_pairs: how many these are, shape (1,).
    """

    next_obs: Ints
    rewards: Floats
    terminated: Bools
    counts: Ints
    pairs: Ints
    n_pairs: Ints


@inlined
def n_kept(model: Any, obs: int, action: int) -> int:
    """How many outcomes of a pair the model holds."""
    return int(min(model.counts[obs, action], model.next_obs.shape[2]))


@inlined
def note_outcome(model: Any, env: Any) -> None:
    """Keep the environment's last step, in place of the oldest of its pair if there is no room."""
    place = model.counts[env.obs, env.action] % model.next_obs.shape[2]
    model.next_obs[env.obs, env.action, place] = env.next_obs
    model.rewards[env.obs, env.action, place] = env.reward
    model.terminated[env.obs, env.action, place] = env.terminated
    model.counts[env.obs, env.action] += 1


@inlined
def add_pair(model: Any, obs: int, action: int) -> None:
    """Let planning draw a pair from now on."""
    if model.n_pairs[0] < len(model.pairs):  # whatever a file says
        model.pairs[model.n_pairs[0]] = obs * model.counts.shape[1] + action
        model.n_pairs[0] += 1
