"""Environments whose states lie side by side: walks, a river, a corridor, maximization bias."""

from __future__ import annotations

from functools import lru_cache
from typing import Any, ClassVar

import numpy as np
from gymnasium import spaces
from numpy.typing import NDArray

from rl_yardstick.envs.argument_checks import check_number, check_whole_number
from rl_yardstick.envs.finite_env import MaskedFiniteEnv, summing_to_one
from rl_yardstick.envs.grid import MapEnv, in_rows
from rl_yardstick.mdp.transition_model import Bools, TransitionModel

MOST_STATES, MOST_ACTIONS = 10_000, 1000
LEFT, RIGHT = 0, 1
# Of the short corridor: the state with reversed actions, and the goal.
REVERSED, GOAL = 1, 3
# Of maximization bias: B is to the left of A, and an end beyond either.
LEFT_END, B, A, RIGHT_END = range(4)


class RandomWalkEnv(MapEnv):
    """A random walk to the left or to the right: the values of its states are to be estimated.

    ## Description
    Sutton and Barto (Reinforcement Learning, 2nd edition), example 6.2: states 1 to 5 in a row.
    Each step goes to one of the neighbours, to both with equal probability, until it leaves the row
    at either end. Ending on the right earns 1, so the value of state i is i / 6.

    There is only one action, so an agent does not control, it predicts. Q-learning is TD(0) here,
    and all agents earn the same.

    - Example 7.1: `n_states=19, left_reward=-1`; the value of state i is (i - 10) / 10.
    - Example 9.1: `n_states=1000, max_jump=100, left_reward=-1`: a step jumps to any of the 100
      states on either side; a jump beyond an end terminates there.

    ## Action Space
    `Discrete(1)`: 0 takes a step.

    ## Observation Space
    `Discrete(n_states + 2)`: the states 1 to `n_states` from left to right; 0 beyond the left end
    and `n_states + 1` beyond the right one.

    ## Rewards
    1 for leaving on the right, 0 for everything else.

    ## Starting State
    The one in the middle, `(n_states + 1) // 2`.

    ## Episode End
    The episode terminates beyond either end. It is truncated after 1000 steps when made by
    `gymnasium.make`; the values above are those without a limit.

    ## Arguments
    - `n_states=5`: the length of the row
    - `max_jump=1`: a step goes 1 to this many states to the left or to the right, to each with
      equal probability
    - `left_reward=0`, `right_reward=1`: for leaving on that side
    - `render_mode=None`: `"ansi"`, `"rgb_array"` or `"human"`
    """

    action_names: ClassVar[tuple[str, ...]] = ("step",)

    def __init__(
        self,
        n_states: int = 5,
        max_jump: int = 1,
        left_reward: float = 0,
        right_reward: float = 1,
        render_mode: str | None = None,
    ) -> None:
        self.n_states = check_whole_number("n_states", n_states, 1, MOST_STATES)
        self.max_jump = check_whole_number("max_jump", max_jump, 1, MOST_STATES)
        self.left_reward = check_number("left_reward", left_reward)
        self.right_reward = check_number("right_reward", right_reward)
        middle = "." * ((self.n_states + 1) // 2 - 1)
        self.rows = in_rows(f"G{middle}S".ljust(self.n_states + 1, ".") + "G")
        super().__init__(self.n_states + 2, 1, render_mode)

    def transition_model(self) -> TransitionModel:
        return _walk(self.n_states, self.max_jump, self.left_reward, self.right_reward)


@lru_cache(maxsize=4)
def _walk(n: int, max_jump: int, left: float, right: float) -> TransitionModel:
    jumps = np.concatenate([np.arange(-max_jump, 0), np.arange(1, max_jump + 1)])
    states = np.arange(n + 2)[:, None]
    ends = (states == 0) | (states == n + 1)
    next_state = np.clip(states + np.where(ends, 0, jumps), 0, n + 1)
    terminated = (next_state == 0) | (next_state == n + 1)
    reward = np.where(next_state == 0, left, right) * (terminated & ~ends)
    prob = summing_to_one(np.full(next_state.shape, 1 / len(jumps)))
    return TransitionModel(
        prob=prob[:, None],
        next_state=next_state[:, None],
        reward=reward[:, None],
        terminated=terminated[:, None],
        initial=np.eye(n + 2)[(n + 1) // 2],
    )


class RiverSwimEnv(MapEnv):
    """A swimmer goes against the current to a large reward, or with it to a small one.

    ## Description
    Strehl and Littman ("An analysis of model-based interval estimation for Markov decision
    processes", 2008), with the probabilities of Osband, Russo and Van Roy ("(More) efficient
    reinforcement learning via posterior sampling", 2013): six states in a row. Swimming left
    always succeeds. Swimming right moves up by one with probability .35 and down by one with .05,
    else it stays; in the leftmost state it moves up with .6, and in the rightmost one it stays with
    .6 and moves down with .4. Agents that explore too little never see the large reward.

    Always swimming right is optimal in the long run: it earns .4286 a step, always swimming left
    .005. Since a constant action is optimal, the score says little here: look at the gap.

    ## Action Space
    `Discrete(2)`: 0 left, with the current; 1 right, against it.

    ## Observation Space
    `Discrete(n_states)`: from left to right.

    ## Rewards
    - left in the leftmost state: .005
    - right in the rightmost state: 1

    ## Starting State
    The leftmost.

    ## Episode End
    It never terminates. It is truncated after 20 steps when made by `gymnasium.make`.

    ## Arguments
    - `n_states=6`: the length of the river
    - `left_reward=0.005`, `right_reward=1`: see Rewards
    - `render_mode=None`: `"ansi"`, `"rgb_array"` or `"human"`
    """

    action_names: ClassVar[tuple[str, ...]] = ("left", "right")

    def __init__(
        self,
        n_states: int = 6,
        left_reward: float = 0.005,
        right_reward: float = 1,
        render_mode: str | None = None,
    ) -> None:
        self.n_states = check_whole_number("n_states", n_states, 2, MOST_STATES)
        self.left_reward = check_number("left_reward", left_reward)
        self.right_reward = check_number("right_reward", right_reward)
        self.rows = in_rows("S".ljust(self.n_states - 1, ".") + "G")
        super().__init__(self.n_states, 2, render_mode)

    def transition_model(self) -> TransitionModel:
        return _river(self.n_states, self.left_reward, self.right_reward)


@lru_cache(maxsize=4)
def _river(n: int, left_reward: float, right_reward: float) -> TransitionModel:
    prob = np.zeros((n, 2, 3))
    prob[:, LEFT] = 1, 0, 0
    prob[:, RIGHT] = 0.05, 0.6, 0.35
    prob[0, RIGHT] = 0, 0.4, 0.6
    prob[-1, RIGHT] = 0.4, 0.6, 0
    next_state = np.clip(np.arange(n)[:, None] + [-1, 0, 1], 0, n - 1)
    reward = np.zeros((n, 2))
    reward[0, LEFT], reward[-1, RIGHT] = left_reward, right_reward
    return TransitionModel(
        prob=prob,
        next_state=np.broadcast_to(next_state[:, None], prob.shape),
        reward=np.broadcast_to(reward[..., None], prob.shape),
        terminated=np.zeros(prob.shape, np.bool_),
        initial=np.eye(n)[0],
    )


class ShortCorridorEnv(MapEnv):
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

    ## Arguments
    - `render_mode=None`: `"ansi"`, `"rgb_array"` or `"human"`
    """

    rows = ("S..G",)
    action_names: ClassVar[tuple[str, ...]] = ("left", "right")

    def __init__(self, render_mode: str | None = None) -> None:
        super().__init__(GOAL + 1, 2, render_mode)
        self.observation_space = spaces.Discrete(1)

    def transition_model(self) -> TransitionModel:
        return _corridor()

    def observation_of(self, states: Any) -> NDArray[Any]:
        """Always 0: all states look alike."""
        return np.zeros_like(states)


@lru_cache(maxsize=1)
def _corridor() -> TransitionModel:
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


class MaximizationBiasEnv(MapEnv, MaskedFiniteEnv):
    """To the right no reward, to the left many actions that lose a little and often seem to win.

    ## Description
    Sutton and Barto (Reinforcement Learning, 2nd edition), example 6.7: an episode begins in A.
    Right ends it with a reward of 0. Left leads to B, from where each of many actions ends it with
    a reward that is normally distributed around -0.1. The largest of many estimates is too high, so
    that Q-learning goes left far more often than it should; double Q-learning does not.

    Right is optimal, at 0. Always going right earns as much without any learning, so the score says
    little here: what counts is how often an agent goes left while it learns.

    ## Action Space
    `Discrete(n_actions)`. In A, 0 is left and 1 is right; there `action_masks()` allows these two.
    An agent without masks may choose others: even ones are left, odd ones right. In B all are
    alike.

    ## Observation Space
    `Discrete(4)`: 1 is B and 2 is A; 0 the end after B, 3 the end to the right.

    ## Rewards
    0 for both actions in A. Each action in B: normally distributed, with mean -0.1 and standard
    deviation 1.

    ## Starting State
    A.

    ## Episode End
    The episode terminates after right, or after any action in B: two steps at most. The limit of
    100 steps that `gymnasium.make` sets is never reached.

    ## Information
    `reset` and `step` give nothing more. Each draws one uniform number, without effect; a step in B
    then a standard normal one for the reward. The model has the means of rewards, and the variance.

    ## Arguments
    - `n_actions=10`: the number of actions
    - `reward_mean=-0.1`, `reward_std=1`: of the rewards in B
    - `render_mode=None`: `"ansi"`, `"rgb_array"` or `"human"`
    """

    rows = ("G.SG",)
    action_names: ClassVar[tuple[str, ...]] = tuple(f"action {i}" for i in range(MOST_ACTIONS))

    def __init__(
        self,
        n_actions: int = 10,
        reward_mean: float = -0.1,
        reward_std: float = 1,
        render_mode: str | None = None,
    ) -> None:
        self.n_actions = check_whole_number("n_actions", n_actions, 2, MOST_ACTIONS)
        self.reward_mean = check_number("reward_mean", reward_mean)
        self.reward_std = check_number("reward_std", reward_std, 0)
        super().__init__(4, self.n_actions, render_mode)

    def transition_model(self) -> TransitionModel:
        return _two_states(self.n_actions, self.reward_mean, self.reward_std)

    def masks_of_states(self) -> Bools:
        masks = np.ones((4, self.n_actions), np.bool_)
        masks[A, 2:] = False
        return masks


@lru_cache(maxsize=4)
def _two_states(n: int, reward_mean: float, reward_std: float) -> TransitionModel:
    shape = (4, n, 1)
    next_state = np.zeros(shape, np.int64)
    next_state[RIGHT_END] = RIGHT_END
    next_state[A, :, 0] = np.where(np.arange(n) % 2 == 0, B, RIGHT_END)
    reward = np.zeros(shape)
    reward[B] = reward_mean
    return TransitionModel(
        prob=np.ones(shape),
        next_state=next_state,
        reward=reward,
        terminated=next_state != B,
        initial=np.eye(4)[A],
        reward_variance=reward_std**2 * (np.arange(4) == B)[:, None, None] * np.ones(shape),
    )
