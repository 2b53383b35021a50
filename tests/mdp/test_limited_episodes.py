"""The three ways of evaluating a policy under a time limit, and the optimum of a limit far away."""

import itertools
from dataclasses import replace

import gymnasium as gym
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray

from envs.known_models import time_limit, transition_model
from mdp import (
    TransitionModel,
    baseline_policies,
    baseline_return,
    finite_horizon_optimum,
    optimum_far_from_limit,
    policy_return,
    state_values,
    value_iteration,
)
from mdp.evaluation import LimitedEpisodes
from mdp.large_maps import _chance_of_losing, _drift


def random_model(seed: int, outcomes: int, reward: float | None = None) -> TransitionModel:
    """A model of up to six states; with ``reward``, each step that goes on earns that."""
    rng = np.random.default_rng(seed)
    shape = (int(rng.integers(1, 7)), int(rng.integers(1, 4)), outcomes)
    prob = rng.dirichlet(np.ones(outcomes), shape[:2]) * (rng.random(shape) < 0.7)
    prob[..., 0] += 1 - prob.sum(axis=-1)
    terminated = rng.random(shape) < 0.3
    rewards = rng.integers(-3, 4, shape).astype(float)
    return TransitionModel(
        prob=np.clip(prob, 0, 1),
        next_state=rng.integers(0, shape[0], shape),
        reward=rewards if reward is None else np.where(terminated, rewards, reward),
        terminated=terminated,
        initial=rng.dirichlet(np.ones(shape[0])),
    )


def figures(model: TransitionModel, policy: NDArray, horizon: int, discount: float) -> NDArray:
    success = model.terminated & (model.reward > 0)
    found = policy_return(model, policy, horizon, discount, success)
    return np.array(list(vars(found).values()))


@given(
    seed=st.integers(0, 10_000),
    outcomes=st.integers(1, 3),
    horizon=st.integers(1, 70),
    discount=st.sampled_from([1.0, 0.9, 0.0]),
    is_random=st.booleans(),
)
@settings(deadline=None)
def test_all_ways_come_to_the_same(
    seed: int, outcomes: int, horizon: int, discount: float, is_random: bool
) -> None:
    model = random_model(seed, outcomes)
    rng = np.random.default_rng(seed)
    matrix = rng.dirichlet(np.ones(model.n_actions), model.n_states)
    policy = matrix if is_random else matrix.argmax(axis=1)
    found, values = figures(model, policy, horizon, discount), state_values(model, policy, horizon)
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(LimitedEpisodes, "along_ways", lambda *_: None)
        backwards = figures(model, policy, horizon, discount)
        values_backwards = state_values(model, policy, horizon)
        patch.setattr("mdp.evaluation.MOST_BACKWARDS", 0)
        forwards = figures(model, policy, horizon, discount)
    np.testing.assert_allclose(found, backwards, rtol=1e-10, atol=1e-10)
    np.testing.assert_allclose(forwards, backwards, rtol=1e-10, atol=1e-9)
    np.testing.assert_allclose(values, values_backwards, rtol=1e-10, atol=1e-10)


def test_a_way_that_goes_round_for_a_million_steps() -> None:
    """0 leads to 1, and 1 and 2 to each other, for 1, 2 and 3; seven steps are 1 + 3 (2 + 3)."""
    model = TransitionModel(
        prob=np.ones((3, 1, 1)),
        next_state=np.array([1, 2, 1]).reshape(3, 1, 1),
        reward=np.array([1.0, 2.0, 3.0]).reshape(3, 1, 1),
        terminated=np.zeros((3, 1, 1), bool),
        initial=np.array([1.0, 0, 0]),
    )
    policy = np.zeros(3, int)
    assert policy_return(model, policy, 7).expected_return == 16
    assert policy_return(model, policy, 10**6 + 1).expected_return == 1 + 5 * 10**6 / 2
    assert policy_return(model, policy, 10**6 + 1).expected_length == 10**6 + 1


@given(seed=st.integers(0, 10_000), horizon=st.integers(1, 30))
@settings(deadline=None)
def test_giving_up_early_changes_no_baseline(seed: int, horizon: int) -> None:
    model = random_model(seed, 2)
    returns = [
        policy_return(model, policy, horizon).expected_return for policy in baseline_policies(model)
    ]
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("mdp.evaluation.MOST_BACKWARDS", 0)
        assert baseline_return(model, horizon) == pytest.approx(max(returns), abs=1e-10)


def test_a_hopeless_policy_is_given_up() -> None:
    """Each step costs 1 and the end, which comes with probability 0.1, pays 5."""
    model = TransitionModel(
        prob=np.array([[[0.9, 0.1]]]),
        next_state=np.zeros((1, 1, 2), int),
        reward=np.array([[[-1.0, 5.0]]]),
        terminated=np.array([[[False, True]]]),
        initial=np.ones(1),
    )
    worth = policy_return(model, np.array([0]), 100).expected_return

    def told(floor: float) -> float:
        episodes = LimitedEpisodes(model, np.zeros((1, 1), int), 100)
        none = np.zeros((1, 1, 2), bool)
        return episodes.result(1.0, none, with_success=False, floor=floor).expected_return

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("mdp.evaluation.MOST_BACKWARDS", 0)
        assert told(worth - 1e-9) == pytest.approx(worth)
        assert told(worth + 0.5) == -np.inf


