"""Results that a correct program reproduces: example 6.6 of the book, and a course's warehouse.

The warehouse figures were measured over 30 seeds with programs of their own, written after a
coursework's code: shelf reward -1, at most 1000 steps, 1000 episodes, ties on the first index.
"""

import numpy as np
import pytest
from stable_baselines3.common.env_util import make_vec_env

import envs  # noqa: F401
from agents.common.callbacks import EpisodeBudget
from agents.tabular.one_step import SARSA, QLearning
from envs.known_models import transition_model
from mdp import policy_return

N_SEEDS = 10


def trained(algorithm, env_id, seed, n_episodes, env_kwargs=None, **kwargs):
    """The agent after ``n_episodes``, and the return of each of them."""
    env = make_vec_env(env_id, 1, seed=seed, env_kwargs=env_kwargs)
    agent = algorithm(env=env, seed=seed, exploration_decay="constant", **kwargs)
    agent.learn(10**9, callback=EpisodeBudget(n_episodes), log_interval=None)
    return agent, np.array(env.envs[0].get_wrapper_attr("get_episode_rewards")())


def greedy_return(agent, horizon):
    model = transition_model(agent.env.envs[0])
    policy = agent.predict(np.arange(model.n_states), deterministic=True)[0]
    return policy_return(model, policy, horizon).expected_return


def test_cliff_walking_as_in_the_book():
    """Sutton and Barto, example 6.6: epsilon 0.1, step size 0.1, undiscounted, 500 episodes."""
    settings = {"learning_rate": 0.1, "gamma": 1.0, "exploration_initial_eps": 0.1}
    runs = {
        algorithm: [
            trained(algorithm, "CliffWalking-v1", seed, 2000, **settings) for seed in range(N_SEEDS)
        ]
        for algorithm in (QLearning, SARSA)
    }
    best = [greedy_return(agent, 200) for agent, _ in runs[QLearning]]
    safe = [greedy_return(agent, 200) for agent, _ in runs[SARSA]]
    assert best == [-13] * N_SEEDS
    assert all(-17 <= value <= -15 for value in safe)
    # While learning it is the other way round, on every seed.
    online = {key: [returns[-1000:].mean() for _, returns in value] for key, value in runs.items()}
    assert all(s > q for s, q in zip(online[SARSA], online[QLearning], strict=True))
    assert -59 < np.mean(online[QLearning]) < -47
    assert -28 < np.mean(online[SARSA]) < -20


@pytest.mark.parametrize(
    ("learning_rate", "gamma", "epsilon", "early", "middle", "late"),
    [
        # Mean returns of episodes 1-100, 200-300 and the last 100, each with its tolerance.
        (0.1, 0.9, 0.1, (-61, 4), (76.2, 0.7), (76.5, 0.5)),
        (0.9, 0.9, 0.1, (51.0, 3), (76.4, 0.7), (76.4, 0.7)),
        (0.01, 0.9, 0.1, (-393, 15), (-81.5, 8), (48.2, 4)),
        (0.1, 0.9, 0.9, (-256, 15), (-149, 10), (-146, 10)),
        (0.1, 0.1, 0.1, (-291, 60), (-985, 25), (-975, 40)),
    ],
)
def test_the_coursework_warehouse(learning_rate, gamma, epsilon, early, middle, late):
    settings = {
        "learning_rate": learning_rate,
        "gamma": gamma,
        "exploration_initial_eps": epsilon,
        "tie_breaking": "first",
        "env_kwargs": {"shelf_reward": -1},
    }
    returns = np.array(
        [trained(QLearning, "Warehouse-v0", seed, 1000, **settings)[1] for seed in range(N_SEEDS)]
    ).mean(axis=0)
    for part, (expected, tolerance) in (
        (returns[:100], early),
        (returns[200:300], middle),
        (returns[-100:], late),
    ):
        assert part.mean() == pytest.approx(expected, abs=tolerance)
