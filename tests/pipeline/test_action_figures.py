"""What agents make of their actions: of tables by hand, of networks by what they do."""

import numpy as np
import pytest
import torch as th
from stable_baselines3.common.env_util import make_vec_env

import envs  # noqa: F401  # registers the bandits
from agents import load_algorithm
from pipeline.evaluation.policies import action_figures

SMALL = {"policy_kwargs": {"net_arch": [8]}}


def agent_of(name, env_id="FrozenLake-v1", **kwargs):
    algorithm = load_algorithm(name)
    env = make_vec_env(env_id, 1, seed=0)
    return algorithm(next(iter(algorithm.policy_aliases)), env, seed=0, **kwargs)


def test_of_a_table_its_row():
    agent = agent_of("double_qlearning")
    agent.policy.q_tables[:, 3] = th.tensor([[1.0, 2.0, 3.0, 4.0], [3.0, 2.0, 1.0, 0.0]])
    figures = action_figures(agent, np.array([3]))
    assert (figures.word, figures.numbers.tolist()) == ("value", [2.0, 2.0, 2.0, 2.0])


@pytest.mark.parametrize("pooled", [False, True])
def test_of_a_bandit_its_scores(pooled):
    agent = agent_of("epsilon_greedy", "envs:SegmentBandit-v0", ignore_context=pooled)
    agent.policy.scores[-1] = th.tensor([0.25, 0.5, 0.75])
    figures = action_figures(agent, np.array([1]))
    assert (figures.word, figures.numbers.tolist()) == ("score", [0.25, 0.5, 0.75])


@pytest.mark.parametrize("name", ["dqn", "qrdqn"])
def test_of_a_network_values_whose_highest_it_takes(name):
    agent = agent_of(name, buffer_size=10, **SMALL)
    for state in range(16):
        word, values = action_figures(agent, np.array([state]))
        assert (word, values.shape) == ("value", (4,))
        assert values.argmax() == agent.predict(np.array([state]), deterministic=True)[0]
    assert len(set(values.tolist())) == 4


def test_of_a_policy_that_samples_its_probabilities():
    agent = agent_of("ppo", **SMALL)
    word, shares = action_figures(agent, np.array([5]))
    assert word == "probability"
    assert shares.sum() == pytest.approx(1.0)
    with th.no_grad():
        _, logs, _ = agent.policy.evaluate_actions(th.full((4,), 5), th.arange(4))
    assert shares == pytest.approx(np.exp(logs.numpy()), rel=1e-5)


@pytest.mark.parametrize("env_id", ["FrozenLake-v1", "MountainCar-v0"])
def test_on_tiles_values_or_what_is_made_of_preferences(env_id):
    observation = np.array([5]) if env_id == "FrozenLake-v1" else np.array([[-0.5, 0.01]])
    values = agent_of("semi_gradient_q", env_id)
    values.policy.weights[:] = th.arange(values.policy.weights.shape[1])
    word, numbers = action_figures(values, observation)
    assert (word, numbers.argmax()) == ("value", len(numbers) - 1)
    assert np.unique(np.diff(numbers)).size == 1
    softmax = agent_of("actor_critic", env_id)
    word, shares = action_figures(softmax, observation)
    assert (word, shares.tolist()) == (
        "probability",
        [pytest.approx(1 / len(shares))] * len(shares),
    )


def test_where_there_is_no_such_figure():
    assert action_figures(agent_of("random"), np.array([0])) is None
    assert action_figures(agent_of("ppo", "Pendulum-v1", **SMALL), np.zeros((1, 3))) is None
    lstm = agent_of("ppo_lstm", n_steps=8, policy_kwargs={"lstm_hidden_size": 4})
    assert action_figures(lstm, np.array([0])) is None
    linear = agent_of("linucb", "envs:LinearBandit-v0")
    assert action_figures(linear, np.zeros((1, 5))) is None
