"""Jack's car rental against a solution by matrices, written apart from the environment."""

import gymnasium as gym
import numpy as np
import pytest
from scipy.stats import poisson

import envs  # noqa: F401 (registers the environments)
from envs.known_models import action_masks_of_states

N = 21


@pytest.fixture(scope="module")
def days() -> list[tuple[np.ndarray, np.ndarray]]:
    counts = np.arange(60)
    pmf = {mean: poisson.pmf(counts, mean) for mean in (2, 3, 4)}
    found = []
    for requests, returns in ((3, 3), (4, 2)):
        chances, rentals = np.zeros((N, N)), np.zeros(N)
        for morning in range(N):
            for asked in range(60):
                rented = min(asked, morning)
                rentals[morning] += pmf[requests][asked] * rented
                evening = np.minimum(morning - rented + counts, 20)
                np.add.at(chances[morning], evening, pmf[requests][asked] * pmf[returns])
        found.append((chances, rentals))
    return found


def action_values(values: np.ndarray, days, exercise: bool) -> np.ndarray:
    """One sweep over all evenings and moves by the book's rules; -inf where cars are missing."""
    (first, first_rentals), (second, second_rentals) = days
    mornings = 10 * (first_rentals[:, None] + second_rentals) + 0.9 * first @ values @ second.T
    found = np.full((N, N, 11), -np.inf)
    for moved in range(-5, 6):
        for one in range(max(moved, 0), N):
            for two in range(max(-moved, 0), N):
                left, right = min(one - moved, 20), min(two + moved, 20)
                cost = 2 * abs(moved)
                if exercise:
                    cost -= 2 * (moved > 0)
                    cost += 4 * (left > 10) + 4 * (right > 10)
                found[one, two, moved + 5] = mornings[left, right] - cost
    return found


@pytest.mark.parametrize("variant", ["example", "exercise"])
def test_the_model_backs_values_up_as_the_book_does(variant, days) -> None:
    model = gym.make("JacksCarRental-v0", variant=variant).unwrapped.transition_model()
    values = np.random.default_rng(0).normal(500, 50, (N, N))
    by_hand = action_values(values, days, variant == "exercise").reshape(-1, 11)
    found = model.expected_reward + 0.9 * model.prob @ values.ravel()
    possible = np.isfinite(by_hand)
    np.testing.assert_allclose(found[possible], by_hand[possible], atol=1e-9)
    masks = action_masks_of_states(gym.make("JacksCarRental-v0", variant=variant))
    assert np.array_equal(masks, possible)
    # The states are the evenings, in the order of the outcomes.
    assert np.array_equal(model.next_state[0, 0], np.arange(N * N))


def test_optimal_values_and_policy_are_those_of_figure_4_2(days) -> None:
    values = np.zeros((N, N))
    for _ in range(40):
        policy = action_values(values, days, exercise=False).argmax(axis=2)
        values = evaluated(policy, days)
    assert np.abs(action_values(values, days, exercise=False).max(axis=2) - values).max() < 1e-6
    assert values[20, 20] == pytest.approx(636.99, abs=0.005)
    assert values[0, 0] == pytest.approx(421.41, abs=0.005)
    moves = policy - 5
    assert (moves.min(), moves.max()) == (-4, 5)
    # The borders of the figure: nothing to move with few cars, five from a full first place.
    assert moves[20].tolist() == [5, 5, 5, 5, 4, 4, 3, 3, 3, 3, 2, 2, 2, 2, 2, 1, 1, 1, 0, 0, 0]
    assert moves[0].tolist() == [0] * 8 + [-1, -1, -2, -2, -2, -3, -3, -3, -3, -3, -4, -4, -4]
    assert (np.diff(moves, axis=0) >= 0).all()
    assert (np.diff(moves, axis=1) <= 0).all()


def evaluated(policy: np.ndarray, days) -> np.ndarray:
    """The discounted values of a policy, by a linear system."""
    (first, first_rentals), (second, second_rentals) = days
    chances, rewards = np.zeros((N * N, N * N)), np.zeros(N * N)
    for state, action in enumerate(policy.ravel()):
        one, two = divmod(state, N)
        moved = int(action) - 5
        left, right = min(one - moved, 20), min(two + moved, 20)
        chances[state] = np.outer(first[left], second[right]).ravel()
        rewards[state] = 10 * (first_rentals[left] + second_rentals[right]) - 2 * abs(moved)
    return np.linalg.solve(np.eye(N * N) - 0.9 * chances, rewards).reshape(N, N)


def test_more_cars_than_there_are_cannot_be_moved() -> None:
    env = gym.make("JacksCarRental-v0", first_cars=2, second_cars=0).unwrapped
    env.reset(seed=0)
    assert env.s == 2 * N
    assert env.action_masks().tolist() == [False] * 5 + [True] * 3 + [False] * 3
    model = env.transition_model()
    for array in (model.prob, model.reward):
        np.testing.assert_array_equal(array[2 * N, 10], array[2 * N, 7])
        np.testing.assert_array_equal(array[2 * N, 0], array[2 * N, 5])


def test_what_is_seen_of_a_day() -> None:
    env = gym.make("JacksCarRental-v0", render_mode="ansi").unwrapped
    env.reset(seed=0)
    assert "cars at the first place   10/20" in env.render()
    env.step(7)
    assert env.render().startswith("(moved +2)")
