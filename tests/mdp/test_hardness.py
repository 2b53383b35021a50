"""How hard worlds are: worked out by hand, and against brute force on random models."""

import math

import gymnasium as gym
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from rl_yardstick.envs.known_models import success_outcomes, time_limit, transition_model
from rl_yardstick.mdp import TransitionModel, finite_horizon_optimum, hardness, hardness_of
from tests.mdp.test_random_models import deterministic, models


def corridor(n, *, ends):
    """Left and right in n states; a step right from the last one earns 1, and may be the end."""
    places = np.arange(n)[:, None]
    last = places * np.array([0, 1]) == n - 1
    return deterministic(np.clip(places + np.array([-1, 1]), 0, n - 1), last, last & ends)


def choice(*rewards):
    """One state, in which each action earns something."""
    return deterministic([[0] * len(rewards)], [rewards], [[False] * len(rewards)])


def test_random_actions_take_n_squared_steps_to_the_end_of_a_corridor():
    """A walk that is held at 0 needs n (n + 1) steps to n; the limit of 10,000 cuts off none."""
    model = corridor(5, ends=True)
    waits = hardness.random_wait(model, model.reward > 0, 10_000)
    assert waits == pytest.approx((5 * 6, 1), rel=1e-9)
    # With three steps for three places, one episode of 8 gets there, and each takes 3 steps.
    model = corridor(3, ends=True)
    assert hardness.random_wait(model, model.reward > 0, 3) == pytest.approx((24.0, 8.0))
    assert hardness.random_wait(model, model.reward > 0, 2) == (math.inf, math.inf)


@pytest.mark.parametrize("size", [4, 9])
def test_the_sea_is_deep(size):
    """Looking k steps ahead pays if 2^-(size - k), the chance of the rest, exceeds their cost."""
    env = gym.make("DeepSea-v0", size=size)
    found = hardness_of(transition_model(env), time_limit(env), success_outcomes(env))
    assert found.random_episodes_to_reward == pytest.approx(2**size)
    assert found.random_steps_to_reward == pytest.approx(size * 2**size)
    assert found.random_steps_to_goal == found.random_steps_to_reward
    assert found.diameter == size - 1
    pays = [k for k in range(1, size + 1) if 2.0 ** (k - size) > 0.01 * k / size]
    assert found.lookahead == pays[0]
    # On the way down a wrong step loses the treasure and saves the cost of the rest, its own and
    # those below; beside the way, there is the cost of one step right to save.
    lost = [1 - 0.01 * (size - row) / size for row in range(size)]
    assert found.mean_gap == pytest.approx(np.mean(lost))
    assert found.smallest_gap == pytest.approx(0.01 / size)
    assert found.return_variance == pytest.approx(0, abs=1e-15)


def test_a_lake_that_is_not_slippery():
    """The ring of eight cells around a hole, and the three beside it: five steps at most."""
    env = gym.make("FrozenLake-v1", is_slippery=False)
    found = hardness_of(transition_model(env), time_limit(env), success_outcomes(env))
    assert (found.states, found.reachable_states) == (16, 11)
    assert (found.diameter, found.connected) == (5.0, 1.0)
    # With time left any step is as good, but for those into a hole.
    assert (found.smallest_gap, found.mean_gap) == (1.0, 1.0)
    assert found.return_variance == 0.0
    assert found.lookahead == 1


def test_two_arms():
    """With 20 pulls left: v = 9.5 * 19, b = 19 and d = 1 for both arms, so m = 6439."""
    model = choice(1.0, 0.0)
    assert hardness.action_gaps(model, finite_horizon_optimum(model, 20)) == (1.0, 1.0)
    lookahead, bound = hardness.looking_ahead(model, 20)
    episodes = math.ceil(8 * (9.5 * 19 + 19 / 6) * math.log(2 * 20 * 2))
    assert (lookahead, episodes) == (1, 6439)
    assert bound == pytest.approx(1 + math.log2(episodes))
    # Seven pulls can be tried in all combinations, with less.
    assert hardness.looking_ahead(model, 7) == (1, 7.0)


def test_arms_that_are_alike_are_no_mistake():
    found = hardness_of(choice(0.5, 0.5), 10)
    assert (found.smallest_gap, found.mean_gap) == (None, None)
    assert (found.lookahead, found.effective_horizon) == (1, 1.0)
    alone = hardness_of(choice(0.5), 10)
    assert (alone.lookahead, alone.effective_horizon) == (1, None)


def test_hitting_times_are_those_of_the_fastest_policy():
    """From 0 to 1 the better action takes four steps in the mean, and from there one leads back."""
    model = TransitionModel(
        prob=np.array([[[0.25, 0.75], [0.1, 0.9]], [[1.0, 0.0], [0.5, 0.5]]]),
        next_state=np.array([[[1, 0], [1, 0]], [[0, 1], [0, 1]]]),
        reward=np.zeros((2, 2, 2)),
        terminated=np.zeros((2, 2, 2), np.bool_),
        initial=np.array([1.0, 0.0]),
    )
    assert hardness.hitting_times(model, 1).tolist() == pytest.approx([4, 0])
    assert hardness.hitting_times(model, 0).tolist() == pytest.approx([0, 1])
    assert hardness.diameter(model) == pytest.approx((4, 1))


def worst_greedy_return(model, horizon, k):
    """The least that a policy earns that is greedy for Q(k), by recursion over what is left."""

    def after(state, action, value, left):
        at = state, action
        outcomes = zip(model.prob[at], model.next_state[at], strict=True)
        ends, reward = model.terminated[at], model.reward[at]
        return sum(
            chance * (reward[j] + (0 if ends[j] or left == 1 else value(following, left - 1)))
            for j, (chance, following) in enumerate(outcomes)
        )

    def q_values(state, left, depth):
        def value(following, fewer):
            values = q_values(following, fewer, max(depth - 1, 0))
            return max(values) if depth > 1 else sum(values) / len(values)

        return [after(state, action, value, left) for action in range(model.n_actions)]

    def worst(state, left):
        seems = q_values(state, left, k)
        greedy = [a for a, one in enumerate(seems) if one >= max(seems) - 1e-9]
        return min(after(state, action, worst, left) for action in greedy)

    starts = np.flatnonzero(model.initial > 0)
    return sum(model.initial[state] * worst(state, horizon) for state in starts)


@given(models(states=3, actions=2, outcomes=2), st.integers(1, 4))
def test_the_lookahead_is_the_first_depth_at_which_no_greedy_policy_fails(model, horizon):
    lookahead, bound = hardness.looking_ahead(model, horizon)
    optimum = finite_horizon_optimum(model, horizon).start_value
    solved = [
        worst_greedy_return(model, horizon, k) == pytest.approx(optimum, abs=1e-9)
        for k in range(1, lookahead + 1)
    ]
    assert solved == [False] * (lookahead - 1) + [True]
    assert bound is None or lookahead <= bound <= horizon
