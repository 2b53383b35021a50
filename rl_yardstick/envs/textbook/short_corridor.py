"""The short corridor: three states that look alike, in one of which actions are reversed."""

from __future__ import annotations

from functools import lru_cache
from typing import Any, ClassVar

import numpy as np
from gymnasium import spaces
from numpy.typing import NDArray

from rl_yardstick.envs.grid import ChainEnv
from rl_yardstick.mdp.transition_model import TransitionModel

LEFT, RIGHT = 0, 1
REVERSED = 1
GOAL = 3


class ShortCorridorEnv(ChainEnv):
    """A corridor that only random actions can leave: repeating one action leads nowhere.

    ## Description
    Sutton and Barto (Reinforcement Learning, 2nd edition), example 13.1: three states in a row, and
    the goal to the right of them. In the first state and in the third, actions do what their names
    say; in the second, right leads left and left leads right. The agent does not see where it is,
    so it can only choose how often it goes right. Always right and always left never reach the
    goal. Going right with probability p takes (4 - 2 p) / (p (1 - p)) steps on average: 82 for .05,
    44 for .95, and at best 11.66, for p = 2 - sqrt(2), or .59.

    A score of 1 is a return of -11.66 for agents without memory. With memory, or for agents that
    see the states, it is -3. Greedy evaluations say nothing about agents without memory here: they
    always take the more probable action.

    ## Action Space
    `Discrete(2)`: 0 left, 1 right.

    ## Observation Space
    `Discrete(1)`: always 0.

    ## Rewards
    -1 for each step.

    ## Starting State
    The leftmost, state 0. Against its wall, left stays there.

    ## Episode End
    The episode terminates when the goal, state 3, is reached. It is truncated after 1000 steps when
    made by `gymnasium.make`; the steps above are those without a limit.

    ## Information
    `reset` and `step` give nothing more. One uniform number is drawn by each, without effect.
    The exact dynamics are available as arrays from `transition_model()`, and as `P` and
    `initial_state_distrib` as in Gymnasium's FrozenLake; their states are those of the corridor,
    not what is observed.

    ## Arguments
    - `render_mode=None`: `"ansi"`, `"rgb_array"` or `"human"`
    """

    action_names: ClassVar[tuple[str, ...]] = ("left", "right")

    def __init__(self, render_mode: str | None = None) -> None:
        super().__init__(GOAL + 1, 2, render_mode)
        self.observation_space = spaces.Discrete(1)

    def transition_model(self) -> TransitionModel:
        return _model()

    def observation_of(self, states: Any) -> NDArray[Any]:
        """Always 0: all states look alike."""
        return np.zeros_like(states)

    def letters(self) -> str:
        return "S..G"


@lru_cache(maxsize=1)
def _model() -> TransitionModel:
    states = np.arange(GOAL + 1)
    left, right = np.maximum(states - 1, 0), np.minimum(states + 1, GOAL)
    left[REVERSED], right[REVERSED] = right[REVERSED], left[REVERSED]
    next_state = np.stack((left, right), axis=1)[:, :, None]
    next_state[GOAL] = GOAL
    reward = np.full(next_state.shape, -1.0)
    reward[GOAL] = 0
    return TransitionModel(
        prob=np.ones(next_state.shape),
        next_state=next_state,
        reward=reward,
        terminated=next_state == GOAL,
        initial=np.eye(GOAL + 1)[0],
    )
