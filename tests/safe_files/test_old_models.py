"""What old versions of the library really saved: `old_models/make.py` made the files."""

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
from rl_yardstick.safe_files import buffers_and_statistics as loaders
from rl_yardstick.safe_files.files import UnsafeFileError
from rl_yardstick.safe_files.models import load_model
from tests.pipeline.short_runs import CART, SWING, spec_of

FOLDER = Path(__file__).parent / "old_models"
MODELS = sorted(path.stem for path in FOLDER.glob("*.npz"))


@pytest.mark.parametrize("name", MODELS)
def test_an_old_model_plays_as_it_did(name):
    algo = "ppo_lstm" if "lstm" in name else name.split("_")[0]
    agent = load_agent(Model(FOLDER / f"{name}.zip", spec_of(algo), None, None))
    with np.load(FOLDER / f"{name}.npz") as saved:  # each observation, and that version's action
        seen = dict(saved)
    actions = seen.pop("actions")
    rows = [{key: array[i] for key, array in seen.items()} for i in range(len(actions))]
    found = [agent.predict(row.get("", row), deterministic=True)[0] for row in rows]
    # Processors round products of matrices differently.
    np.testing.assert_allclose(np.array(found), actions, rtol=1e-5, atol=1e-7, strict=True)


def test_layers_that_actor_and_critic_share_are_played_but_not_trained():
    path = FOLDER / "a2c_shared_1.6.2.zip"
    with pytest.raises(UnsafeFileError, match="it can be played, but not trained further"):
        load_model(sb3.A2C, path)
    with zipfile.ZipFile(path) as file:
        was = th.load(io.BytesIO(file.read("policy.pth")))
    obs = values = th.as_tensor(np.load(path.with_suffix(".npz"))[""])
    for layer in ("shared_net.0", "shared_net.2", "value_net.0"):
        weight, bias = (was[f"mlp_extractor.{layer}.{kind}"] for kind in ("weight", "bias"))
        values = th.relu(values @ weight.T + bias)
    values = values @ was["value_net.weight"].T + was["value_net.bias"]
    policy = load_model(sb3.A2C, path, learning_rate=0.0, device="cpu").policy
    assert th.allclose(policy.predict_values(obs), values, atol=1e-6)


@pytest.mark.filterwarnings("ignore:You are probably loading a DQN model saved with:UserWarning")
def test_old_models_are_trained_further_and_old_buffers_are_read_or_refused():
    path, env = FOLDER / "td3_noise_1.6.2.zip", gym.make(SWING)  # its noise goes on
    assert load_model(sb3.TD3, path, env, device="cpu").learn(9).num_timesteps == 200
    path = FOLDER / "qrdqn_1.8.0.zip"
    agent = load_model(contrib.QRDQN, path, device="cpu")
    loaders.load_replay_buffer(agent, path.with_suffix(".pkl"))
    assert agent.replay_buffer.pos == 40
    assert np.all(agent.replay_buffer.observations.any(axis=-1)[:, 0] == (np.arange(60) < 40))
    path, env = FOLDER / "dqn_hindsight_1.6.2.zip", BitFlippingEnv(3, max_steps=3)
    agent = load_model(sb3.DQN, path, env, device="cpu")
    with pytest.raises(UnsafeFileError, match=r"a HerReplayBuffer of an older version, without"):
        loaders.load_replay_buffer(agent, path.with_suffix(".pkl"))


@pytest.mark.parametrize("protocol", range(6))
def test_every_protocol_of_pickle_is_read(protocol):
    with (FOLDER / "vecnormalize_1.6.2.pkl").open("rb") as file:
        assert loaders.read_normalization(file.read()).observation_space.shape == (3,)
    env = make_vec_env(CART)
    env.observation_space.seed(0)
    env.extra = {"a set": {1}}  # in what is not read
    made = VecNormalize(env, clip_obs=3.0)
    made.reset()
    found = loaders.read_normalization(pickle.dumps(made, protocol))
    assert (found.settings["clip_obs"], found.observation_space) == (3.0, env.observation_space)
    np.testing.assert_array_equal(found.obs_rms.var, made.obs_rms.var)
    agent = sb3.DQN("MlpPolicy", CART, buffer_size=30, learning_starts=30, device="cpu").learn(9)
    buffer = agent.replay_buffer
    loaders.load_replay_buffer(agent, io.BytesIO(pickle.dumps(buffer, protocol)))
    for name in ("observations", "actions", "rewards", "timeouts"):
        np.testing.assert_array_equal(getattr(agent.replay_buffer, name), getattr(buffer, name))
