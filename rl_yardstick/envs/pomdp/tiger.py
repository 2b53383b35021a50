"""The tiger: two doors, one of them the wrong one, and ears that err."""

from __future__ import annotations

from functools import lru_cache
from typing import Any, ClassVar

import numpy as np
from gymnasium import spaces
from numpy.typing import NDArray

from rl_yardstick.envs.argument_checks import check_number
from rl_yardstick.envs.grid import ChainEnv
from rl_yardstick.envs.pomdp.readings import World, with_readings
from rl_yardstick.mdp.transition_model import TransitionModel

LISTEN, OPEN_LEFT, OPEN_RIGHT = 0, 1, 2
SILENCE, HEARD_LEFT, HEARD_RIGHT = 0, 1, 2


class TigerEnv(ChainEnv):
    """Behind one of two doors waits a tiger; who listens longer knows better which.

    ## Description
    Cassandra, Kaelbling and Littman (Acting Optimally in Partially Observable Stochastic Domains,
    1994): a tiger is behind the left or the right door, and a reward behind the other. The agent
    may open a door, or listen, which costs a little and tells the right side with probability .85.
    After a door has been opened, the tiger and the reward are put behind the doors anew, and the
    game goes on.

    An agent without memory knows only what it heard last, which is not enough to open a door, so
    that it can only listen. An agent with memory counts: it opens a door when it has heard the
    tiger twice more often behind the other one.

    ## Action Space
    `Discrete(3)`: 0 listen, 1 open the left door, 2 open the right door.

    ## Observation Space
    `Discrete(3)`: 0 nothing, at the start and after a door was opened; 1 the tiger was heard on the
    left, 2 on the right. In the original, noise without meaning is heard after a door was opened.

    ## Rewards
    - listening: -1
    - opening the door without the tiger: +10
    - opening the door with the tiger: -100

    ## Starting State
    The tiger is behind either door with equal probability.

    ## Episode End
    The episode never terminates. It is truncated after 10 steps when made by `gymnasium.make`.

    ## Information
    `reset` and `step` give nothing more. The exact dynamics are available as arrays from
    `transition_model()`, and as `P` and `initial_state_distrib` as in Gymnasium's FrozenLake; their
    states are pairs of the tiger's door and what was heard last.

    ## Arguments
    - `accuracy=0.85`: probability to hear the tiger where it is
    - `render_mode=None`: `"ansi"`, `"rgb_array"` or `"human"`
    """

    action_names: ClassVar[tuple[str, ...]] = ("listen", "open left", "open right")

    def __init__(self, accuracy: float = 0.85, render_mode: str | None = None) -> None:
        self.accuracy = check_number("accuracy", accuracy, 0, 1)
        world = _world(self.accuracy)
        super().__init__(world.model.n_states, 3, render_mode)
        self.observation_space = spaces.Discrete(3)

    def transition_model(self) -> TransitionModel:
        return _world(self.accuracy).model

    def observation_of(self, states: Any) -> NDArray[Any]:
        """What was heard last."""
        heard: NDArray[Any] = _world(self.accuracy).reading[states]
        return heard

    def letters(self) -> str:
        """The two doors; the robot stands where the tiger is."""
        return "MM"

    def cell_of(self, state: int) -> int:
        return int(_world(self.accuracy).hidden[state])


@lru_cache(maxsize=4)
def _world(accuracy: float) -> World:
    shape = (2, 3, 2)
    prob, reward = np.full(shape, 0.5), np.full(shape, 10.0)
    prob[:, LISTEN] = np.eye(2)
    reward[:, LISTEN] = -1
    reward[0, OPEN_LEFT] = reward[1, OPEN_RIGHT] = -100
    next_state = np.broadcast_to(np.arange(2), shape)
    first = np.tile([1.0, 0.0, 0.0], (2, 1))
    later = np.stack([first] * 3)
    later[LISTEN] = [[0, accuracy, 1 - accuracy], [0, 1 - accuracy, accuracy]]
    hidden = TransitionModel(prob, next_state, reward, np.zeros(shape, np.bool_), np.full(2, 0.5))
    return with_readings(hidden, first, later)
