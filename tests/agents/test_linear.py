"""Tiles, semi-gradient control and policy gradients: by hand, and against exact gradients."""

import itertools
import math

import numpy as np
import pytest
from gymnasium import spaces
from hypothesis import given
from hypothesis import strategies as st
from scipy.special import softmax

from rl_yardstick.agents.linear.algorithm import make_tiles, tiles_of_all
from tests.agents.hand_fed import Told

UNIT = spaces.Box(0.0, 1.0, (2,))
UNBOUNDED = spaces.Box(np.array([-4.8, -np.inf], "f4"), np.array([4.8, np.inf], "f4"))


def active(tiles, *vectors):
    return tiles_of_all(tiles, np.array(vectors, dtype=np.float64)).tolist()


def test_two_tilings_of_a_square_by_hand():
    """Two tilings of 4 x 4 tiles: the second is displaced by half a tile in both directions.

    It has five tiles a side, as has the first, which leaves its last row and column empty. At
    (0.3, 0.6) the first is in tile (1, 2), which is 1 * 5 + 2; the second, whose tiles begin an
    eighth earlier, at (0.425, 0.725): the same tile, 25 further. At (0.4, 0.6) it is in (2, 2).
    """
    tiles = make_tiles(UNIT, n_tilings=2, n_tiles=4)
    assert (tiles.n_tilings, tiles.n_in_tiling, tiles.n_tiles) == (2, 25, 50)
    assert active(tiles, (0.3, 0.6)) == [[7, 32]]
    assert active(tiles, (0.4, 0.6)) == [[7, 25 + 2 * 5 + 2]]
    assert active(tiles, (0.0, 0.0), (1.0, 1.0)) == [[0, 25], [18, 25 + 24]]


BOUNDS = spaces.Box(np.array([-1.2, -0.07], "f4"), np.array([0.6, 0.07], "f4"))


def test_bounds_belong_to_the_space_and_what_lies_outside_to_the_bounds():
    tiles = make_tiles(BOUNDS, n_tilings=8, n_tiles=8)
    low, high = BOUNDS.low.astype(float), BOUNDS.high.astype(float)
    nearly = high - 1e-9
    assert active(tiles, high, high + 5, np.full(2, np.inf)) == 3 * active(tiles, nearly)
    lowest = active(tiles, low, low - 5, np.full(2, -np.inf), np.full(2, np.nan))
    assert lowest == 4 * active(tiles, low)
    assert set(active(tiles, low)[0]).isdisjoint(active(tiles, high)[0])


def test_bounds_are_the_spaces_unless_they_are_given():
    given = make_tiles(UNBOUNDED, low=[None, -3], high=[None, 3])
    assert given.dimensions["low"].tolist() == [float(np.float32(-4.8)), -3.0]
    assert given.dimensions["steps"].tolist() == [64 / (2 * float(np.float32(4.8))), 64 / 6]


@pytest.mark.parametrize(
    ("settings", "message"),
    [
        ({}, "dimension 1 of the observations has no bounds: give low and high, a number or 2 of"),
        ({"low": 1, "high": [2, 1]}, r"low must be below high, not 1 and 1 \(dimension 1\)"),
        ({"low": -1, "high": 1, "n_tiles": 3000}, r"make 216,144,024 weights for 3 actions, more"),
    ],
)
def test_settings_that_make_no_tiling(settings, message):
    with pytest.raises(ValueError, match=message):
        make_tiles(UNBOUNDED, **settings, n_actions=3)


LINE = spaces.Box(0.0, 4.0, (1,))
HERE, THERE = np.array([0.25], "f4"), np.array([2.25], "f4")


def on_a_line(name, n_tilings, epsilon, **settings):
    rates = {"exploration_initial_eps": epsilon, "exploration_final_eps": epsilon}
    told = Told(name, LINE, 2, n_tilings=n_tilings, n_tiles=2, gamma=0.5, **rates, **settings)
    return told, told.agent.policy.weights.numpy()


@pytest.mark.parametrize("name", ["semi_gradient_sarsa", "semi_gradient_q"])
@pytest.mark.parametrize(("end", "target"), [("", 2 + 0.5 * 6), ("terminated", 2.0)])
def test_an_update_by_hand(name, end, target):
    """From 0.25 to 2.25 by action 1, with reward 2, gamma .5 and a step size of .2.

    Two tilings of two tiles (three, as they are displaced by half a tile, which is 1). At 0.25
    tiles 0 and 3 are active, at 2.25 tiles 1 and 4. There, the actions are worth 3 + 1 and 5 + 1;
    at 0.25 action 1 is worth 1 + 2.
    """
    told, weights = on_a_line(name, 2, 0.0, learning_rate=0.2)
    weights[0], weights[3], weights[1], weights[4] = (0, 1), (0, 2), (3, 5), (1, 1)
    before = weights.copy()
    told.step(HERE, 1, 2, THERE, end)
    change = weights - before
    # The step size is shared out between the two tilings.
    assert change[[0, 3], 1] == pytest.approx([0.1 * (target - 3)] * 2, rel=1e-14)
    assert np.count_nonzero(change) == 2
    assert told.agent.mean_td_error == pytest.approx(abs(target - 3))
    assert told.committed == (1 if (name, end) == ("semi_gradient_sarsa", "") else -1)


