"""Monte Carlo control against the boxes of chapter 5, and against what can be worked out."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from stable_baselines3.common.env_util import make_vec_env

import envs  # noqa: F401  # registers the environments
from agents import load_algorithm
from agents.common.algorithm import Transitions
from agents.tabular.monte_carlo import ImportanceTablePolicy
from tests.agents.hand_fed import ENDS, N_ACTIONS, N_STATES, Fed, episodes, greedy, tables

GAMMA, ALPHA = 0.75, 0.25
# Uniformly random in four of five steps: actions off the greedy policy are common.
EPSILON = 0.8


def returns_of(table, steps, end):
    """The return after each step; the best value in state 0 stands for what was cut off."""
    later, found = table[0].max() if end == "truncated" else 0.0, []
    for _, _, reward in reversed(steps):
        later = reward + GAMMA * later
        found.insert(0, later)
    return found


@given(table=tables(), steps=episodes(), end=ENDS)
@pytest.mark.parametrize("every_visit", [False, True])
@pytest.mark.parametrize("learning_rate", [ALPHA, "sample_average"])
def test_returns_after_visits(table, steps, end, every_visit, learning_rate):
    settings_ = {"gamma": GAMMA, "learning_rate": learning_rate, "every_visit": every_visit}
    fed = Fed("monte_carlo", table, **settings_)
    expected, visits = fed.table.copy(), np.zeros_like(fed.table)
    for _ in range(2):
        returns = returns_of(expected, steps, end)
        pairs = [step[:2] for step in steps]
        for k in reversed(range(len(steps))):
            if every_visit or pairs.index(pairs[k]) == k:
                visits[pairs[k]] += 1
                size = ALPHA if learning_rate == ALPHA else 1 / visits[pairs[k]]
                expected[pairs[k]] += size * (returns[k] - expected[pairs[k]])
        fed.episode(steps, end)
        np.testing.assert_allclose(fed.table, expected, rtol=0, atol=1e-12)
    assert np.array_equal(fed.agent.policy.visit_counts.numpy()[0], visits)


@settings(max_examples=50)
@given(
    table=tables(),
    places=st.lists(st.integers(0, N_STATES - 1), min_size=1, max_size=8),
    end=ENDS,
    seed=st.integers(0, 1000),
)
def test_weighted_importance_sampling(table, places, end, seed):
    """The box of section 5.7, with the probabilities that the agent acts by."""
    fed = Fed("off_policy_monte_carlo", table, EPSILON, gamma=GAMMA)
    agent = fed.agent
    agent.set_random_seed(seed)
    expected, weights = fed.table.copy(), np.zeros_like(fed.table)
    for _ in range(3):
        policy, steps = agent.action_probabilities(), []
        later = expected[0].max() if end == "truncated" else 0.0
        for k, place in enumerate(places):
            agent._last_obs = np.array([place])
            action = agent._choose_actions()
            steps.append((place, int(action[0]), (k * 7) % 5 - 2))
            is_last = k == len(places) - 1
            agent_step(agent, steps[-1], action, 0 if is_last else places[k + 1], is_last and end)
        weight = 1.0
        for state, action, reward in reversed(steps):
            later = reward + GAMMA * later
            weights[state, action] += weight
            share = weight / weights[state, action]
            expected[state, action] += share * (later - expected[state, action])
            if action != greedy(expected, state):
                break
            weight /= policy[state, action]
        np.testing.assert_allclose(fed.table, expected, rtol=0, atol=1e-12)
        np.testing.assert_allclose(agent.policy.weights[0].numpy(), weights, rtol=1e-12)


def agent_step(agent, step, action, next_obs, end):
    """What the agent has just chosen, and what came of it."""
    obs, _, reward = step
    ends = np.array([end == "terminated"]), np.array([bool(end)])
    rewards = np.array([float(reward)])
    agent._learn_from(Transitions(np.array([obs]), action, rewards, *ends, np.array([next_obs])))


def test_an_episode_that_fills_the_record_is_learnt_from():
    fed = Fed("monte_carlo", [[0, 0], [0, 0], [8, 0]], gamma=0.5, longest_episode=2)
    fed.step(0, 0, 1, 1)
    # 1 + .5 * (2 + .5 * 8), and what is left counts as another episode.
    assert fed.step(1, 1, 2, 2).tolist() == [[4, 0], [0, 6], [8, 0]]
    # Its rest began with what the last target counted on.
    assert fed.agent._next_actions.tolist() == [0]
    assert fed.step(2, 0, 6, 0, "terminated").tolist() == [[4, 0], [0, 6], [6, 0]]


def test_weights_that_would_overflow_end_the_learning():
    fed = Fed("off_policy_monte_carlo", np.zeros((1, N_ACTIONS)), 1.0, gamma=1.0)
    agent = fed.agent
    for k in range(2000):
        agent._last_obs = np.array([0])
        action = agent._choose_actions()
        # Told that it did the greedy action each time, which it does once in three times.
        action[:] = 0
        agent._workspace_for(agent.rng, 1).fields["action"][:] = 0
        agent_step(agent, (0, 0, 0), action, 0, "terminated" if k == 1999 else "")
    assert np.isfinite(agent.policy.weights.numpy()).all()
    assert np.isfinite(fed.table).all()
    # 3 to the power of 314 is below 1e150.
    assert int(agent.policy.visit_counts.sum()) == 315


def test_what_was_not_chosen_by_the_agent_is_not_weighed():
    fed = Fed("off_policy_monte_carlo", np.zeros((4, 3)), 0.5, gamma=0.5)
    table = fed.episode([(1, 0, 1), (2, 0, 1), (3, 0, 2)], "terminated")[-1]
    assert table.tolist() == [[0] * 3] * 3 + [[2, 0, 0]]


@pytest.mark.parametrize("name", ["monte_carlo", "off_policy_monte_carlo"])
def test_prediction_on_the_random_walk(name):
    """Its one action is both policies': the true values of its five states are 1/6 to 5/6."""
    env = make_vec_env("envs:RandomWalk-v0", seed=0)
    model = load_algorithm(name)(env=env, seed=0, gamma=1.0).learn(100_000)
    # Over 10,000 episodes a mean of returns of 0 and 1 has a standard error below 0.005.
    np.testing.assert_allclose(model.policy.q_table[1:-1, 0], np.arange(1, 6) / 6, atol=0.02)


