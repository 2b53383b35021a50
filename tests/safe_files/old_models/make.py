"""Makes the models of this folder that have actions beside them, and what lies with these.

Run it as ``python make.py FOLDER`` with Python 3.11 and one of these, each with its NumPy:
stable-baselines3 and sb3-contrib 1.6.2 (gym 0.21, NumPy 1.23.5), 1.8.0 (gym 0.21, 1.24.4), 2.1.0
(1.25.2) and 2.6.0 (1.26.4). Beside each zip it writes the library's own actions.
"""

import sys
from pathlib import Path

import numpy as np
import sb3_contrib as contrib
import stable_baselines3 as sb3
from stable_baselines3.common.env_util import make_vec_env
from stable_baselines3.common.envs import BitFlippingEnv
from stable_baselines3.common.noise import NormalActionNoise
from stable_baselines3.common.vec_env import VecNormalize
from torch import nn

FOLDER, VERSION = Path(sys.argv[1]), sb3.__version__
CART, SWING, BITS = "CartPole-v1", "Pendulum-v1", BitFlippingEnv(3, max_steps=3)
ALIKE = {"seed": 0, "device": "cpu"}
FEW = {
    "learning_starts": 10,
    "buffer_size": 60,
    "batch_size": 8,
    "policy_kwargs": {"net_arch": [4]},
}
HINDSIGHT = {
    "learning_rate": 0.1,
    "replay_buffer_class": sb3.HerReplayBuffer,
    "replay_buffer_kwargs": {"n_sampled_goal": 2, "online_sampling": True, "max_episode_length": 3},
}
SHARED = {"net_arch": [4, 3, {"pi": [4], "vf": [2]}], "activation_fn": nn.ReLU}
NOISE = NormalActionNoise(np.zeros(1), np.full(1, 0.1))
QUANTILES = {"policy_kwargs": {"net_arch": [4], "n_quantiles": 5}}
LSTM = {"batch_size": 16, "policy_kwargs": {"net_arch": [4], "lstm_hidden_size": 4}}
MODELS = {
    "1.6.2": {
        "a2c_shared": (sb3.A2C, "Mlp", SWING, {"n_steps": 16, "policy_kwargs": SHARED}),
        "ars": (contrib.ARS, "Linear", CART, {"n_delta": 2}),
        "dqn_hindsight": (sb3.DQN, "MultiInput", BITS, {**FEW, **HINDSIGHT}),
        "td3_noise": (sb3.TD3, "Mlp", SWING, {**FEW, "action_noise": NOISE}),
    },
    "1.8.0": {"qrdqn": (contrib.QRDQN, "Mlp", CART, {**FEW, **QUANTILES})},
    "2.1.0": {"ppo_lstm": (contrib.RecurrentPPO, "MlpLstm", CART, {"n_steps": 16, **LSTM})},
    "2.6.0": {
        "trpo": (contrib.TRPO, "Mlp", SWING, {"n_steps": 16, "policy_kwargs": {"net_arch": [4]}})
    },
}
random = np.random.RandomState(0)
OBSERVATIONS = {
    CART: {"": random.uniform(-3, 3, (20, 4)).astype(np.float32)},
    SWING: {"": random.uniform(-1, 1, (20, 3)).astype(np.float32)},
    BITS: {
        key: (random.rand(20, 3) < 0.5).astype(np.int8)
        for key in ("observation", "achieved_goal", "desired_goal")
    },
}

for name, (algorithm, policy, env, kwargs) in MODELS[VERSION].items():
    model = algorithm(f"{policy}Policy", env, **kwargs, **ALIKE).learn(40)
    model.save(FOLDER / f"{name}_{VERSION}.zip")
    seen = OBSERVATIONS[env]
    rows = [{key: array[i] for key, array in seen.items()} for i in range(20)]
    actions = [model.predict(row.get("", row), deterministic=True)[0] for row in rows]
    np.savez(FOLDER / f"{name}_{VERSION}.npz", actions=np.array(actions), **seen)
    if name in ("dqn_hindsight", "qrdqn"):
        model.save_replay_buffer(FOLDER / f"{name}_{VERSION}.pkl")

if VERSION == "1.6.2":
    env = VecNormalize(make_vec_env(SWING, seed=0))
    env.observation_space.seed(0)
    env.reset()
    env.save(str(FOLDER / f"vecnormalize_{VERSION}.pkl"))
