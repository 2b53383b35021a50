"""What can be wrong with an environment: how bad it is, and how to mend it."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

# Trainings fail or learn something else; they suffer; worth knowing.
LEVELS = ("breaks", "bites", "note")
KINDS: Mapping[str, tuple[str, str]] = {
    "crash": ("breaks", "see the message"),
    "old-api": ("breaks", "port the environment to Gymnasium's reset and step"),
    "no-space": ("breaks", "set it in __init__, from gymnasium.spaces"),
    "info-type": ("breaks", "return a dict, for example {}"),
    "end-type": ("bites", "return bool(terminated) and bool(truncated)"),
    "info-episode": ("breaks", "rename the key: Monitor writes it"),
    "info-key": ("breaks", "rename the key: vector environments write it"),
    "action-changed": ("breaks", "copy the action before changing it"),
    "action-bounds": ("breaks", "Box(-1, 1), scaled inside step"),
    "space-start": ("breaks", "count from 0 in the space, and add the start inside"),
    "space-changed": ("breaks", "make the spaces once, in __init__"),
    "space-remade": ("note", "make the spaces once, in __init__: a new one has no seed"),
    "observation-not-in-space": ("breaks", "make observation_space and observations agree"),
    "observation-out-of-bounds": ("breaks", "clip observations, or widen the bounds"),
    "observation-dtype": ("bites", "numpy.asarray(observation, self.observation_space.dtype)"),
    "observation-nan": ("breaks", "guard the division, root or logarithm"),
    "observation-in-place": ("breaks", "return a copy: array.copy()"),
    "observation-constant": ("bites", "show what the best action depends on"),
    "reward-nan": ("breaks", "guard the division, root or logarithm"),
    "reward-type": ("breaks", "return float(reward)"),
    "reward-huge": ("bites", "divide rewards, or VecNormalize(norm_reward=True)"),
    "reward-never": ("bites", "ease the start, or reward the way to the goal"),
    "goal-unreachable": ("breaks", "open a way to the goal, or start elsewhere"),
    "model": ("breaks", "P[state][action]: (probability, next state, reward, terminated)"),
    "no-end": ("breaks", "max_episode_steps=N in gymnasium.register"),
    "limit-as-terminated": ("bites", "leave time limits to max_episode_steps: truncated=True"),
    "truncation-lost": ("breaks", "pass truncated on in the wrappers around TimeLimit"),
    "wrapper-order": ("breaks", "TimeLimit inside the wrapper that counts episodes"),
    "statistics-order": ("bites", "count episodes inside the wrapper that changes rewards"),
    "step-after-end": ("note", "return terminated=True and a reward of 0 after an end"),
    "seed": ("breaks", "draw from self.np_random alone, after super().reset(seed=seed)"),
    "reset-repeats": ("breaks", "super().reset(seed=seed), also where seed is None"),
    "state-survives-reset": ("breaks", "set every attribute anew in reset"),
    "global-generator": ("bites", "draw from self.np_random alone"),
    "shared-state": ("breaks", "set it in __init__ as self.x, not in the class or module"),
    "not-copyable": ("note", "no locks, lambdas or open files in attributes"),
    "render": ("bites", "__init__(render_mode=None), uint8 frames (height, width, 3)"),
    "render-changes": ("breaks", "neither draw random numbers nor change state in render"),
    "slow": ("bites", "profile step, or train with --vec-env subproc"),
    "prints": ("bites", "use logging, or return it in info"),
}


@dataclass(frozen=True)
class Finding:
    """One thing that is wrong, and where it was first seen."""

    level: str
    name: str  #: its key in `KINDS`
    what: str
    where: str  #: a step, an attribute, a file and line; may be empty
    mend: str


class Findings(dict[str, Finding]):
    """The first finding of each name."""

    def add(self, name: str, what: str, where: str = "") -> None:
        """Add a finding, unless that name was found before; long texts are shortened."""
        level, mend = KINDS[name]
        text = " ".join(what.split())
        self.setdefault(name, Finding(level, name, text[:160], where, mend))
