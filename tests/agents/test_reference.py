"""The agents that do not learn do what they say, as often as they should."""

import gymnasium as gym
import numpy as np
import pytest
from gymnasium import spaces
from stable_baselines3.common.env_util import make_vec_env
from stable_baselines3.common.evaluation import evaluate_policy

from agents.reference import AngleAgent, RandomAgent

N = 20_000


class Still(gym.Env):
    """Nothing happens here, whatever is done."""

    observation_space = spaces.Discrete(1)

    def __init__(self, action_space):
        self.action_space = action_space

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        return 0, {}

    def step(self, action):
        return 0, 0.0, False, False, {}


def random_actions(action_space, n=N, seed=0, **kwargs):
    agent = RandomAgent("RandomPolicy", Still(action_space), seed=seed)
    actions, state = agent.predict(np.zeros(n, dtype=np.int64), **kwargs)
    assert state is None
    return actions


def assert_uniform(choices, n_options):
    frequencies = np.bincount(choices, minlength=n_options) / len(choices)
    share = 1 / n_options
    # Four standard errors of a frequency.
    tolerance = 4 * np.sqrt(share * (1 - share) / len(choices))
    np.testing.assert_allclose(frequencies, share, atol=tolerance)


@pytest.mark.parametrize("deterministic", [True, False])
def test_random_choices_are_uniform(deterministic):
    actions = random_actions(spaces.Discrete(5), deterministic=deterministic)
    assert actions.shape == (N,)
    assert_uniform(actions, 5)
    # And each is independent of the one before.
    assert_uniform(5 * actions[:-1] + actions[1:], 25)


def test_random_choices_of_several_parts_are_uniform_and_independent():
    actions = random_actions(spaces.MultiDiscrete([2, 3]))
    assert actions.shape == (N, 2)
    assert_uniform(3 * actions[:, 0] + actions[:, 1], 6)


def test_random_bits_are_uniform_and_independent():
    actions = random_actions(spaces.MultiBinary(3))
    assert_uniform(actions @ np.array([4, 2, 1]), 8)


def test_random_numbers_are_uniform_between_their_bounds():
    space = spaces.Box(np.array([-1, 0], np.float32), np.array([1, 10], np.float32))
    actions = random_actions(space)
    assert actions.shape == (N, 2)
    tenths = np.floor((actions - space.low) / (space.high - space.low) * 10).astype(int)
    assert_uniform(np.minimum(tenths[:, 0], 9), 10)
    assert_uniform(np.minimum(tenths[:, 1], 9), 10)


SPACES = [
    spaces.Discrete(5),
    spaces.MultiDiscrete([2, 3]),
    spaces.MultiBinary(3),
    spaces.Box(-1, 1, (2,)),
]


@pytest.mark.parametrize("space", SPACES, ids=lambda space: type(space).__name__)
def test_random_actions_follow_the_seed(space):
    first, again = (random_actions(space, 100, seed=7) for _ in range(2))
    np.testing.assert_array_equal(again, first)
    assert (random_actions(space, 100, seed=8) != first).any()


def test_one_observation_gets_one_action():
    agent = RandomAgent("RandomPolicy", Still(spaces.Discrete(5)), seed=0)
    action, _ = agent.predict(0)
    assert action.shape == ()
    agent = RandomAgent("RandomPolicy", Still(spaces.MultiDiscrete([2, 3])), seed=0)
    action, _ = agent.predict(0)
    assert action.shape == (2,)


@pytest.mark.parametrize("angle", [-0.2, -1e-6, 0.0, 1e-6, 0.2])
def test_the_cart_is_pushed_to_where_the_pole_leans(angle):
    agent = AngleAgent("AnglePolicy", "CartPole-v1")
    # Whatever the position and the velocities say.
    for others in (-2.0, 0.0, 2.0):
        action, _ = agent.predict(np.array([others, others, angle, others], np.float32))
        assert action == (1 if angle > 0 else 0)


@pytest.mark.parametrize(
    ("agent_class", "policy", "mean", "std"),
    [(AngleAgent, "AnglePolicy", 42.1, 8.8), (RandomAgent, "RandomPolicy", 22.3, 11.9)],
)
def test_returns_on_cartpole(agent_class, policy, mean, std):
    """Mean and standard deviation of an episode as measured over 1000 episodes elsewhere."""
    env = make_vec_env("CartPole-v1", 50, seed=0)
    agent = agent_class(policy, env, seed=0)
    returns, lengths = evaluate_policy(agent, env, 1000, return_episode_rewards=True)
    assert returns == lengths
    assert np.mean(returns) == pytest.approx(mean, abs=3 * std / np.sqrt(1000))
    assert np.std(returns) == pytest.approx(std, rel=0.2)
