"""Deep agents: targets and losses by hand, and DQN's own update wherever they agree."""

import numpy as np
import pytest
import torch as th
from stable_baselines3 import DQN
from stable_baselines3.common.type_aliases import ReplayBufferSamples
from torch import nn

from agents.library import DeepQLearning, DoubleDQN, double_q_values

SETTINGS = {"learning_starts": 50, "train_freq": 4, "batch_size": 16, "buffer_size": 500, "seed": 0}


def test_target_by_hand():
    online, target = nn.Linear(1, 3, bias=False), nn.Linear(1, 3, bias=False)
    with th.no_grad():
        online.weight[:] = th.tensor([[1.0], [3.0], [2.0]])
        target.weight[:] = th.tensor([[7.0], [-5.0], [9.0]])
        # For a positive observation the online network prefers action 1, for a negative one 0.
        values = double_q_values(online, target, th.tensor([[2.0], [-1.0]]))
    assert values.tolist() == [[-10.0], [-7.0]]


def weights(model):
    return th.cat([parameter.flatten() for parameter in model.q_net.parameters()])


def test_equals_dqn_while_target_and_online_network_are_the_same():
    # Synchronised before each update, the online network's best action is the target network's.
    arguments = {**SETTINGS, "target_update_interval": 1, "gradient_steps": 1}
    models = [
        algorithm("MlpPolicy", "CartPole-v1", **arguments).learn(400)
        for algorithm in (DQN, DoubleDQN)
    ]
    assert th.equal(weights(models[0]), weights(models[1]))


def test_differs_from_dqn_where_they_are_not():
    arguments = {**SETTINGS, "target_update_interval": 10_000, "learning_rate": 0.01}
    models = [
        algorithm("MlpPolicy", "CartPole-v1", **arguments).learn(600)
        for algorithm in (DQN, DoubleDQN)
    ]
    assert not th.equal(weights(models[0]), weights(models[1]))


def test_target_network_is_given_back_after_a_failure():
    model = DoubleDQN("MlpPolicy", "CartPole-v1", **SETTINGS).learn(100)
    target = model.q_net_target
    model.replay_buffer.reset()
    with pytest.raises(ValueError, match="high <= 0"):
        model.train(gradient_steps=1)
    assert model.q_net_target is target


def test_zip_brings_it_back(tmp_path):
    model = DoubleDQN("MlpPolicy", "CartPole-v1", **SETTINGS).learn(200)
    model.save(tmp_path / "agent")
    loaded = DoubleDQN.load(tmp_path / "agent")
    observations = np.random.default_rng(0).normal(size=(50, 4)).astype(np.float32)
    np.testing.assert_array_equal(
        loaded.predict(observations, deterministic=True)[0],
        model.predict(observations, deterministic=True)[0],
    )


def batch_of_two(discounts=None):
    """A terminal transition and one that goes on; rewards are -10 and 1."""
    return ReplayBufferSamples(
        observations=th.tensor([[0], [1]]),
        actions=th.tensor([[1], [0]]),
        next_observations=th.tensor([[2], [2]]),
        dones=th.tensor([[1.0], [0.0]]),
        rewards=th.tensor([[-10.0], [1.0]]),
        discounts=discounts,
    )


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
    model = DeepQLearning("MlpPolicy", "FrozenLake-v1", gamma=0.5)
    model.q_net = lambda obs: th.tensor([[5.0, 2.0], [3.0, 4.0], [8.0, 7.0]])[obs[:, 0]]
    assert model._loss(batch_of_two(discounts)).item() == loss


def lake_weights(algorithm, **arguments):
    arguments = {**SETTINGS, "target_update_interval": 1, "exploration_fraction": 1, **arguments}
    model = algorithm("MlpPolicy", "FrozenLake-v1", **arguments)
    return weights(model.learn(600))


def test_deep_qlearning_equals_dqn_while_errors_are_small_and_the_target_is_fresh():
    # Huber's loss is half the squared error below 1, which no error on the lake exceeds here.
    dqn, deep_qlearning = (
        lake_weights(algorithm, gradient_steps=1) for algorithm in (DQN, DeepQLearning)
    )
    assert th.equal(dqn, deep_qlearning)


def test_deep_qlearning_takes_its_target_from_the_network_at_that_update():
    # Of two updates in a row DQN's second aims at what the network was before the first.
    dqn, deep_qlearning = (
        lake_weights(algorithm, gradient_steps=2) for algorithm in (DQN, DeepQLearning)
    )
    assert not th.equal(dqn, deep_qlearning)


def test_dqn_without_replay_is_a_matter_of_hyperparameters():
    # A buffer of one transition, learnt from at every step.
    model = DQN(
        "MlpPolicy",
        "FrozenLake-v1",
        buffer_size=1,
        batch_size=1,
        train_freq=1,
        learning_starts=0,
        seed=0,
    ).learn(50)
    assert model._n_updates == 50
    assert model.replay_buffer.observations.shape[0] == 1