def test_weights_are_saved_with_the_table(tmp_path):
    algorithm = load_algorithm("off_policy_monte_carlo")
    model = algorithm(env=make_vec_env("FrozenLake-v1", seed=0), seed=0).learn(2000)
    model.save(tmp_path / "model")
    loaded = algorithm.load(tmp_path / "model")
    assert np.array_equal(loaded.policy.weights, model.policy.weights)
    assert model.policy.weights.any()
    model.policy.save(str(tmp_path / "policy"))
    policy = ImportanceTablePolicy.load(str(tmp_path / "policy"))
    assert np.array_equal(policy.weights, model.policy.weights)
    model.policy.weights = model.policy.weights[:, :2].clone()
    with pytest.raises(ValueError, match=r"weights must be of shape \(1, 16, 4\), not \(1, 2, 4\)"):
        model.learn(10)


def test_refusals():
    agent = load_algorithm("off_policy_monte_carlo")
    with pytest.raises(ValueError, match=r"learning_rate must be 'sample_average', not 0\.1"):
        agent(env="FrozenLake-v1", learning_rate=0.1)
    with pytest.raises(ValueError, match="needs the probabilities of the actions"):
        agent(env="FrozenLake-v1", exploration="gaussian_noise")
    with pytest.raises(ValueError, match="longest_episode must be a whole number of at least 1"):
        agent(env="FrozenLake-v1", longest_episode=0)
    with pytest.raises(ValueError, match="skip_terminal_update is for the agents that learn from"):
        load_algorithm("monte_carlo")(env="FrozenLake-v1", skip_terminal_update=True)
    with pytest.raises(ValueError, match="longest_episode must be at most 50000000, not 100000000"):
        agent(env="FrozenLake-v1", longest_episode=10**8)
