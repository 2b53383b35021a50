"""Action choice and schedules: exact where random numbers are given, counted where they are not."""

import numpy as np
import pytest
import torch as th
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays
from stable_baselines3.common.utils import ConstantSchedule, FloatSchedule, LinearSchedule

from rl_yardstick.agents import load_algorithm
from rl_yardstick.agents.common import exploration as explore
from rl_yardstick.agents.common.schedules import ExponentialSchedule, schedule_row, schedule_value
from tests.agents.hand_fed import Spaces

VALUES = np.array([1.0, 3.0, 3.0, 2.0])


def test_choices_by_given_numbers():
    # Ties share the unit interval.
    assert [explore.greedy_action(VALUES, u) for u in (0.0, 0.49, 0.5, 0.99)] == [1, 1, 2, 2]
    # Below epsilon it explores; a tie scale of 0 takes the first of the best.
    draws = np.array([[0.29, 0.0], [0.29, 0.99], [0.3, 0.0], [0.3, 0.99]])
    assert [explore.epsilon_greedy_action(VALUES, 0.3, 1.0, row) for row in draws] == [0, 3, 1, 2]
    assert explore.epsilon_greedy_action(VALUES, 0.3, 0.0, np.array([0.9, 0.99])) == 1
    # The cumulative probabilities are inverted, and do not overflow.
    values = np.log([1.0, 2.0, 5.0])
    draws = np.array([[0.0], [0.12], [0.13], [0.37], [0.38]])
    assert [explore.boltzmann_action(values, 1.0, row) for row in draws] == [0, 0, 1, 1, 2]
    assert explore.boltzmann_action(np.array([1e6, 0.0]), 1e-3, np.array([0.999])) == 0
    # Noise is added to the values.
    draws = np.array([0.0, -1.0, 0.0, 1.5])
    assert [explore.noisy_greedy_action(VALUES, scale, draws) for scale in (1.0, 0.1)] == [3, 2]


def test_a_temperature_that_has_fallen_to_0_is_the_limit():
    values, expected = np.array([1.0, 3.0, 3.0, 0.0]), [0.0, 0.5, 0.5, 0.0]
    draws = np.array([[0.0], [0.49], [0.51], [0.99]])
    assert [explore.boltzmann_action(values, 0.0, row) for row in draws] == [1, 1, 2, 2]
    args = explore.BOLTZMANN, values, 0.0, 1.0
    found = [explore.action_probability(*args, action) for action in range(4)]
    matrix = explore.action_probabilities(explore.BOLTZMANN, values[None], 0.0, random_ties=True)
    assert found == matrix[0].tolist() == expected
    assert explore.expected_value(explore.BOLTZMANN, values, 0.0) == 3.0


@given(
    arrays(np.float64, st.integers(1, 6), elements=st.floats(-50, 50, allow_subnormal=False)),
    st.floats(0.05, 1),
    st.sampled_from([explore.EPSILON_GREEDY, explore.BOLTZMANN]),
    st.booleans(),
)
def test_expected_value_is_the_mean_under_the_probabilities(values, rate, strategy, random_ties):
    args = strategy, values[None], rate
    (probabilities,) = explore.action_probabilities(*args, random_ties=random_ties)
    assert probabilities.sum() == pytest.approx(1)
    mean = float(probabilities @ values)
    assert explore.expected_value(strategy, values, rate) == pytest.approx(mean, rel=1e-9, abs=1e-9)
    args = strategy, values, rate, float(random_ties)
    found = [explore.action_probability(*args, action) for action in range(len(values))]
    np.testing.assert_allclose(found, probabilities, rtol=1e-12, atol=1e-15)


def agent_of(values, **arguments):
    """A Q-learning agent with a table of values."""
    agent = load_algorithm("qlearning")(env=Spaces(*values.shape), seed=0, **arguments)
    agent.policy.q_tables.copy_(th.as_tensor(values))
    return agent


# As many states as actions: there, a row mistaken for a column raises no error.
@pytest.mark.parametrize("rate", [0.2, 5.0])
def test_probabilities_row_by_row(rate):
    """Values without ties, whose rows have their best in different places; and large ones."""
    values = np.random.default_rng(3).normal(size=(4, 4)) + 1e5 * np.arange(4)[:, None]
    epsilon, weights = min(rate, 1.0), np.exp((values - values[:, :1]) / rate)
    greedy = epsilon / 4 + (1 - epsilon) * np.eye(4)[values.argmax(axis=1)]
    softmax = weights / weights.sum(axis=1)[:, None]
    agent = agent_of(values, exploration_initial_eps=epsilon, exploration_final_eps=epsilon)
    np.testing.assert_allclose(agent.action_probabilities(), greedy, rtol=0, atol=1e-15)
    agent = agent_of(values, exploration="boltzmann", temperature=rate)
    np.testing.assert_allclose(agent.action_probabilities(), softmax, rtol=1e-12)


