"""Examples that pages of docs/algorithms work out by hand, where no other test holds them."""

import numpy as np
import pytest

from mdp import TransitionModel, policy_iteration
from tests.agents.hand_fed import Fed


@pytest.mark.parametrize(("every_visit", "twice_visited"), [(False, 6.5), (True, 5.0)])
def test_monte_carlo_by_hand(every_visit, twice_visited):
    """Returns from the end: 4, 2 + .5 * 4 = 4, 1 + .5 * 4 = 3; the step size is a half."""
    settings = {"learning_rate": 0.5, "gamma": 0.5, "every_visit": every_visit}
    fed = Fed("monte_carlo", [[10, 0], [0, 0]], **settings)
    tables = fed.episode([(0, 0, 1), (1, 1, 2), (0, 0, 4)], "terminated")
    assert tables[1].tolist() == [[10, 0], [0, 0]]
    # 10 + .5 * (3 - 10), or first 10 + .5 * (4 - 10) = 7 and then 7 + .5 * (3 - 7).
    assert tables[2].tolist() == [[twice_visited, 0], [0, 2]]


def test_off_policy_monte_carlo_by_hand():
    """Epsilon is a half, so that a greedy action has a probability of 3/4, another one of 1/4."""
    fed = Fed("off_policy_monte_carlo", np.zeros((2, 2)), 0.5, gamma=0.5)
    sums = fed.agent.policy.weights.numpy()[0]

    def learn(second_action, second_reward, second_probability):
        probabilities = fed.agent._workspace_for(fed.agent.rng, 1).fields["probability"]
        probabilities[:] = 0.75
        fed.step(0, 0, 1, 1)
        probabilities[:] = second_probability
        return fed.step(1, second_action, second_reward, 0, "terminated").tolist()

    # What led to the end by an action that is the best one now counts four times.
    assert learn(1, 4, 0.25) == [[3, 0], [0, 4]]
    assert sums.tolist() == [[4, 0], [0, 1]]
    # 4 + 1/2 * (1 - 4); 3 + (4/3) / (4 + 4/3) * (1.5 - 3).
    assert learn(1, 1, 0.75) == [[pytest.approx(2.625), 0], [0, 2.5]]
    # An action that the greedy policy would not have taken tells nothing of what came before.
    assert learn(0, 0, 0.25) == [[pytest.approx(2.625), 0], [0, 2.5]]
    np.testing.assert_allclose(sums, [[16 / 3, 0], [1, 2]], rtol=1e-15)


@pytest.mark.parametrize(
    ("trace_type", "value"), [("replacing", 4.0), ("accumulating", 3.5), ("dutch", 3.875)]
)
def test_sarsa_lambda_by_hand(trace_type, value):
    """Twice the same state and action; step size and discount are a half, lambda is 1."""
    settings = {"learning_rate": 0.5, "gamma": 0.5, "trace_decay": 1.0}
    fed = Fed("sarsa_lambda", [[4, 0]], trace_type=trace_type, **settings)
    # 4 + .5 * 4 - 4 = 2, half of it; then 3 - 5 = -2, times half of the trace.
    assert fed.step(0, 0, 4, 0).tolist() == [[5, 0]]
    assert fed.step(0, 0, 3, 0, "terminated").tolist() == [[value, 0]]


def test_policy_iteration_by_hand():
    """To stay in state 0 earns 1, in state 1 it earns 3; to go over earns nothing."""
    next_state = np.array([[[0], [1]], [[1], [1]]])
    model = TransitionModel(
        prob=np.ones(next_state.shape),
        next_state=next_state,
        reward=np.array([[[1.0], [0.0]], [[3.0], [3.0]]]),
        terminated=np.zeros(next_state.shape, dtype=bool),
        initial=np.array([1.0, 0.0]),
    )
    plan = policy_iteration(model, 0.5)
    assert plan.values == pytest.approx([3, 6])
    assert plan.action_values[0] == pytest.approx([2.5, 3])
    assert (plan.policy[0], plan.iterations) == (1, 2)
