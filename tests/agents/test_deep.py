"""Double DQN: its target by hand, and DQN's own update wherever the two agree."""

import numpy as np
import pytest
import torch as th
from stable_baselines3 import DQN
from torch import nn

from agents.deep import DoubleDQN, double_q_values

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
