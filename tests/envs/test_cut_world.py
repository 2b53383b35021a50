"""The model of bins: by hand, beside a loop with the equations of MountainCar, and when refused."""

import math
from itertools import islice, product

import gymnasium as gym
import numpy as np
import pytest
from gymnasium import spaces
from scipy.stats.qmc import Halton
from stable_baselines3.common.monitor import Monitor

from rl_yardstick.agents import load_algorithm
from rl_yardstick.envs import found_models
from rl_yardstick.envs.cut_world import cut_world
from rl_yardstick.envs.wrappers import DiscretizeObservation, ScaleReward
from rl_yardstick.mdp import value_iteration

STEPS = 0.1, 0.0251  # a whole bin of ten; and a little more than a quarter of one


class Slide(gym.Env):
    """Slide from 0 to 1, by either step; each costs 1, and the short ones 2 from the middle on."""

    observation_space = spaces.Box(0, 1, (1,))
    action_space = spaces.Discrete(2)

    def reset(self, **kwargs):
        super().reset(**kwargs)
        self.state = np.zeros(1)
        return self.state.astype(np.float32), {}

    def step(self, action):
        cost = 1 + (action == 1 and self.state[0] > 0.52)
        self.state += STEPS[action]  # in place
        seen = self.state.clip(0, 1).astype(np.float32)
        return seen, -float(cost), bool(self.state[0] >= 1 - 1e-9), False, {}


class Counting(Slide):
    """It ends after seven steps, which the state does not tell."""

    n_steps = 0

    def step(self, action):
        self.n_steps += 1
        seen, reward, ends, *others = super().step(action)
        return seen, reward, ends or self.n_steps % 7 == 0, *others


class Noisy(Slide):
    def step(self, action):
        self.state += self.np_random.normal(0, 0.01)
        return super().step(action)


class Covered(Slide):
    """The observation is not the state."""

    def step(self, action):
        return 1 - super().step(action)[0], 0.0, False, False, {}


class Nameless(gym.Env):
    """The state is in another object."""

    observation_space, action_space = Slide.observation_space, Slide.action_space

    def __init__(self):
        self.inner = Slide()
        self.reset, self.step = self.inner.reset, self.inner.step


def test_a_slide_by_hand():
    model = cut_world(DiscretizeObservation(ScaleReward(Slide(), 2.0), 10))
    assert (model.n_states, model.initial[0]) == (10, 1)
    for place in range(10):
        last = place == 9
        for action, chance in enumerate((1.0, 0.25)):  # of leaving the bin
            found = {}
            for k in range(model.n_outcomes):
                there = (
                    int(model.next_state[place, action, k]),
                    bool(model.terminated[place, action, k]),
                )
                found[there] = found.get(there, 0) + model.prob[place, action, k]
            stays = {(place, False): 1 - chance} if chance < 1 else {}
            expected = {**stays, (9 if last else place + 1, last): chance}
            assert {there: p for there, p in found.items() if p} == pytest.approx(expected)
    # Four fifths of bin 5 lie beyond 0.52; ScaleReward doubles all rewards.
    short = [-2.0] * 5 + [-2 * (0.2 + 0.8 * 2)] + [-4.0] * 4
    assert model.expected_reward[:, 0] == pytest.approx(np.full(10, -2.0))
    assert model.expected_reward[:, 1] == pytest.approx(short, abs=0.11)
    assert value_iteration(model, 1.0).start_value == pytest.approx(-20)


def car_after(position, velocity, action):
    """MountainCar's equations (Moore, 1990), as its documentation gives them."""
    velocity += (action - 1) * 0.001 - math.cos(3 * position) * 0.0025
    velocity = min(max(velocity, -0.07), 0.07)
    position = min(max(position + velocity, -1.2), 0.6)
    return position, 0.0 if position == -1.2 and velocity < 0 else velocity


def bin_of_car(position, velocity, n):
    place = int((position + 1.2) / 1.8 * n), int((velocity + 0.07) / 0.14 * n)
    return min(place[0], n - 1) * n + min(place[1], n - 1)


