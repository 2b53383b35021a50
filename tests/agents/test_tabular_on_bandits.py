"""Tabular agents on bandits, compiled and interpreted."""

from typing import Any

import numpy as np
import pytest
from stable_baselines3.common.env_util import make_vec_env

import envs  # noqa: F401
from agents.tabular.one_step import QLearning


def trained(env_id: str, kwargs: dict[str, Any], engine: str) -> tuple[Any, ...]:
    """All that a training leaves behind, and then a second, interpreted one."""
    vec_env = make_vec_env(env_id, n_envs=2, seed=3, env_kwargs=kwargs)
    agent = QLearning("QTablePolicy", vec_env, gamma=0, learning_rate=0.1, seed=1, engine=engine)
    agent.learn(1001)
    used = agent.engine_in_use
    agent.engine = "interpreted"
    agent.learn(301, reset_num_timesteps=False)
    bandits = [env.unwrapped for env in vec_env.envs]
    left = (
        agent.policy.q_tables.numpy().copy(),
        agent.policy.visit_counts.numpy().copy(),
        np.array([(bandit.context, bandit.pulls_done) for bandit in bandits]),
        np.array([bandit.np_random.random() for bandit in bandits]),
        np.array([info["r"] for info in agent.ep_info_buffer]),
    )
    vec_env.close()
    return used, *left


@pytest.mark.parametrize(
    ("env_id", "kwargs"),
    [
        ("BernoulliBandit-v0", {"pulls": 70}),
        ("BernoulliBandit-v0", {"probabilities": [0.0, 0.1, 1.0], "pulls": 33}),
        ("SegmentBandit-v0", {"pulls": 70}),
        (
            "SegmentBandit-v0",
            {"segment_probabilities": [0.1, 0.2, 0.7], "click_rates": [[0.5, 0.1]] * 3},
        ),
        ("SegmentBandit-v0", {"batch_size": 8, "pulls": 50}),
    ],
)
def test_clicks_compile_bit_for_bit(env_id: str, kwargs: dict[str, Any]) -> None:
    used, *compiled = trained(env_id, kwargs, "auto")
    _, *interpreted = trained(env_id, kwargs, "interpreted")
    assert used == "compiled"
    for left, right in zip(compiled, interpreted, strict=True):
        assert np.array_equal(left, right)


def test_bandits_without_a_model_are_interpreted() -> None:
    used, *auto = trained("GaussianBandit-v0", {"pulls": 70}, "auto")
    assert used == "interpreted: the environment's transition model is not known"
    _, *interpreted = trained("GaussianBandit-v0", {"pulls": 70}, "interpreted")
    for left, right in zip(auto, interpreted, strict=True):
        assert np.array_equal(left, right)
