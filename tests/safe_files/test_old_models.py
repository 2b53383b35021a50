"""Models, buffers and statistics that old versions of the library really saved.

`old_models/make.py` made them. Beside each lie observations, and the actions of that version.
"""

import io
import pickle
import zipfile
from pathlib import Path

import gymnasium as gym
import numpy as np
import pytest
import sb3_contrib as contrib
import stable_baselines3 as sb3
import torch as th
from stable_baselines3.common.env_util import make_vec_env
from stable_baselines3.common.envs import BitFlippingEnv
from stable_baselines3.common.vec_env import VecNormalize

from rl_yardstick.pipeline.models import Model, load_agent
from rl_yardstick.safe_files.buffers_and_statistics import (
    load_replay_buffer,
    load_vec_normalize,
    read_normalization,
)
from rl_yardstick.safe_files.files import UnsafeFileError
from rl_yardstick.safe_files.models import load_model
from tests.pipeline.short_runs import CART, SWING, spec_of

FOLDER = Path(__file__).parent / "old_models"
ALGOS = {path.stem: path.stem.rsplit("_", 1)[0] for path in FOLDER.glob("*.npz")}
ALGOS |= {"a2c_shared_1.6.2": "a2c", "dqn_hindsight_1.6.2": "dqn", "td3_noise_1.6.2": "td3"}


def played(name, path=None):
    return load_agent(Model(path or FOLDER / f"{name}.zip", spec_of(ALGOS[name]), None, None))


def as_streams(path, target):
    """The zip as PyTorch would have written it before version 1.6."""
    with zipfile.ZipFile(path) as whole, zipfile.ZipFile(target, "w") as old:
        for member in whole.namelist():
            content = whole.read(member)
            if member.endswith(".pth"):
                held = th.load(io.BytesIO(content))
                file = io.BytesIO()
                th.save(held, file, _use_new_zipfile_serialization=False)
                content = file.getvalue()
            old.writestr(member, content)
    return target


@pytest.mark.parametrize("name", sorted(ALGOS))
def test_an_old_model_plays_as_it_did(name, tmp_path):
    with np.load(FOLDER / f"{name}.npz") as saved:
        actions, seen = saved["actions"], {key: saved[key] for key in saved if key != "actions"}
    rows = [{key: array[i] for key, array in seen.items()} for i in range(len(actions))]
    for path in (None, as_streams(FOLDER / f"{name}.zip", tmp_path / "stream.zip")):
        agent = played(name, path)
        found = np.array([agent.predict(row.get("", row), deterministic=True)[0] for row in rows])
        assert found.dtype == actions.dtype
        np.testing.assert_array_equal(found, actions)


def test_layers_that_actor_and_critic_share_are_played_but_not_trained():
    path = FOLDER / "a2c_shared_1.6.2.zip"
    with pytest.raises(UnsafeFileError, match="it can be played, but not trained further"):
        load_model(sb3.A2C, path)
    with zipfile.ZipFile(path) as file:
        was = th.load(io.BytesIO(file.read("policy.pth")))
    policy = load_model(sb3.A2C, path, learning_rate=0.0, device="cpu").policy
    obs = th.as_tensor(np.load(path.with_suffix(".npz"))[""])
    shared = obs
    for layer in ("shared_net.0", "shared_net.2", "value_net.0"):
        weight, bias = (was[f"mlp_extractor.{layer}.{kind}"] for kind in ("weight", "bias"))
        shared = th.relu(shared @ weight.T + bias)
    values = shared @ was["value_net.weight"].T + was["value_net.bias"]
    assert th.allclose(policy.predict_values(obs), values, atol=1e-6)


def test_old_noise_goes_on_training():
    env = gym.make(SWING)
    agent = load_model(sb3.TD3, FOLDER / "td3_noise_1.6.2.zip", env, device="cpu")
    assert agent.action_noise is not None
    before = agent.num_timesteps
    agent.learn(20, reset_num_timesteps=False)
    assert agent.num_timesteps == before + 200  # it learns after whole episodes


@pytest.mark.filterwarnings("ignore:You are probably loading a DQN model saved with:UserWarning")
def test_an_old_replay_buffer_is_read_or_refused_in_one_line():
    path, given = FOLDER / "qrdqn_1.8.0.zip", {"device": "cpu", "learning_rate": 1e-3}
    agent = load_model(contrib.QRDQN, path, exploration_schedule=None, **given)
    load_replay_buffer(agent, path.with_suffix(".pkl"))
    buffer = agent.replay_buffer
    assert (buffer.pos, buffer.observations.shape) == (40, (60, 1, 4))
    assert np.all(buffer.observations[:40].any(axis=-1))
    path = FOLDER / "dqn_hindsight_1.6.2.zip"
    agent = load_model(sb3.DQN, path, BitFlippingEnv(3, max_steps=3), **given)
    with pytest.raises(UnsafeFileError, match=r"HerReplayBuffer of an older version, without"):
        load_replay_buffer(agent, path.with_suffix(".pkl"))


def test_old_statistics_are_read():
    path, env = FOLDER / "vecnormalize_1.6.2.pkl", make_vec_env(SWING)
    found = load_vec_normalize(path, env)
    assert (found.obs_rms.count, found.clip_obs) == (pytest.approx(1.0001), 10.0)
    with pytest.raises(UnsafeFileError, match="holds statistics of Box"):
        load_vec_normalize(path, make_vec_env(CART))


@pytest.mark.parametrize("protocol", range(6))
def test_every_protocol_of_pickle_is_read(protocol):
    env = make_vec_env(CART)
    env.observation_space.seed(0)
    env.venv_holds = {"a set": {1}}  # in what is not read
    made = VecNormalize(env, clip_obs=3.0)
    made.reset()
    found = read_normalization(pickle.dumps(made, protocol))
    assert found.settings["clip_obs"] == 3.0
    assert found.observation_space == env.observation_space
    np.testing.assert_array_equal(found.obs_rms.var, made.obs_rms.var)
    agent = sb3.DQN("MlpPolicy", CART, buffer_size=30, learning_starts=30, device="cpu").learn(9)
    buffer = agent.replay_buffer
    load_replay_buffer(agent, io.BytesIO(pickle.dumps(buffer, protocol)))
    assert agent.replay_buffer is not buffer
    for name in ("observations", "actions", "rewards", "timeouts"):
        np.testing.assert_array_equal(getattr(agent.replay_buffer, name), getattr(buffer, name))
