"""Values of states against hand-worked chains, and against evaluation from the start."""

from dataclasses import replace
from typing import Any

import gymnasium as gym
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp
from numpy.typing import NDArray

from envs.known_models import transition_model
from mdp import (
    TransitionModel,
    finite_horizon_optimum,
    optimal_choices,
    policy_return,
    state_values,
    value_iteration,
)

Floats = NDArray[np.float64]
LEFT, RIGHT = 0, 1


def corridor() -> TransitionModel:
    """States 0 to 3 in a row, and state 4, which nothing leads to.

    Each step costs 1; left of state 0 is a wall, right of state 3 the exit, worth 10.
    """
    next_state = [[0, 1], [0, 2], [1, 3], [2, 3], [4, 4]]
    reward = [[-1, -1], [-1, -1], [-1, -1], [-1, 10], [50, 50]]
    terminated = np.zeros((5, 2, 1), bool)
    terminated[3, RIGHT] = True
    return TransitionModel(
        prob=np.ones((5, 2, 1)),
        next_state=np.array(next_state)[:, :, None],
        reward=np.array(reward, float)[:, :, None],
        terminated=terminated,
        initial=np.array([1.0, 0, 0, 0, 0]),
    )


def test_values_of_a_corridor_worked_by_hand() -> None:
    always_right = np.full(5, RIGHT)
    assert state_values(corridor(), always_right, 100).tolist() == [7, 8, 9, 10, 0]
    # With three steps left the exit is out of reach from state 0.
    assert state_values(corridor(), always_right, 3).tolist() == [-3, 8, 9, 10, 0]
    assert state_values(corridor(), np.full(5, LEFT), 100).tolist() == [-100, -100, -100, -100, 0]
    to_and_fro = np.array([RIGHT, LEFT, RIGHT, RIGHT, RIGHT])
    assert state_values(corridor(), to_and_fro, 7).tolist() == [-7, -7, 9, 10, 0]


def test_values_of_random_steps_worked_by_hand() -> None:
    model = corridor()
    half = np.full((5, 2), 0.5)
    assert state_values(model, half, 1).tolist() == [-1, -1, -1, 4.5, 0]
    assert state_values(model, half, 2).tolist() == [-2, -2, 0.75, 4, 0]


def test_values_of_a_policy_that_changes_with_the_step() -> None:
    first_left = np.array([[LEFT] * 5, [RIGHT] * 5, [RIGHT] * 5])
    assert state_values(corridor(), first_left, 3).tolist() == [-3, -3, -3, 8, 0]


def test_what_is_best_in_a_corridor() -> None:
    values, optimal = optimal_choices(corridor(), 100)
    assert values.tolist() == [7, 8, 9, 10, 0]
    assert optimal[:4].tolist() == [[False, True]] * 4
    # Too late to get out of states 0 and 1: all ways of losing time are equal.
    values, optimal = optimal_choices(corridor(), 2)
    assert values.tolist() == [-2, -2, 9, 10, 0]
    assert optimal[:4].tolist() == [[True, True], [True, True], [False, True], [False, True]]
    values, optimal = optimal_choices(corridor(), 1)
    assert values.tolist() == [-1, -1, -1, 10, 0]


@pytest.mark.parametrize(("advantage", "n_best"), [(0.0, 2), (1e-11, 2), (1e-7, 1)])
def test_actions_are_equal_within_rounding(advantage: float, n_best: int) -> None:
    model = TransitionModel(
        prob=np.ones((1, 2, 1)),
        next_state=np.zeros((1, 2, 1), int),
        reward=np.array([[[5.0], [5.0 + advantage]]]),
        terminated=np.ones((1, 2, 1), bool),
        initial=np.ones(1),
    )
    assert optimal_choices(model, 3)[1].sum() == n_best


def model_of(env_id: str, **kwargs: Any) -> TransitionModel:
    model = transition_model(gym.make(f"envs:{env_id}", **kwargs))
    assert model is not None
    return model


