"""What an environment's dynamics are made from, to see whether they are the same still.

Working out the model of a million states takes longer than a training on it. It can be kept as long
as all that it was made from is as it was, to the last bit: attributes may be changed by hand at any
time.
"""

from __future__ import annotations

import pickle
from dataclasses import dataclass
from typing import Any

import gymnasium as gym

from envs.checking.claimed_models import TRUSTED_CLASSES, is_trusted
from envs.finite_env import FiniteEnv
from envs.grid import GridWorld

Env = gym.Env[Any, Any]

# What changes while an environment is played or shown, and what is worked out from the rest.
PLAYED = frozenset(
    {"s", "spec", "render_mode", "_np_random", "_np_random_seed", "_renderer", "_steps"}
    | {"_last_action", "last_action", "P"}
)


@dataclass(frozen=True, eq=False)
class Sources:
    """All that an environment's dynamics are made from.

    Attributes:
        parts: the class and those above it, and what stands in them.
        content: what the environment holds, as bytes that are compared and never read.
    """

    parts: tuple[Any, ...]
    content: bytes

    def __eq__(self, other: object) -> bool:
        if not isinstance(other, Sources) or len(self.parts) != len(other.parts):
            return False
        same = all(mine is theirs for mine, theirs in zip(self.parts, other.parts, strict=True))
        return same and self.content == other.content

    __hash__ = None  # type: ignore[assignment]  # what is compared by identity may not be hashable


def sources_of(base: Env) -> Sources | None:
    """What the model of an environment without wrappers is made from; None if not all is known.

    It is known of Gymnasium's toy_text and of this project's environments, see
    `envs.checking.claimed_models.is_trusted`.
    """
    if not is_trusted(base):
        return None
    parts = [type(base)]
    if isinstance(base, GridWorld | FiniteEnv):
        base.initial_state_distrib  # noqa: B018  # worked out now, so that it is always there
        held = {name: _lasting(value) for name, value in vars(base).items() if name not in PLAYED}
        for cls in type(base).__mro__[: type(base).__mro__.index(gym.Env)]:
            parts += vars(cls).values()
    elif isinstance(base, TRUSTED_CLASSES):
        names = ("P", "initial_state_distrib", "observation_space", "action_space")
        held = {name: _lasting(getattr(base, name)) for name in names}
        held["fickle"] = getattr(base, "fickle_passenger", False)
    else:
        return None
    content = pickled(held)
    return None if content is None else Sources(tuple(parts), content)


def _lasting(value: object) -> object:
    """A space without its generator, which is drawn from; anything else as it is."""
    return repr(value) if isinstance(value, gym.Space) else value


def pickled(held: object) -> bytes | None:
    """Bytes that are the same for what is the same; None where there are none such."""
    try:
        return pickle.dumps(held)
    except Exception:  # noqa: BLE001  # an object that cannot be written down may be anything
        return None