# --- a limit far away ----------------------------------------------------------------------------


@given(seed=st.integers(0, 10_000), outcomes=st.integers(1, 3), horizon=st.integers(1, 4000))
@settings(deadline=None)
def test_what_is_said_without_the_steps_is_the_optimum(
    seed: int, outcomes: int, horizon: int
) -> None:
    model = random_model(seed, outcomes, reward=-1.0)
    found = optimum_far_from_limit(model, horizon)
    if found is not None:
        assert found == pytest.approx(finite_horizon_optimum(model, horizon).start_value, abs=2e-9)


@pytest.mark.parametrize("slip", [0.0, 0.1])
def test_of_a_warehouse_it_is_found(slip: float) -> None:
    env = gym.make("envs:RandomWarehouse-v0", size=15, slip=slip, max_episode_steps=5000)
    model, horizon = transition_model(env), time_limit(env)
    assert model is not None
    assert horizon is not None
    found, expected = optimum_far_from_limit(model, horizon), finite_horizon_optimum(model, horizon)
    assert found == pytest.approx(expected.start_value, abs=1e-6)


def far_goal(length: int, **changes: float) -> TransitionModel:
    """A corridor: 1 goes on, 0 stays; each step costs 1, and what is changed."""
    shape = (length, 2, 1)
    ahead = np.stack([np.arange(length), np.minimum(np.arange(length) + 1, length - 1)], axis=1)
    terminated = np.zeros(shape, bool)
    terminated[-1, 1] = True
    return TransitionModel(
        prob=np.ones(shape),
        next_state=ahead.reshape(shape),
        reward=np.where(terminated, changes.get("end", 0.0), changes.get("step", -1.0)),
        terminated=terminated,
        initial=np.eye(length)[0],
    )


def test_a_limit_that_matters_is_noticed() -> None:
    # With an end that costs 50, 30 steps of standing still are better; and 60 are no better than
    # 10 steps to the end, which is too close to call without looking.
    for limit, end in itertools.product((30, 58, 62), (-50.0,)):
        assert optimum_far_from_limit(far_goal(10, end=end), limit) is None
    assert optimum_far_from_limit(far_goal(10, end=-50.0), 200) == -59.0
    assert finite_horizon_optimum(far_goal(10, end=-50.0), 30).start_value == -30.0
    # Where steps cost nothing, or nobody arrives, nothing can be said.
    assert optimum_far_from_limit(far_goal(10, step=0.0, end=5.0), 10**6) is None
    endless = far_goal(10)
    model = TransitionModel(
        endless.prob, endless.next_state, endless.reward, np.zeros((10, 2, 1), bool), np.eye(10)[0]
    )
    assert optimum_far_from_limit(model, 10**6) is None


def test_how_values_change_on_the_way() -> None:
    """From state 0 one slips back to it with probability 1/4, else on to 1, which ends for 4."""
    model = TransitionModel(
        prob=np.array([[[0.75, 0.25]], [[1.0, 0.0]]]),
        next_state=np.array([[[1, 0]], [[0, 0]]]),
        reward=np.array([[[-1.0, -3.0]], [[4.0, 0.0]]]),
        terminated=np.array([[[False, False]], [[True, False]]]),
        initial=np.array([1.0, 0.0]),
    )
    values = value_iteration(model, 1.0).values
    assert values == pytest.approx([2.0, 4.0])  # v = 0.75 (4 - 1) + 0.25 (v - 3)
    step_cost, fall, variance = _drift(
        model.prob, model.next_state, model.terminated, model.reward, model.reachable, values
    )
    # Of the rises 2 and 0 the mean is 1.5, and the variance 0.75 * 0.25 + 0.25 * 2.25.
    assert (step_cost, fall, variance) == pytest.approx((1.0, 1.5, 0.75))
    bound = _chance_of_losing(10.0, 1.5, 0.75, 100)
    assert bound == pytest.approx(np.exp(-100 / (150 + 10)))
    assert _chance_of_losing(-1.0, 1.5, 0.75, 100) == 1.0
    assert _chance_of_losing(1.0, 0.0, 0.0, 100) == 0.0


def test_a_task_that_never_ends_is_not_planned_without_a_limit(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    model = far_goal(10)
    endless = replace(model, terminated=np.zeros_like(model.terminated))
    monkeypatch.setattr("mdp.large_maps.value_iteration", lambda *args: pytest.fail("planned"))
    assert optimum_far_from_limit(endless, 200) is None
