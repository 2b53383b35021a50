"""Each update rule against numbers worked out by hand."""

import gymnasium as gym
import numpy as np
import pytest
from gymnasium import spaces

from agents import load_algorithm
from agents.compiled.worlds import ENV, PROGRESS
from agents.tabular.updates import update

# Two states, three actions. The transition: state 0, action 1, reward 2, then state 1, where SARSA
# has committed to action 0; gamma 0.5, step size 0.1.
FIRST_TABLE = [[0.0, 10.0, 0.0], [4.0, 8.0, 6.0]]
SECOND_TABLE = [[0.0, 20.0, 0.0], [3.0, 1.0, 5.0]]
RULES = ("qlearning", "sarsa", "expected_sarsa", "double_qlearning")


class Spaces(gym.Env):
    """Spaces alone; nothing here is ever stepped."""

    def __init__(self, n_states, n_actions):
        self.observation_space = spaces.Discrete(n_states)
        self.action_space = spaces.Discrete(n_actions)


def updated(rule, tables, *, terminated=False, uniform=0.0, rate=0.3, **kwargs):
    """TD error of one update, the index of the table that it changed, and the entry afterwards."""
    tables = np.array(tables)
    model = load_algorithm(rule)(env=Spaces(*tables.shape[1:]), gamma=0.5, seed=0, **kwargs)
    model.policy.q_tables.numpy()[:] = tables
    env, progress = np.zeros(1, dtype=ENV)[0], np.zeros(1, dtype=PROGRESS)[0]
    for name, value in {"action": 1, "reward": 2.0, "next_obs": 1, "uniform": uniform}.items():
        env[name] = value
    env["terminated"] = terminated
    progress["learning_rate"], progress["exploration"] = 0.1, rate
    td_error = update(model.compiled_agent(model.rng), env, progress)
    counts = model.policy.visit_counts.numpy()
    changed = np.argwhere(counts)
    assert len(changed) == 1
    assert counts.sum() == 1
    table, obs, action = changed[0]
    assert (obs, action) == (0, 1)
    return td_error, table, model.policy.q_tables.numpy()[table, obs, action]


@pytest.mark.parametrize(
    ("rule", "target"),
    [
        # Best next value 8: 2 + 0.5 * 8.
        ("qlearning", 6.0),
        # Value of action 0: 2 + 0.5 * 4.
        ("sarsa", 4.0),
        # Mean of 4, 8, 6 is 6: 0.3 * 6 + 0.7 * 8 = 7.4, and 2 + 0.5 * 7.4.
        ("expected_sarsa", 5.7),
    ],
)
def test_one_table(rule, target):
    td_error, _, value = updated(rule, [FIRST_TABLE])
    assert td_error == pytest.approx(target - 10)
    assert value == pytest.approx(10 + 0.1 * (target - 10))


def test_expected_sarsa_under_a_softmax():
    # At temperature 2 the values 4, 8, 6 weigh 1, e^2, e.
    weights = np.exp([0.0, 2.0, 1.0])
    expected = 2 + 0.5 * (weights @ [4, 8, 6]) / weights.sum()
    td_error, _, _ = updated("expected_sarsa", [FIRST_TABLE], exploration="boltzmann", rate=2.0)
    assert td_error == pytest.approx(expected - 10, rel=1e-14)


@pytest.mark.parametrize(
    ("uniform", "table", "old", "target"),
    [
        # The first table prefers action 1 (8), of which the second thinks 1.
        (0.2, 0, 10.0, 2 + 0.5 * 1),
        # The second prefers action 2 (5), of which the first thinks 6.
        (0.7, 1, 20.0, 2 + 0.5 * 6),
    ],
)
def test_double_q_learning_judges_by_the_other_table(uniform, table, old, target):
    td_error, updated_table, value = updated(
        "double_qlearning", [FIRST_TABLE, SECOND_TABLE], uniform=uniform
    )
    assert updated_table == table
    assert td_error == pytest.approx(target - old)
    assert value == pytest.approx(old + 0.1 * (target - old))


@pytest.mark.parametrize("rule", RULES)
def test_termination_leaves_the_reward_alone(rule):
    tables = [FIRST_TABLE, SECOND_TABLE] if rule == "double_qlearning" else [FIRST_TABLE]
    td_error, _, _ = updated(rule, tables, terminated=True)
    assert td_error == pytest.approx(2 - 10)


def test_sample_average_is_the_mean_of_the_targets():
    model = load_algorithm("qlearning")(
        env=Spaces(1, 1), learning_rate="sample_average", initial_q=123.0
    )
    agent, progress = model.compiled_agent(model.rng), np.zeros(1, dtype=PROGRESS)[0]
    rewards = [4.0, 1.0, 7.0, -2.0]
    for reward in rewards:
        env = np.zeros(1, dtype=ENV)[0]
        env["reward"], env["terminated"] = reward, True
        update(agent, env, progress)
    assert model.policy.q_table[0, 0] == pytest.approx(np.mean(rewards))
    assert model.policy.visit_counts.numpy()[0, 0, 0] == len(rewards)