def test_semi_gradient_sarsa_judges_by_the_action_that_it_commits_to():
    chosen = set()
    for seed in range(9):
        told, weights = on_a_line("semi_gradient_sarsa", 1, 1.0, learning_rate=1.0, seed=seed)
        weights[1] = 4, 6
        told.step(HERE, 0, 2, THERE)
        assert weights[0, 0] == 2 + 0.5 * weights[1, told.committed]
        chosen.add(told.committed)
    assert chosen == {0, 1}


@pytest.mark.parametrize("baseline", ["none", "value"])
def test_the_mean_update_of_all_episodes_is_the_exact_gradient(baseline):
    """Episodes lead through three layers of two states: returns times scores of all that was done.

    No state is met twice.
    """
    rng, start, discount = np.random.default_rng(0), (0.3, 0.7), 0.9
    onward = rng.dirichlet([1, 1], size=(6, 2))  # chances of the two states of the next layer
    rewards, preferences, state_values = (rng.normal(size=shape) for shape in ((6, 2), (6, 2), 6))
    settings = {"learning_rate": 0.25, "baseline": baseline}
    told = Told("reinforce", spaces.Discrete(7), gamma=discount, **settings)
    mean, gradient, total = np.zeros((6, 2)), np.zeros((6, 2)), 0.0
    policy = softmax(preferences, axis=1)
    weights, values = told.agent.policy.weights.numpy(), told.agent.policy.state_weights.numpy()
    for sides in itertools.product((0, 1), repeat=3):
        for actions in itertools.product((0, 1), repeat=3):
            weights[:6], values[:6] = preferences, state_values[: 6 * len(values)]
            prob, earned, scores = start[sides[0]], 0.0, np.zeros((6, 2))
            for t, action in enumerate(actions):
                state, is_last = 2 * t + sides[t], t == 2
                following = 6 if is_last else 2 * t + 2 + sides[t + 1]
                end, reward = "terminated" * is_last, rewards[state, action]
                told.step(state, action, reward, following, end)
                chance = 1 if is_last else onward[state, action, sides[t + 1]]
                prob *= policy[state, action] * chance
                earned += discount**t * reward
                scores[state] = np.eye(2)[action] - policy[state]
            mean += prob * (weights[:6] - preferences)
            gradient += prob * earned * scores
            total += prob
    assert total == pytest.approx(1, rel=1e-12)
    np.testing.assert_allclose(mean / 0.25, gradient, atol=1e-12)


def test_reinforce_by_hand():
    """Rewards 1 and 2, gamma .5: returns 2 and 2; the second counts by a half."""
    for gamma_power, second in ((True, 0.5), (False, 1.0)):
        settings = {"gamma": 0.5, "learning_rate": 0.1, "gamma_power": gamma_power}
        told = Told("reinforce", spaces.Discrete(3), **settings)
        told.step(0, 1, 1, 1)
        weights = told.agent.policy.weights.numpy()
        assert not weights.any()  # nothing before the end
        told.step(1, 0, 2, 2, "terminated")
        expected = [[-0.1, 0.1], [second * 0.1, -second * 0.1], [0, 0]]
        np.testing.assert_allclose(weights, expected, rtol=1e-14)
        assert told.agent.mean_td_error == 2


def test_where_an_episode_is_truncated_the_baseline_goes_on():
    for baseline, returns in (("none", 2.0), ("value", 2.0 + 0.5 * 6)):
        settings = {"gamma": 0.5, "learning_rate": 0.1, "value_step_size": 0.5}
        told = Told("reinforce", spaces.Discrete(3), baseline=baseline, **settings)
        values = told.agent.policy.state_weights.numpy()
        values[:] = np.array([1, 2, 6])[: len(values)]
        told.step(1, 0, 2, 2, "truncated")
        compared = 2 if baseline == "value" else 0
        change = 0.1 * (returns - compared) * 0.5
        weights = told.agent.policy.weights.numpy()
        np.testing.assert_allclose(weights[1], [change, -change], rtol=1e-14)
        assert values.tolist() == ([1, 2 + 0.5 * 3, 6] if baseline == "value" else [])