def test_the_warehouse_has_two_best_routes() -> None:
    model = model_of("Warehouse-v0")
    values, optimal = optimal_choices(model, 1000)
    best = value_iteration(model, 1.0)
    np.testing.assert_array_equal(values[model.reachable], best.values[model.reachable])
    assert optimal[np.arange(100), best.policy].all()
    assert model.initial @ values == 79

    def routes(state: int) -> int:
        following = [
            (model.next_state[state, a, 0], model.terminated[state, a, 0])
            for a in np.flatnonzero(optimal[state])
        ]
        return sum(1 if ended else routes(reached) for reached, ended in following)

    assert routes(90) == 2


@st.composite
def distributions(draw: st.DrawFn, shape: tuple[int, ...]) -> Floats:
    weight = draw(hnp.arrays(np.int64, shape, elements=st.integers(0, 3)))
    weight[..., 0] += weight.sum(axis=-1) == 0
    result: Floats = weight / weight.sum(axis=-1, keepdims=True)
    return result


@st.composite
def models(draw: st.DrawFn) -> TransitionModel:
    n_states = draw(st.integers(1, 5))
    shape = (n_states, draw(st.integers(1, 3)), draw(st.integers(1, 3)))
    return TransitionModel(
        prob=draw(distributions(shape)),
        next_state=draw(hnp.arrays(np.int64, shape, elements=st.integers(0, n_states - 1))),
        reward=draw(hnp.arrays(np.int64, shape, elements=st.integers(-3, 3))),
        terminated=draw(hnp.arrays(np.bool_, shape)),
        initial=draw(distributions((n_states,))),
    )


def starting_from(model: TransitionModel, state: int) -> TransitionModel:
    return replace(model, initial=np.eye(model.n_states)[state])


@given(models(), st.integers(1, 30), st.data())
def test_each_value_is_the_return_of_episodes_that_begin_there(
    model: TransitionModel, horizon: int, data: st.DataObject
) -> None:
    policy = data.draw(distributions((model.n_states, model.n_actions)))
    values = state_values(model, policy, horizon)
    expected = policy_return(model, policy, horizon).expected_return
    assert model.initial @ values == pytest.approx(expected, abs=1e-9)
    for state in range(model.n_states):
        one = starting_from(model, state)
        reached = model.reachable[state]
        earned = policy_return(one, policy, horizon).expected_return if reached else 0
        assert values[state] == pytest.approx(earned, abs=1e-9)


@given(models(), st.integers(1, 5), st.data())
def test_a_policy_that_changes_with_the_step_likewise(
    model: TransitionModel, horizon: int, data: st.DataObject
) -> None:
    elements = st.integers(0, model.n_actions - 1)
    actions = data.draw(hnp.arrays(np.int64, (horizon, model.n_states), elements=elements))
    values = state_values(model, actions, horizon)
    expected = policy_return(model, actions, horizon).expected_return
    assert model.initial @ values == pytest.approx(expected, abs=1e-9)


@given(models(), st.integers(1, 20))
def test_optimal_actions_followed_by_the_best_plan_earn_the_optimum(
    model: TransitionModel, horizon: int
) -> None:
    values, optimal = optimal_choices(model, horizon)
    plan = finite_horizon_optimum(model, horizon)
    np.testing.assert_array_equal(values, plan.values)
    assert optimal[np.arange(model.n_states), plan.actions(0)].all()
    for action in range(model.n_actions):
        first = np.full(model.n_states, action)
        found = state_values(model, np.vstack([first, plan.policy[1:]]), horizon)
        reached = model.reachable
        np.testing.assert_array_equal(
            optimal[reached, action], np.isclose(found, values, rtol=0, atol=1e-8)[reached]
        )


def test_wrong_arguments_are_refused() -> None:
    for horizon in (0, -1):
        with pytest.raises(ValueError, match=f"horizon is {horizon}, it must be at least 1"):
            state_values(corridor(), np.zeros(5, int), horizon)
        with pytest.raises(ValueError, match=f"horizon is {horizon}, it must be at least 1"):
            optimal_choices(corridor(), horizon)
    with pytest.raises(ValueError, match=r"outside 0..1"):
        state_values(corridor(), np.full(5, 2), 3)
