"""Each update rule against numbers worked out by hand."""

import numpy as np
import pytest

from agents.common.exploration import BOLTZMANN, EPSILON_GREEDY
from agents.tabular.rules import DOUBLE_Q_LEARNING, EXPECTED_SARSA, Q_LEARNING, SARSA, update

# Two states, three actions. The transition: state 0, action 1, reward 2, then state 1, where SARSA
# has committed to action 0; gamma 0.5, step size 0.1.
FIRST_TABLE = [[0.0, 10.0, 0.0], [4.0, 8.0, 6.0]]
SECOND_TABLE = [[0.0, 20.0, 0.0], [3.0, 1.0, 5.0]]


def updated(rule, tables, *, discount=0.5, sample_average=False, uniform=0.0, **exploring):
    tables = np.array(tables)
    counts = np.zeros(tables.shape, dtype=np.int64)
    strategy = exploring.get("strategy", EPSILON_GREEDY)
    td_error = update(
        rule=rule,
        tables=tables,
        visit_counts=counts,
        obs=0,
        action=1,
        reward=2.0,
        discount=discount,
        next_obs=1,
        next_action=0,
        learning_rate=0.1,
        sample_average=sample_average,
        strategy=strategy,
        rate=exploring.get("rate", 0.3),
        tie_scale=1.0,
        uniform=uniform,
        scratch=np.empty(3),
    )
    changed = np.argwhere(counts)
    assert len(changed) == 1
    assert counts.sum() == 1
    table, obs, action = changed[0]
    assert (obs, action) == (0, 1)
    return td_error, table, tables[table, obs, action]


@pytest.mark.parametrize(
    ("rule", "target"),
    [
        # Best next value 8: 2 + 0.5 * 8.
        (Q_LEARNING, 6.0),
        # Value of action 0: 2 + 0.5 * 4.
        (SARSA, 4.0),
        # Mean of 4, 8, 6 is 6: 0.3 * 6 + 0.7 * 8 = 7.4, and 2 + 0.5 * 7.4.
        (EXPECTED_SARSA, 5.7),
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
    td_error, _, _ = updated(EXPECTED_SARSA, [FIRST_TABLE], strategy=BOLTZMANN, rate=2.0)
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
        DOUBLE_Q_LEARNING, [FIRST_TABLE, SECOND_TABLE], uniform=uniform
    )
    assert updated_table == table
    assert td_error == pytest.approx(target - old)
    assert value == pytest.approx(old + 0.1 * (target - old))


@pytest.mark.parametrize("rule", [Q_LEARNING, SARSA, EXPECTED_SARSA, DOUBLE_Q_LEARNING])
def test_termination_leaves_the_reward_alone(rule):
    tables = [FIRST_TABLE, SECOND_TABLE] if rule == DOUBLE_Q_LEARNING else [FIRST_TABLE]
    td_error, _, _ = updated(rule, tables, discount=0.0)
    assert td_error == pytest.approx(2 - 10)


def test_sample_average_is_the_mean_of_the_targets():
    tables = np.full((1, 1, 1), 123.0)
    counts = np.zeros((1, 1, 1), dtype=np.int64)
    rewards = [4.0, 1.0, 7.0, -2.0]
    for reward in rewards:
        update(
            *(Q_LEARNING, tables, counts, 0, 0, reward, 0.0, 0, 0, 0.1, True, 0, 0.0, 0.0, 0.0),
            np.empty(1),
        )
    assert tables[0, 0, 0] == pytest.approx(np.mean(rewards))
    assert counts[0, 0, 0] == len(rewards)