def test_actor_critic_by_hand():
    """TD error 2 + .5 * 4 - 1 = 3; of the second step, 1 + .5 * 0 - 4 = -3, by a half."""
    settings = {"gamma": 0.5, "learning_rate": 0.1, "value_step_size": 0.2}
    for gamma_power, second in ((True, 0.5), (False, 1.0)):
        told = Told("actor_critic", spaces.Discrete(3), gamma_power=gamma_power, **settings)
        values, weights = told.agent.policy.state_weights.numpy(), told.agent.policy.weights.numpy()
        values[:] = 1, 4, 0
        told.step(0, 1, 2, 1)
        np.testing.assert_allclose(values, [1.6, 4, 0], rtol=1e-14)
        np.testing.assert_allclose(weights, [[-0.15, 0.15], [0, 0], [0, 0]], rtol=1e-14)
        told.step(1, 1, 1, 2)
        np.testing.assert_allclose(values, [1.6, 3.4, 0], rtol=1e-14)
        np.testing.assert_allclose(weights[1], [0.15 * second, -0.15 * second], rtol=1e-14)
        # The third step ends it: what follows counts for nothing, whatever it is worth.
        told.step(2, 0, 4, 1, "terminated")
        assert values[2] == pytest.approx(0.8)
        third = 0.1 * 4 * 0.5 * (0.25 if gamma_power else 1)
        np.testing.assert_allclose(weights[2], [third, -third], rtol=1e-14)
        assert told.agent._memory.discounts.tolist() == [1]
        # Truncated, it counts.
        values[:] = 0, 2, 0
        told.step(0, 0, 1, 1, "truncated")
        assert values[0] == pytest.approx(0.2 * (1 + 0.5 * 2))


def test_values_and_preferences_begin_where_they_are_told_to():
    told, _ = on_a_line("semi_gradient_q", 4, 0.0, initial_q=3.0)
    np.testing.assert_allclose(told.agent.policy.sums(np.array([[0.1], [3.9]])), 3.0, rtol=1e-15)
    told = Told("reinforce", spaces.Discrete(2), initial_preferences=[np.log(19), 0])
    np.testing.assert_allclose(told.agent.action_probabilities(), [[0.95, 0.05]] * 2, rtol=1e-12)
    drawn = told.agent.predict(np.zeros(20_000, dtype=int))[0]
    assert drawn.mean() == pytest.approx(0.05, abs=5 * np.sqrt(0.05 * 0.95 / 20_000))
    assert told.agent.predict(np.array([0, 1]), deterministic=True)[0].tolist() == [0, 0]


def test_a_step_of_one_goes_along_the_gradient_of_the_logarithm():
    """Tiles share the step, so that it is a third at each."""
    told = Told("reinforce", UNIT, 3, n_tilings=3, n_tiles=2, learning_rate=1.0)
    weights = told.agent.policy.weights.numpy()
    weights[:] = before = np.random.default_rng(0).normal(size=weights.shape)
    obs, action, expected = np.array([0.3, 0.8], "f4"), 2, np.zeros_like(weights)
    (tiles,) = active(make_tiles(UNIT, n_tilings=3, n_tiles=2), obs)
    expected[tiles] = (np.eye(3)[action] - softmax(before[tiles].sum(axis=0))) / 3
    told.step(obs, action, 1.0, obs, "terminated")
    np.testing.assert_allclose(weights - before, expected, atol=1e-9)


PLACES = st.tuples(st.floats(-2, 2, width=32), st.floats(-0.125, 0.125, width=32))


@given(st.integers(1, 16), st.tuples(*[st.integers(1, 9)] * 2), PLACES, PLACES)
def test_places_share_as_many_tiles_as_the_displacements_say(n, counts, first, second):
    """In rationals: tiling t has an edge every tile, displaced by (2 d + 1) t / n tiles."""
    tiles, shared = make_tiles(BOUNDS, n_tilings=n, n_tiles=list(counts)), 0
    sizes = BOUNDS.low.astype(float), tiles.dimensions["steps"], counts
    for t in range(n):
        cells = []
        for place in (first, second):
            steps = [
                min(max(math.floor((x - low) * per_unit), 0), count * n - 1)
                for x, low, per_unit, count in zip(place, *sizes, strict=True)
            ]
            cells.append([(step + t * (2 * d + 1) % n) // n for d, step in enumerate(steps)])
        shared += cells[0] == cells[1]
    one, other = active(tiles, first, second)
    assert len(set(one) & set(other)) == shared
    assert [tile // tiles.n_in_tiling for tile in one] == list(range(n))
    assert max(one) < tiles.n_tiles
