"""Genuine files of every algorithm: loaded without unpickling, they are what the library loads.

The files are made here by the plain library. From both models training goes on, and ends in the
same weights, to the last bit.
"""

import random
from functools import partial
from pathlib import Path

import gymnasium as gym
import numpy as np
import pytest
import sb3_contrib as contrib
import stable_baselines3 as sb3
import torch as th
from stable_baselines3.common.env_util import make_vec_env
from stable_baselines3.common.envs import BitFlippingEnv
from stable_baselines3.common.noise import NormalActionNoise, OrnsteinUhlenbeckActionNoise
from stable_baselines3.common.sb2_compat.rmsprop_tf_like import RMSpropTFLike
from stable_baselines3.common.utils import LinearSchedule
from stable_baselines3.common.vec_env import VecFrameStack, VecNormalize
from torch import nn, optim

from rl_yardstick.envs.wrappers import ActionMasks
from rl_yardstick.safe_files import buffers_and_statistics as loaders
from rl_yardstick.safe_files.files import UnsafeFileError
from rl_yardstick.safe_files.models import inspect_model, load_model

FOLDER = Path(__file__).parent / "old_models"
FEW = {"learning_starts": 10, "buffer_size": 200, "batch_size": 8}
ROLLOUT = {"n_steps": 32, "batch_size": 16}
NOISE = np.zeros(1), np.full(1, 0.1)

NETWORKS = {"net_arch": {"pi": [4], "vf": [4]}, "activation_fn": nn.ReLU}
NETWORKS |= {"optimizer_class": optim.AdamW, "optimizer_kwargs": {"weight_decay": 0.01}}
SCHEDULES = {"learning_rate": LinearSchedule(1e-3, 0.0, 1.0), "policy_kwargs": NETWORKS}
SCHEDULES |= {"clip_range": LinearSchedule(0.2, 0.1, 0.5), "clip_range_vf": 0.2}
STACKED = {"policy_kwargs": {"optimizer_class": RMSpropTFLike, "net_arch": [4]}}
GOALS = {"n_sampled_goal": 2, "goal_selection_strategy": "future"}
HINDSIGHT = {"replay_buffer_class": sb3.HerReplayBuffer, "replay_buffer_kwargs": GOALS}
LSTM = {"policy_kwargs": {"lstm_hidden_size": 4, "net_arch": [4]}}
SDE = {"use_sde": True}


def case(algorithm, env_id, *kwargs, policy="MlpPolicy", n_envs=1, around=None):
    """``around`` is what stands around the environments; ``kwargs`` are those of the algorithm."""
    together = {name: value for part in kwargs for name, value in part.items()}
    return algorithm, policy, env_id, n_envs, around, together


BITS = partial(BitFlippingEnv, n_bits=3, max_steps=3)
ORNSTEIN, NORMAL = OrnsteinUhlenbeckActionNoise(*NOISE), NormalActionNoise(*NOISE)
CART, SWING = "CartPole-v1", "Pendulum-v1"
CASES = {
    "ppo with schedules, normalised": case(sb3.PPO, CART, ROLLOUT, SCHEDULES, around="normalize"),
    "a2c on stacked frames": case(sb3.A2C, CART, STACKED, around="stack"),
    "dqn with hindsight": case(sb3.DQN, BITS, FEW, HINDSIGHT, policy="MultiInputPolicy"),
    "sac with sde and noise": case(sb3.SAC, SWING, FEW, SDE, {"action_noise": ORNSTEIN}),
    "td3 with noise": case(sb3.TD3, SWING, FEW, {"action_noise": NORMAL}, n_envs=2),
    "qrdqn": case(contrib.QRDQN, CART, FEW),
    "tqc": case(contrib.TQC, SWING, FEW),
    "trpo": case(contrib.TRPO, CART, ROLLOUT),
    "crossq": case(contrib.CrossQ, SWING, FEW),
    "ars": case(contrib.ARS, SWING, {"n_delta": 1}, policy="LinearPolicy"),
    "ppo_mask": case(contrib.MaskablePPO, lambda: ActionMasks(gym.make("Warehouse-v0")), ROLLOUT),
    "ppo_lstm": case(contrib.RecurrentPPO, CART, ROLLOUT, LSTM, policy="MlpLstmPolicy"),
}


def make_env(name):
    _, _, env_id, n_envs, around, _ = CASES[name]
    env = make_vec_env(env_id, n_envs)
    if around == "normalize":
        return VecNormalize(env)
    return VecFrameStack(env, 2) if around == "stack" else env


def make_model(name):
    algorithm, policy, *_, kwargs = CASES[name]
    kwargs = {"policy_kwargs": {} if policy == "LinearPolicy" else {"net_arch": [4]}, **kwargs}
    return algorithm(policy, make_env(name), device="cpu", **kwargs)


def reseed():
    random.seed(0)
    np.random.seed(0)  # noqa: NPY002  # the library's noise and buffers draw from it
    th.manual_seed(0)


def weights(model):
    return th.cat([part.flatten().double() for part in model.policy.state_dict().values()])


