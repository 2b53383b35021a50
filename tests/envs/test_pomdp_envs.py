"""Environments that hide their state, against the literature's numbers and rules by hand."""

import gymnasium as gym
import numpy as np
import pytest

import envs  # noqa: F401 (registers the environments)
from envs.known_models import observations_of_states, time_limit, transition_model
from mdp import finite_horizon_optimum


def chances(env_id, state, action, **kwargs):
    """What may come of an action: the chance of each state, by its number."""
    model = transition_model(gym.make(env_id, **kwargs))
    found = np.zeros(model.n_states)
    np.add.at(found, model.next_state[state, action], model.prob[state, action])
    return found


# --- Tiger ---------------------------------------------------------------------------------------


def test_the_tiger_is_heard_where_it_is_with_the_accuracy():
    env = gym.make("Tiger-v0", accuracy=0.8)
    model, heard = transition_model(env), observations_of_states(env)
    hidden = [env.unwrapped.cell_of(state) for state in range(6)]
    assert list(zip(hidden, heard.tolist(), strict=True)) == [
        (tiger, sound) for tiger in (0, 1) for sound in (0, 1, 2)
    ]
    np.testing.assert_allclose(model.initial, [0.5, 0, 0, 0.5, 0, 0])
    for state in range(6):
        near, far = (0.8, 0.2) if hidden[state] == 0 else (0.2, 0.8)
        expected = np.zeros(6)
        expected[3 * hidden[state] + 1], expected[3 * hidden[state] + 2] = near, far
        np.testing.assert_allclose(chances("Tiger-v0", state, 0, accuracy=0.8), expected)
        for door in (1, 2):
            np.testing.assert_allclose(
                chances("Tiger-v0", state, door, accuracy=0.8), [0.5, 0, 0, 0.5, 0, 0]
            )
    rewards = [[-1.0, -100.0, 10.0]] * 3 + [[-1.0, 10.0, -100.0]] * 3
    np.testing.assert_allclose(model.expected_reward, rewards)
    assert finite_horizon_optimum(model, time_limit(env)).start_value == pytest.approx(100)


# --- Hallway -------------------------------------------------------------------------------------

NORTH, EAST, SOUTH, WEST = range(4)
STAY, FORWARD, RIGHT, AROUND, LEFT = range(5)


def places(cell, action, facing):
    """By cell and facing, the chances after an action; cells 0 to 10 are the row, then alcoves."""
    from envs.pomdp.hallway import _world

    world = _world()
    state = int(np.flatnonzero(world.hidden == 4 * cell + facing)[0])
    found = {}
    for place, chance in enumerate(chances("Hallway-v0", state, action)):
        if chance > 0:
            key = divmod(int(world.hidden[place]), 4)
            found[key] = found.get(key, 0) + chance
    return {key: pytest.approx(value) for key, value in found.items()}


# Rows of the file hallway.POMDP, with its states written as cell and facing.
@pytest.mark.parametrize(
    ("cell", "facing", "expected"),
    [
        (0, EAST, {(1, EAST): 0.8, (0, EAST): 0.2}),
        (2, EAST, {(3, EAST): 0.8, (11, SOUTH): 0.05, (1, EAST): 0.025, (1, WEST): 0.025,
                   (2, EAST): 0.1}),
        (2, NORTH, {(3, EAST): 0.05, (11, NORTH): 0.025, (11, SOUTH): 0.025, (1, WEST): 0.05,
                    (2, NORTH): 0.85}),
        (12, SOUTH, {(4, NORTH): 0.025, (4, SOUTH): 0.025, (12, SOUTH): 0.95}),
    ],
)  # fmt: skip
def test_moving_forward_is_that_of_the_original(cell, facing, expected):
    assert places(cell, FORWARD, facing) == expected


def test_turning_is_that_of_the_original():
    for facing in range(4):
        turned = [(5, (facing + turn) % 4) for turn in range(4)]
        for action, by_turn in (
            (RIGHT, (0.1, 0.7, 0.1, 0.1)), (AROUND, (0.1, 0.15, 0.6, 0.15)),
            (LEFT, (0.1, 0.1, 0.1, 0.7)),
        ):  # fmt: skip
            assert places(5, action, facing) == dict(zip(turned, by_turn, strict=True))
        assert places(5, STAY, facing) == {(5, facing): 1}


def test_readings_are_those_of_the_original():
    from envs.pomdp.hallway import _world

    env, world = gym.make("Hallway-v0"), _world()
    model = transition_model(env)

    def readings(cell, facing):
        """The chances of readings at the start, given where that is, as they are after staying."""
        there = np.flatnonzero(world.hidden == 4 * cell + facing)
        first, stayed = np.zeros(21), chances("Hallway-v0", there[0], STAY)
        np.add.at(first, world.reading[there], model.initial[there])
        later = np.bincount(world.reading[there], stayed[there], 21)
        np.testing.assert_allclose(later, first * 56)
        return later

    # Rows of O in the file, rounded there: walls to the north, south and west of the west end.
    first = readings(0, NORTH)
    assert first[[11, 15, 3, 9, 1, 0]] == pytest.approx(
        [0.692550, 0.036464, 0.076949, 0.076949, 0.008549, 0.000949], abs=3e-5
    )
    assert readings(1, EAST)[5] == pytest.approx(0.731024, abs=3e-5)
    assert readings(2, NORTH)[8] == pytest.approx(0.771637, abs=3e-5)
    for cell, sign in ((2, 16), (4, 17), (6, 18), (8, 19)):
        assert readings(cell, SOUTH)[sign] == pytest.approx(1)
    assert model.initial.sum() == pytest.approx(1)
    assert env.observation_space.n == 21
    # The goal's alcove ends the episode with the only reward.
    ends = model.terminated & (model.prob > 0) & model.reachable[:, None, None]
    assert set(model.reward[ends]) == {1.0}
    assert model.reward[~ends & (model.prob > 0) & model.reachable[:, None, None]].max() == 0


# --- DarkWarehouse -------------------------------------------------------------------------------


def test_the_dark_shows_the_four_cells_beside():
    env = gym.make("DarkWarehouse-v0", desc=["S.G", "#.."], random_start=False)
    seen = observations_of_states(env)
    # Above, below, left, right, in base 3: 1 a shelf or the wall, 2 the goal.
    assert [np.base_repr(code, 3).zfill(4) for code in seen.tolist()] == [
        "1110", "1002", "1001", "0110", "0110", "2101",
    ]  # fmt: skip
    assert env.reset(seed=0)[0] == seen[0]
    assert env.step(3)[0] == seen[1]