def test_tied_actions_share_or_the_first_has_all():
    values = np.array([[1.0, 2, 2, 0], [3, 3, 3, 3], [5, 4, 5, 5], [0, 0, 0, 9]])
    greedy = {
        "random": [[0, 1 / 2, 1 / 2, 0], [1 / 4] * 4, [1 / 3, 0, 1 / 3, 1 / 3], [0, 0, 0, 1]],
        "first": [[0, 1, 0, 0], [1, 0, 0, 0], [1, 0, 0, 0], [0, 0, 0, 1]],
    }
    for ties, shares in greedy.items():
        arguments = {"exploration_initial_eps": 0.4, "exploration_final_eps": 0.4}
        found = agent_of(values, tie_breaking=ties, **arguments).action_probabilities()
        np.testing.assert_allclose(found, 0.1 + 0.6 * np.array(shares), rtol=1e-14)


EXPONENTIALLY = {"exploration_decay": "exponential", "exploration_fraction": 1.0}
RATES = [  # settings, and the rates at the beginning, half-way and at the end
    ({"exploration_decay": "constant", "exploration_initial_eps": 0.3}, [0.3, 0.3, 0.3]),
    ({"exploration_initial_eps": 1.0, "exploration_final_eps": 0.2}, [1.0, 0.2, 0.2]),
    ({"exploration_fraction": 1.0, "exploration_final_eps": 0.0}, [1.0, 0.5, 0.0]),
    ({**EXPONENTIALLY, "exploration_initial_eps": 0.9, "exploration_final_eps": 0.1},
     [0.9, 0.3, 0.1]),
    ({"exploration": "boltzmann", "temperature": 2.5}, [2.5, 2.5, 2.5]),
    ({"exploration": "gaussian_noise", "noise_std": 3.0}, [3.0, 3.0, 3.0]),
]  # fmt: skip


@pytest.mark.parametrize(("arguments", "rates"), RATES, ids=[str(row[0]) for row in RATES])
def test_how_much_agents_explore(arguments, rates):
    model = load_algorithm("qlearning")(env="FrozenLake-v1", **arguments)
    measured = []
    for remaining in (1.0, 0.5, 0.0):
        model._current_progress_remaining = remaining
        measured.append(model.exploration_rate)
    assert measured == pytest.approx(rates)
    model._episode_num = 3  # noise falls by the episode
    is_noise = "noise_std" in arguments
    assert model.exploration_rate == pytest.approx(rates[-1] / (4 if is_noise else 1))


# Training may run past its end, by a rollout or an episode.
progress = st.floats(-0.5, 1)
values = st.floats(-1e6, 1e6)
positive = st.floats(1e-9, 1e9)

linear = st.builds(LinearSchedule, values, values, st.floats(1e-3, 1))
exponential = st.builds(ExponentialSchedule, positive, positive, st.floats(1e-3, 1))
constant = st.builds(ConstantSchedule, values)
parts = linear | exponential | constant
schedules = parts | st.builds(FloatSchedule, values | st.integers(-9, 9) | parts)


@given(schedules, st.lists(progress, min_size=20, max_size=20))
def test_a_row_gives_what_the_schedule_gives_bit_for_bit(schedule, points):
    row = schedule_row(schedule)
    for foreign in (lambda point: point, FloatSchedule(lambda point: point), "lin_0.1"):
        assert schedule_row(foreign) is None
    # Of one type, so that compiled code takes them all.
    assert [type(number) for number in row] == [float] * 4
    for point in [*points, 0.0, 0.5, 1.0]:
        assert schedule_value(row, point) == schedule(point)


def test_exponential_decay_worked_by_hand():
    # From 16 to 1 over the first half: a factor of 2 for each eighth of the training.
    points = [1.0, 0.875, 0.75, 0.625, 0.5, 0.25, 0.0, -0.1]
    decay = ExponentialSchedule(16.0, 1.0, 0.5)
    assert list(map(decay, points)) == pytest.approx([16, 8, 4, 2, 1, 1, 1, 1], rel=1e-14)
    schedule = ExponentialSchedule(0.7, 0.003, 0.6)  # whose ends are exact
    assert [schedule(point) for point in (1.0, 0.399, 0.0)] == [0.7, 0.003, 0.003]
