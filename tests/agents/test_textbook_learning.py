"""The agents from the book's later chapters find a short way through the book's maze."""

import gymnasium as gym
import pytest
from stable_baselines3.common.env_util import make_vec_env
from stable_baselines3.common.evaluation import evaluate_policy
from stable_baselines3.common.monitor import Monitor

import envs  # noqa: F401  # registers the environments
from agents import load_algorithm

CONSTANT = {"exploration_decay": "constant", "exploration_initial_eps": 0.1}
FALLING = {"exploration_initial_eps": 0.3, "exploration_final_eps": 0.01}


@pytest.mark.parametrize(
    ("name", "settings"),
    [
        ("n_step_sarsa", {**FALLING, "learning_rate": 0.1}),
        ("n_step_tree_backup", CONSTANT),
        ("sarsa_lambda", {**CONSTANT, "trace_type": "dutch"}),
        ("q_lambda", {**CONSTANT, "trace_type": "accumulating"}),
        ("monte_carlo", CONSTANT),
        ("off_policy_monte_carlo", CONSTANT),
    ],
)
def test_dyna_maze(name, settings):
    env = make_vec_env("envs:DynaMaze-v0", 2, seed=0)
    model = load_algorithm(name)(env=env, seed=0, gamma=0.95, **settings).learn(50_000)
    assert model.engine_in_use == "compiled"
    maze = Monitor(gym.make("DynaMaze-v0"))
    (length,) = evaluate_policy(model, maze, 1, return_episode_rewards=True)[1]
    # The shortest takes 14 steps, the next 16; moving at random takes hundreds.
    assert length <= 16
