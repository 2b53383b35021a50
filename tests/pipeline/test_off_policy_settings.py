"""Settings of agents with continuous actions and a replay buffer do what they say."""

import gymnasium as gym
import numpy as np
import pytest
import torch as th
from rich.console import Console
from stable_baselines3 import HerReplayBuffer
from stable_baselines3.common.envs import BitFlippingEnv
from stable_baselines3.common.noise import VectorizedActionNoise

from pipeline.settings.hyperparams import split
from pipeline.train_spec import TrainSpec
from pipeline.training import carry_out, prepare

TINY = {"policy": "MlpPolicy", "policy_kwargs": {"net_arch": [4]}, "buffer_size": 1000}


def prepared(folder, algo, env_id, **entry):
    entry = {**TINY, **entry}
    spec = TrainSpec(
        algo, env_id, split(entry), entry, seed=0, log_folder=folder, eval_freq=-1, pictures=False
    )
    return prepare(spec, Console(quiet=True), {}, "train.py")


@pytest.mark.parametrize("n_envs", [1, 2])
def test_noise_is_added_to_what_the_policy_does(tmp_path, n_envs):
    """A policy that learns nothing, and its actions as they stand in the buffer."""
    noise = {"noise_type": "normal", "noise_std": 0.1}
    still = {"learning_rate": 0.0, "learning_starts": 0, "n_timesteps": 500 * n_envs}
    training = prepared(tmp_path, "td3", "Pendulum-v1", n_envs=n_envs, **noise, **still)
    carry_out(training)
    model = training.model
    assert isinstance(model.action_noise, VectorizedActionNoise) == (n_envs > 1)
    buffer = model.replay_buffer
    observations = buffer.observations[:400].reshape(-1, 3)
    without = model.policy.scale_action(model.predict(observations, deterministic=True)[0])
    added = buffer.actions[:400].reshape(-1, 1) - without
    # Where the sum would leave [-1, 1] it is cut off: a policy near 0, so hardly anywhere.
    assert np.abs(without).max() < 0.6
    assert added.std() == pytest.approx(0.1, rel=0.1)
    assert added.mean() == pytest.approx(0, abs=0.02)


def test_without_noise_there_is_none(tmp_path):
    training = prepared(tmp_path, "td3", "Pendulum-v1", n_timesteps=10)
    assert training.model.action_noise is None
    training.model.env.close()


def test_hindsight_replay_as_rl_zoo3_writes_it(tmp_path):
    """Its entry for robots, on an environment with goals that needs no robot."""
    gym.register(
        "BitFlipping-v0", lambda: BitFlippingEnv(n_bits=3, continuous=True), max_episode_steps=3
    )
    try:
        training = prepared(
            tmp_path,
            "sac",
            "BitFlipping-v0",
            n_timesteps=60,
            policy="MultiInputPolicy",
            learning_starts=20,
            train_freq=[1, "episode"],
            gradient_steps=-1,
            replay_buffer_class="HerReplayBuffer",
            replay_buffer_kwargs=("dict(goal_selection_strategy='future', n_sampled_goal=4)"),
        )
        outcome = carry_out(training)
    finally:
        del gym.registry["BitFlipping-v0"]
    assert outcome.state == "finished"
    assert isinstance(training.model.replay_buffer, HerReplayBuffer)
    assert training.model.replay_buffer.her_ratio == 0.8
    # As many updates as steps, after whole episodes.
    assert 0 < training.model._n_updates <= 60


# --- faster networks -----------------------------------------------------------------------------


@pytest.mark.parametrize("fused", [True, False])
def test_a_fused_optimizer_is_a_matter_of_settings(tmp_path, fused):
    policy_kwargs = {"net_arch": [4], "optimizer_kwargs": {"fused": fused}}
    training = prepared(tmp_path, "dqn", "CartPole-v1", n_timesteps=10, policy_kwargs=policy_kwargs)
    assert training.model.policy.optimizer.defaults["fused"] is fused
    training.model.env.close()


def test_denormals_are_flushed_in_the_runs_that_ask_for_it(tmp_path):
    def halved():
        return float(th.tensor([1.5e-38]) / 2)

    try:
        for flushes in (True, False):
            training = prepared(
                tmp_path, "dqn", "CartPole-v1", n_timesteps=10, flush_denormal=flushes
            )
            training.model.env.close()
            assert (halved() == 0) is flushes
    finally:
        th.set_flush_denormal(False)
