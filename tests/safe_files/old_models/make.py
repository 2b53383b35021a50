"""Makes the models of this folder that have observations and actions beside them.

Run ``python make.py`` in this folder, with Python 3.11 and stable-baselines3 and sb3-contrib of
1.6.2 (gym 0.21, NumPy 1.23.5), 1.8.0 (gym 0.21, 1.24.4), 2.1.0 (1.25.2) or 2.6.0 (1.26.4).
"""

import numpy as np
import sb3_contrib as contrib
import stable_baselines3 as sb3
from stable_baselines3.common.env_util import make_vec_env
from stable_baselines3.common.envs import BitFlippingEnv
from stable_baselines3.common.noise import NormalActionNoise
from stable_baselines3.common.vec_env import VecNormalize
from torch import nn

CART, SWING, BITS = "CartPole-v1", "Pendulum-v1", BitFlippingEnv(3, max_steps=3)
LAYERS, FEW = {"net_arch": [4]}, {"learning_starts": 10, "buffer_size": 60, "batch_size": 8}
HINDSIGHT = {"replay_buffer_class": sb3.HerReplayBuffer, "learning_rate": 0.1, **FEW}
GOALS = {"n_sampled_goal": 2, "online_sampling": True, "max_episode_length": 3}
SHARED = {"net_arch": [4, 3, {"pi": [4], "vf": [2]}], "activation_fn": nn.ReLU}
NOISE = NormalActionNoise(np.zeros(1), np.full(1, 0.1))
# The class, the policy, the environment, the policy's arguments and the others.
MODELS = {
    "a2c_shared_1.6.2": (sb3.A2C, "Mlp", SWING, SHARED, {"n_steps": 16}),
    "ars_1.6.2": (contrib.ARS, "Linear", CART, {}, {"n_delta": 2}),
    "dqn_hindsight_1.6.2":
        (sb3.DQN, "MultiInput", BITS, LAYERS, {**HINDSIGHT, "replay_buffer_kwargs": GOALS}),
    "td3_noise_1.6.2": (sb3.TD3, "Mlp", SWING, LAYERS, {**FEW, "action_noise": NOISE}),
    "qrdqn_1.8.0": (contrib.QRDQN, "Mlp", CART, {**LAYERS, "n_quantiles": 5}, FEW),
    "ppo_lstm_2.1.0": (contrib.RecurrentPPO, "MlpLstm", CART, {**LAYERS, "lstm_hidden_size": 4},
                       {"n_steps": 16, "batch_size": 16}),
    "trpo_2.6.0": (contrib.TRPO, "Mlp", SWING, LAYERS, {"n_steps": 16}),
}  # fmt: skip
random = np.random.RandomState(0)
SEEN = {
    CART: {"": random.uniform(-3, 3, (20, 4)).astype(np.float32)},
    SWING: {"": random.uniform(-1, 1, (20, 3)).astype(np.float32)},
    BITS: {key: random.randint(0, 2, (20, 3)).astype(np.int8) for key in BITS.observation_space},
}
for name, (algorithm, policy, env, kwargs, others) in MODELS.items():
    if name.endswith(sb3.__version__):
        given = {"seed": 0, "device": "cpu", "policy_kwargs": kwargs, **others}
        model = algorithm(f"{policy}Policy", env, **given).learn(40)
        model.save(f"{name}.zip")
        rows = [{key: array[i] for key, array in SEEN[env].items()} for i in range(20)]
        actions = [model.predict(row.get("", row), deterministic=True)[0] for row in rows]
        np.savez(f"{name}.npz", actions=np.array(actions), **SEEN[env])
        if "replay_buffer_class" in others or "n_quantiles" in kwargs:
            model.save_replay_buffer(f"{name}.pkl")
if sb3.__version__ == "1.6.2":
    env = VecNormalize(make_vec_env(SWING, seed=0))
    env.reset()
    env.save("vecnormalize_1.6.2.pkl")