def planned_by_loops(n, discount):
    """The chances of each next bin (None: the goal), and the best values."""
    chances, points = {}, iter(Halton(2, scramble=False).random(20 * n**2))
    for x, v in product(range(n), repeat=2):
        for across, up in islice(points, 20):
            position, velocity = -1.2 + 1.8 * (x + across) / n, -0.07 + 0.14 * (v + up) / n
            for action in range(3):
                after = car_after(position, velocity, action)
                there = None if after[0] >= 0.5 and after[1] >= 0 else bin_of_car(*after, n)
                found = chances.setdefault((x * n + v, action), {})
                found[there] = found.get(there, 0) + 1 / 20
    values = [0.0] * n**2
    for _ in range(200):
        for state in range(n**2):
            returns = []
            for action in range(3):
                goes_on = [(t, p) for t, p in chances[state, action].items() if t is not None]
                returns.append(-1 + discount * sum(p * values[t] for t, p in goes_on))
            values[state] = max(returns)
    return chances, values


def test_mountain_car_beside_a_loop():
    model = cut_world(DiscretizeObservation(gym.make("MountainCar-v0"), 6))
    chances, values = planned_by_loops(6, 0.9)
    for (state, action), expected in chances.items():
        found = {}
        for k in np.flatnonzero(model.prob[state, action]):
            ends = model.terminated[state, action, k]
            there = None if ends else int(model.next_state[state, action, k])
            found[there] = found.get(there, 0.0) + model.prob[state, action, k]
        assert found == pytest.approx(expected)
    plan = value_iteration(model, 0.9)
    assert plan.values[model.reachable] == pytest.approx(np.array(values)[model.reachable])
    # Starts lie between -0.6 and -0.4, at rest.
    assert model.initial[2 * 6 + 3] == pytest.approx(1)


SWING = {"bins": 7, "low": [-2.4, -2, -0.2095, -2], "high": [2.4, 2, 0.2095, 2]}
PLANS = [  # environment, into how many its actions are cut, its bins, and the least mean return
    ("CartPole-v1", None, SWING, 300),
    ("MountainCar-v0", None, {"bins": 40}, -115),
    ("Pendulum-v1", 5, {"bins": [11, 11, 21]}, -450),  # a random torque: about -1,200
]


@pytest.mark.parametrize(("env_id", "n_actions", "cut", "least"), PLANS)
def test_what_plans_return_in_the_real_world(env_id, n_actions, cut, least):
    env = gym.make(env_id)
    env = env if n_actions is None else gym.wrappers.DiscretizeAction(env, n_actions)
    env = Monitor(DiscretizeObservation(env, **cut))
    env.reset(seed=7)
    before = env.unwrapped.np_random.bit_generator.state, list(env.unwrapped.state)
    model = cut_world(env)
    assert (env.unwrapped.np_random.bit_generator.state, list(env.unwrapped.state)) == before
    assert env.get_episode_lengths() == []
    if env_id == "Pendulum-v1":  # every bin that is reached has points; no episode terminates
        assert not (model.terminated & (model.prob > 0))[model.reachable].any()
    policy, returns = value_iteration(model, 0.99).policy, []
    for seed in range(20):
        seen, total, over = env.reset(seed=seed)[0], 0.0, False
        while not over:
            seen, reward, terminated, truncated, _ = env.step(policy[seen])
            total, over = total + reward, terminated or truncated
        returns.append(total)
    assert np.mean(returns) > least


ON_MORE = "depend on more than its attribute state"
REFUSED = {
    "a hidden counter": (Counting, 10, ON_MORE),
    "noise": (Noisy, 10, ON_MORE),
    "another observation": (Covered, 10, ON_MORE),
    "no state": (Nameless, 10, "it has no attribute state of numbers"),
    "many bins": (Slide, 500_001, "500,001 bins are more than 500,000"),
    "a wrapper": (lambda: gym.wrappers.NormalizeReward(Slide()), 9, "effect of NormalizeReward"),
}


@pytest.mark.parametrize("name", REFUSED)
def test_what_cannot_be_cut(name):
    make, bins, reason = REFUSED[name]
    found_models.limit("none")  # it would find the exact model of the slide
    with pytest.raises(ValueError, match=f"plans on bins where .* classic control: .*{reason}"):
        load_algorithm("value_iteration")(env=DiscretizeObservation(make(), bins)).learn(1)
    found_models.limit("auto")
    assert cut_world(make()) is None
