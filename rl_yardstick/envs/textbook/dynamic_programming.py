"""The gambler's problem and Jack's car rental, the book's examples of dynamic programming."""

from __future__ import annotations

import math
from functools import lru_cache
from typing import ClassVar

import numpy as np

from rl_yardstick.envs.argument_checks import check_choice, check_number, check_whole_number
from rl_yardstick.envs.drawing import Bar, Bars
from rl_yardstick.envs.finite_env import MaskedFiniteEnv, summing_to_one
from rl_yardstick.mdp.transition_model import Bools, Floats, Ints, TransitionModel

LARGEST_GOAL = 2000  # of the gambler
# Of the car rental.
MOST_CARS = 20
MOST_MOVED = 5
# Expected a day, at the first place and at the second.
REQUESTS = (3, 4)
RETURNS = (3, 2)
CREDIT = 10
MOVE_COST = 2
# Of the exercise: more cars than this need a second lot.
FREE_PARKING = 10
PARKING_COST = 4
VARIANTS = ("example", "exercise")
N_SIDE = MOST_CARS + 1


class GamblersProblemEnv(MaskedFiniteEnv):
    """Stakes on a coin that comes up heads with a known probability: all at once, or a little?

    ## Description
    Sutton and Barto (Reinforcement Learning, 2nd edition), example 4.3: a gambler wins the stake if
    the coin comes up heads, else loses it, and goes on until the capital is 100, or gone. The value
    of a capital is the probability to reach 100. With heads in 40 of 100 throws it is .4 for a
    capital of 50 and .16 for 25; staking as much as allowed is then optimal, as are many other
    policies.

    ## Action Space
    `Discrete(goal // 2 + 1)`: the stake, at most the capital, and at most what is missing to the
    goal, as `action_masks()` says. A larger stake counts as 0, which is allowed and changes
    nothing.

    ## Observation Space
    `Discrete(goal + 1)`: the capital.

    ## Rewards
    1 for reaching the goal, else 0.

    ## Starting State
    A capital of 1 to `goal - 1`, all with equal probability; with `start_capital` that one.

    ## Episode End
    The episode terminates when the capital is 0 or the goal. It is truncated after 1000 steps when
    made by `gymnasium.make`.

    ## Information
    `reset` and `step` give nothing more. One uniform number is drawn by each: it is heads if it
    lies below `heads_probability`.

    ## Arguments
    - `heads_probability=0.4`: of the coin
    - `goal=100`: the capital to reach, 2 or more
    - `start_capital=None`: see Starting State
    - `render_mode=None`: `"ansi"`, `"rgb_array"` or `"human"`
    """

    def __init__(
        self,
        heads_probability: float = 0.4,
        goal: int = 100,
        start_capital: int | None = None,
        render_mode: str | None = None,
    ) -> None:
        self.heads_probability = check_number("heads_probability", heads_probability, 0, 1)
        self.goal = check_whole_number("goal", goal, 2, LARGEST_GOAL)
        if start_capital is not None:
            start_capital = check_whole_number("start_capital", start_capital, 1, self.goal - 1)
        self.start_capital = start_capital
        super().__init__(self.goal + 1, self.goal // 2 + 1, render_mode)

    def transition_model(self) -> TransitionModel:
        return _gamble(self.heads_probability, self.goal, self.start_capital)

    def masks_of_states(self) -> Bools:
        return allowed_stakes(self.goal)

    def _picture(self) -> Bars:
        title = "start" if self.last_action is None else f"stake {self.last_action}"
        return Bars(title, [Bar("capital", self.s, f"{self.s} of {self.goal}")], 0, self.goal)


def allowed_stakes(goal: int) -> Bools:
    """The allowed stakes at each capital, bool of shape (goal + 1, goal // 2 + 1)."""
    capital = np.arange(goal + 1)[:, None]
    allowed: Bools = np.arange(goal // 2 + 1) <= np.minimum(capital, goal - capital)
    return allowed


@lru_cache(maxsize=4)
def _gamble(heads: float, goal: int, start: int | None) -> TransitionModel:
    capital = np.arange(goal + 1)[:, None]
    stake = np.where(allowed_stakes(goal), np.arange(goal // 2 + 1), 0)
    next_state = np.stack([capital + stake, capital - stake], axis=2)
    over = (capital == 0) | (capital == goal)
    reward = ((next_state == goal) & ~over[..., None]).astype(np.float64)
    initial = np.zeros(goal + 1)
    initial[1:goal] = summing_to_one(np.full(goal - 1, 1 / (goal - 1)))
    return TransitionModel(
        prob=np.broadcast_to([heads, 1 - heads], next_state.shape),
        next_state=next_state,
        reward=reward,
        terminated=(next_state == 0) | (next_state == goal),
        initial=initial if start is None else np.eye(goal + 1)[start],
    )


class JacksCarRentalEnv(MaskedFiniteEnv):
    """Cars are rented out at two places, and moved between them so that few customers go away.

    ## Description
    Sutton and Barto (Reinforcement Learning, 2nd edition), example 4.2. In the evening Jack moves
    up to five cars from one place to the other, at 2 dollars each. The next day's numbers of
    customers are Poisson variables, with means 3 at the first place and 4 at the second; each rents
    a car for 10 dollars, if there is one. So are the numbers of cars that come back, with means 3
    and 2; these can be rented the day after. Each place has room for 20 cars: any more are gone.

    With `variant="exercise"` (exercise 4.7) one of the cars that are moved from the first place to
    the second is moved free of charge, and a place with more than 10 cars overnight, after moving,
    costs 4 dollars.

    It is a continuing task, which the book discounts by .9: 20 cars at each place are worth 636.99
    dollars then, and none at either 421.41. (Figure 4.2 reads 612 and 420. With Poisson variables
    cut off after 10 it would be 618 and 406.) Here an episode is 100 days, and what counts is what
    Jack earns in them, undiscounted: 5,068 dollars at most, and 5,007 by the policy that is optimal
    with the book's discount.

    ## Action Space
    `Discrete(11)`: 5 plus the number of cars to move from the first place to the second; below 5
    cars go the other way. `action_masks()` allows no more than are there; an action that asks for
    more moves all of them.

    ## Observation Space
    `Discrete(441)`: 21 times the cars at the first place plus those at the second, in the evening.

    ## Rewards
    10 for each car rented out, minus 2 for each car moved, and in the exercise minus the parking.

    ## Starting State
    10 cars at each place, or as `first_cars` and `second_cars` say.

    ## Episode End
    It never terminates. It is truncated after 100 steps when made by `gymnasium.make`.

    ## Information
    `reset` and `step` give nothing more. `reset` draws one uniform number, without effect; a step
    draws four Poisson numbers: requests at the first place and at the second, and returns likewise.
    The model is exact: Poisson variables are not cut off, since all numbers beyond a limit have the
    same effect. Its rewards are means, given the cars of two evenings; it has their variance too.

    ## Arguments
    - `variant="example"`: or `"exercise"`
    - `first_cars=10`, `second_cars=10`: in the first evening
    - `render_mode=None`: `"ansi"`, `"rgb_array"` or `"human"`
    """

    action_names: ClassVar[tuple[str, ...]] = tuple(
        f"move {n:+d}" for n in range(-MOST_MOVED, MOST_MOVED + 1)
    )

    def __init__(
        self,
        variant: str = "example",
        first_cars: int = 10,
        second_cars: int = 10,
        render_mode: str | None = None,
    ) -> None:
        self.variant = check_choice("variant", variant, VARIANTS)
        self.first_cars = check_whole_number("first_cars", first_cars, 0, MOST_CARS)
        self.second_cars = check_whole_number("second_cars", second_cars, 0, MOST_CARS)
        super().__init__(N_SIDE**2, 2 * MOST_MOVED + 1, render_mode)

    def transition_model(self) -> TransitionModel:
        return _rental(self.variant, self.first_cars * N_SIDE + self.second_cars)

    def masks_of_states(self) -> Bools:
        first, second = np.divmod(np.arange(N_SIDE**2)[:, None], N_SIDE)
        moved = np.arange(-MOST_MOVED, MOST_MOVED + 1)
        allowed: Bools = (moved <= first) & (-moved <= second)
        return allowed

    def _draw(self, action: int) -> tuple[int, float, bool]:
        after, cost = _evenings(self.variant)
        earned, evening = -float(cost[self.s, action]), []
        asked = [int(self.np_random.poisson(mean)) for mean in REQUESTS]
        returned = [int(self.np_random.poisson(mean)) for mean in RETURNS]
        for cars, wanted, back in zip(after[self.s, action].tolist(), asked, returned, strict=True):
            rented = min(wanted, cars)
            earned += CREDIT * rented
            evening.append(min(cars - rented + back, MOST_CARS))
        return evening[0] * N_SIDE + evening[1], earned, False

    def _picture(self) -> Bars:
        moved = None if self.last_action is None else self.last_action - MOST_MOVED
        title = "start" if moved is None else f"moved {moved:+d}"
        names = "cars at the first place", "cars at the second place"
        cars = zip(names, divmod(self.s, N_SIDE), strict=True)
        bars = [Bar(name, n, f"{n:2} of {MOST_CARS}") for name, n in cars]
        return Bars(title, bars, 0, MOST_CARS)


@lru_cache(maxsize=2)
def _evenings(variant: str) -> tuple[Ints, Floats]:
    """The cars at both places after moving, shape (S, A, 2), and what the evening costs, (S, A)."""
    first, second = np.divmod(np.arange(N_SIDE**2)[:, None], N_SIDE)
    wanted = np.arange(-MOST_MOVED, MOST_MOVED + 1)
    moved = np.clip(wanted, -second, first)
    cars = np.minimum(np.stack([first - moved, second + moved], axis=2), MOST_CARS)
    if variant == "example":
        return cars, (MOVE_COST * np.abs(moved)).astype(np.float64)
    paid = np.abs(moved) - (moved > 0)
    return cars, MOVE_COST * paid + PARKING_COST * (cars > FREE_PARKING).sum(axis=2).astype(float)


def poisson(mean: float, most: int) -> Floats:
    """Probabilities of 0, 1, ..., most - 1, and of ``most`` or more, shape (most + 1,)."""
    found = [math.exp(-mean) * mean**n / math.factorial(n) for n in range(most)]
    return np.array([*found, max(1 - math.fsum(found), 0.0)])


def _day(requests: float, returns: float) -> tuple[Floats, Floats, Floats]:
    """Outcomes of a day at one place, by the cars in the morning and in the evening, (21, 21).

    The probability of the evening, and mean and variance of the cars rented out.
    """
    joint = np.zeros((N_SIDE, N_SIDE, N_SIDE))  # morning, rented, evening
    for cars in range(N_SIDE):
        for rented, chance in enumerate(poisson(requests, cars)):
            left = cars - rented
            joint[cars, rented, left:] = chance * poisson(returns, MOST_CARS - left)
    prob = joint.sum(axis=1)
    counts = np.arange(N_SIDE)[:, None]
    mean = (joint * counts).sum(axis=1) / prob
    variance = (joint * (counts - mean[:, None]) ** 2).sum(axis=1) / prob
    return prob, mean, variance


@lru_cache(maxsize=2)
def _rental(variant: str, start: int) -> TransitionModel:
    cars, cost = _evenings(variant)
    days = [_day(*means) for means in zip(REQUESTS, RETURNS, strict=True)]
    # By the morning's cars at the first place and at the second, and the evening's likewise.
    (first, mean, variance), (second, mean_2, variance_2) = (
        [column[cars[..., place]] for column in day] for place, day in enumerate(days)
    )
    shape = (*cost.shape, N_SIDE**2)
    prob = (first[..., :, None] * second[..., None, :]).reshape(shape)
    rented = (mean[..., :, None] + mean_2[..., None, :]).reshape(shape)
    spread = (variance[..., :, None] + variance_2[..., None, :]).reshape(shape)
    return TransitionModel(
        prob=prob,
        next_state=np.broadcast_to(np.arange(N_SIDE**2, dtype=np.int32), shape),
        reward=CREDIT * rented - cost[..., None],
        terminated=np.zeros(shape, np.bool_),
        initial=np.eye(N_SIDE**2)[start],
        reward_variance=CREDIT**2 * spread,
    )