def go_on(name, folder, load, load_buffer, load_statistics):
    """Load, seed and train; the model and what it had been at first."""
    env = make_env(name)
    if CASES[name][4] == "normalize":
        env = load_statistics(str(folder / "statistics.pkl"), env.venv)
    env.seed(1)
    model = load(CASES[name][0], folder / "model.zip", env)
    if (folder / "buffer.pkl").exists():
        load_buffer(model, folder / "buffer.pkl")
    kinds = {attribute: type(value) for attribute, value in vars(model).items()}
    before = weights(model)
    reseed()
    return model.learn(40, reset_num_timesteps=False), kinds, before


LIBRARY = (
    lambda algorithm, path, env: algorithm.load(path, env),
    lambda model, path: model.load_replay_buffer(path),
    VecNormalize.load,
)
OURS = load_model, loaders.load_replay_buffer, loaders.load_vec_normalize


# What the library says when it loads such models, by its own function too.
@pytest.mark.filterwarnings("ignore:The last trajectory in the replay buffer:UserWarning")
@pytest.mark.parametrize("name", CASES)
def test_a_genuine_model_goes_on_as_the_library_would(name, tmp_path):
    reseed()
    model = make_model(name)
    model.learn(30)
    model.save(tmp_path / "model")
    if CASES[name][4] == "normalize":
        model.get_vec_normalize_env().save(str(tmp_path / "statistics.pkl"))
    if isinstance(model, sb3.common.off_policy_algorithm.OffPolicyAlgorithm):
        model.save_replay_buffer(tmp_path / "buffer.pkl")

    library, its_kinds, its_weights = go_on(name, tmp_path, *LIBRARY)
    ours, our_kinds, our_weights = go_on(name, tmp_path, *OURS)
    assert our_kinds == its_kinds
    assert th.equal(our_weights, its_weights)
    assert th.equal(our_weights, weights(model))
    assert th.equal(weights(ours), weights(library))
    assert not th.equal(weights(ours), our_weights)
    assert ours.num_timesteps == library.num_timesteps
    assert inspect_model(tmp_path / "model.zip")["suspicious"] == {}


def test_statistics_keep_their_settings_and_are_refused_elsewhere(tmp_path):
    path, flags = str(tmp_path / "statistics.pkl"), {"training": False, "norm_reward": False}
    made = VecNormalize(make_vec_env(CART), **flags, clip_obs=3.0, clip_reward=4.0, gamma=0.9)
    made.save(path)
    found = loaders.load_vec_normalize(path, make_vec_env(CART))
    for name in ("norm_obs", *flags, "clip_obs", "clip_reward", "gamma", "epsilon"):
        assert getattr(found, name) == getattr(made, name), name
    with pytest.raises(UnsafeFileError, match=r"holds statistics of Box.*, not of Box"):
        loaders.load_vec_normalize(path, make_vec_env(SWING))


# Made by these versions: those that are seeded have generators as NumPy 1 pickles them. What they
# say of their schedules, and what stands in their place.
OLD_MODELS = {
    "dqn_2.3.2": (sb3.DQN, {"learning_rate": 1e-3}),
    "ppo_2.0.0": (sb3.PPO, {"clip_range": 0.2}),
    "ppo_zoo_2.6.0": (sb3.PPO, {"clip_range": 0.2}),
    "ppo_seeded_2.6.0": (sb3.PPO, {"clip_range": 0.2}),
    "td3_seeded_2.0.0": (sb3.TD3, {}),
}


@pytest.mark.filterwarnings("ignore:You are probably loading a DQN model saved with:UserWarning")
@pytest.mark.filterwarnings("ignore:numpy.core:DeprecationWarning")  # the library's own loading
@pytest.mark.parametrize("name", OLD_MODELS)
def test_models_of_older_versions_are_loaded_with_other_schedules(name):
    """Up to version 2.6 of the library, schedules were functions with code, which is not run."""
    algorithm, schedules = OLD_MODELS[name]
    path = FOLDER / f"{name}.zip"
    for key in schedules:
        with pytest.raises(UnsafeFileError, match=f"{key} holds a function with its code") as told:
            load_model(algorithm, path)
        assert told.value.key == key
    ours = load_model(algorithm, path, **schedules)
    assert th.equal(weights(ours), weights(algorithm.load(path)))
    assert ours.lr_schedule(0.5) == ours.learning_rate
    told = inspect_model(path)["suspicious"]
    assert told
    assert all("holds a function with its code" in line for line in told.values())


def test_a_generator_of_numpy_1_goes_on():
    with (FOLDER / "vecnormalize_seeded_2.6.0.pkl").open("rb") as file:
        saved = loaders.read_normalization(file.read()).observation_space
    fresh = gym.make(CART).observation_space
    fresh.seed(0)
    assert saved == fresh
    assert np.array_equal([saved.sample() for _ in range(3)], [fresh.sample() for _ in range(3)])


class OwnPolicy(sb3.ppo.MlpPolicy):
    """A policy that the library does not know."""


def test_a_policy_of_ones_own_is_admitted_by_name_alone(tmp_path):
    sb3.PPO(OwnPolicy, "CartPole-v1", device="cpu").save(tmp_path / "model")
    with pytest.raises(UnsafeFileError, match="OwnPolicy"):
        load_model(sb3.PPO, tmp_path / "model.zip")
    own = {f"{OwnPolicy.__module__}.OwnPolicy": OwnPolicy}
    assert isinstance(load_model(sb3.PPO, tmp_path / "model.zip", classes=own).policy, OwnPolicy)
