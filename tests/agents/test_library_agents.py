"""Agents on the library's classes, by hand and against it; and the two that do not learn."""

import itertools

import gymnasium as gym
import numpy as np
import pytest
import sb3_contrib
import torch as th
from gymnasium import spaces
from stable_baselines3 import DQN
from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.env_util import make_vec_env
from stable_baselines3.common.type_aliases import ReplayBufferSamples
from torch import nn
from torch.nn.utils import parameters_to_vector

from rl_yardstick.agents.common.callbacks import EpisodeBudget
from rl_yardstick.agents.library import DeepQLearning, DoubleDQN, double_q_values
from rl_yardstick.agents.random_search import ARS
from rl_yardstick.agents.reference import AngleAgent, RandomAgent

SETTINGS = {"learning_starts": 50, "train_freq": 4, "batch_size": 16, "buffer_size": 500, "seed": 0}


def test_target_by_hand():
    online, target = nn.Linear(1, 3, bias=False), nn.Linear(1, 3, bias=False)
    with th.no_grad():
        online.weight[:] = th.tensor([[1.0], [3.0], [2.0]])
        target.weight[:] = th.tensor([[7.0], [-5.0], [9.0]])
        # For a positive observation the online network prefers action 1, for a negative one 0.
        values = double_q_values(online, target, th.tensor([[2.0], [-1.0]]))
    assert values.tolist() == [[-10.0], [-7.0]]


@pytest.mark.parametrize(
    ("discounts", "loss"),
    [
        # Errors -10 - 2 = -12 and 1 + 0.5 * 8 - 3 = 2: (144 + 4) / 2 / 2.
        (None, 37.0),
        # Returns of several steps bring their own discounts: 1 + 0.25 * 8 - 3 = 0.
        (th.tensor([[0.25], [0.25]]), 36.0),
    ],
)
def test_squared_loss_by_hand(discounts, loss):
    """Of a terminal transition and one that goes on; rewards are -10 and 1."""
    model = DeepQLearning("MlpPolicy", "FrozenLake-v1", gamma=0.5)
    model.q_net = lambda obs: th.tensor([[5.0, 2.0], [3.0, 4.0], [8.0, 7.0]])[obs[:, 0]]
    batch = ReplayBufferSamples(
        observations=th.tensor([[0], [1]]),
        actions=th.tensor([[1], [0]]),
        next_observations=th.tensor([[2], [2]]),
        dones=th.tensor([[1.0], [0.0]]),
        rewards=th.tensor([[-10.0], [1.0]]),
        discounts=discounts,
    )
    assert model._loss(batch).item() == loss


@pytest.mark.parametrize(
    ("algorithm", "env_id"),
    [
        # Synchronised before each update, the online network's best action is the target network's.
        (DoubleDQN, "CartPole-v1"),
        # Huber's loss is half the squared error below 1, which no error on the lake exceeds here.
        (DeepQLearning, "FrozenLake-v1"),
    ],
)  # fmt: skip
def test_where_it_is_dqn_to_the_bit(algorithm, env_id):
    arguments = {**SETTINGS, "exploration_fraction": 1, "target_update_interval": 1}
    models = [each("MlpPolicy", env_id, **arguments).learn(250) for each in (DQN, algorithm)]
    weights = [parameters_to_vector(model.q_net.parameters()) for model in models]
    assert th.equal(*weights)


class Ended(BaseCallback):
    """How many episodes ended on each call."""

    def __init__(self):
        super().__init__()
        self.counts = []

    def _on_step(self):
        self.counts.append(int(np.sum(self.locals["dones"])))
        return True


def ars(n_envs=1, env="CartPole-v1", **kwargs):
    env = make_vec_env(env, n_envs, seed=0)
    return ARS("LinearPolicy", env, **{"seed": 0, "n_delta": 2, **kwargs})


def test_a_budget_of_episodes_ends_the_search():
    ended = Ended()
    model = ars(2).learn(10**12, callback=[ended, EpisodeBudget(7)])
    assert sum(ended.counts) >= 7 > sum(ended.counts[:-1])
    assert model.num_timesteps == 2 * ended.n_calls


def test_what_was_loaded_goes_on_from_its_weights(tmp_path):
    """In the library the search begins at new random ones where zero_policy is off."""
    model = ars(zero_policy=False).learn(300)
    learnt, done = parameters_to_vector(model.policy.parameters()), model.num_timesteps
    assert learnt.abs().max() > 0
    assert th.equal(model.weights, learnt)
    model.save(tmp_path / "ars")
    loaded = ARS.load(tmp_path / "ars", env=model.get_env(), seed=1, learning_rate=0.0)
    assert th.equal(loaded.weights, learnt)
    loaded.learn(50, reset_num_timesteps=False)
    assert th.equal(parameters_to_vector(loaded.policy.parameters()), learnt)
    model.learn(300, reset_num_timesteps=False)  # schedules go on, too
    assert 0 < model._current_progress_remaining <= 1 - done / (done + 300)


def test_the_search_itself_is_the_librarys():
    ours = ars().learn(200)
    env = make_vec_env("CartPole-v1", 1, seed=0)
    theirs = sb3_contrib.ARS("LinearPolicy", env, seed=0, n_delta=2).learn(200)
    assert ours.num_timesteps == theirs.num_timesteps
    assert th.equal(ours.weights, theirs.weights)


N = 5000


class Still(gym.Env):
    """Nothing happens here, whatever is done."""

    observation_space = spaces.Discrete(1)

    def __init__(self, action_space):
        self.action_space = action_space


BOX = spaces.Box(np.array([-1, 0], np.float32), np.array([1, 10], np.float32))
NUMBERED = {  # a space: its shape, its options, and the number of the one that was chosen
    "Discrete": (spaces.Discrete(5), (), 5, lambda actions: actions),
    "MultiDiscrete": (spaces.MultiDiscrete([2, 3]), (2,), 6, lambda a: 3 * a[:, 0] + a[:, 1]),
    "Box": (BOX, (2,), 4, lambda a: np.floor((a - BOX.low) / [1, 5]).astype(int) @ [2, 1]),
}


@pytest.mark.parametrize("kind", NUMBERED)
def test_random_actions_are_uniform_and_follow_the_seed(kind):
    space, shape, n_options, number = NUMBERED[kind]

    def drawn():
        agent = RandomAgent("RandomPolicy", Still(space), seed=7)
        return agent.predict(np.zeros(N, dtype=np.int64), deterministic=False)[0]

    actions = drawn()
    assert actions.shape == (N, *shape)
    frequencies, share = np.bincount(number(actions), minlength=n_options) / N, 1 / n_options
    # Four standard errors of a frequency.
    np.testing.assert_allclose(frequencies, share, atol=4 * np.sqrt(share * (1 - share) / N))
    np.testing.assert_array_equal(drawn(), actions)


def test_the_cart_is_pushed_to_where_the_pole_leans():
    agent = AngleAgent("AnglePolicy", "CartPole-v1")
    # Whatever the position and the velocities say.
    for angle, others in itertools.product((-0.2, -1e-6, 0.0, 1e-6, 0.2), (-2.0, 2.0)):
        action, _ = agent.predict(np.array([others, others, angle, others], np.float32))
        assert action == (1 if angle > 0 else 0)
