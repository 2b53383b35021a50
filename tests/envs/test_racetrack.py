"""The racetrack of exercise 5.12: its tracks, and every kind of step by hand."""

import gymnasium as gym
import numpy as np
import pytest

import envs  # noqa: F401 (registers the environments)
from envs.textbook.racetrack import LEFT_TRACK, RIGHT_TRACK, TRACKS, crossed_cells
from mdp import finite_horizon_optimum

COAST, FASTER_UP, SLOWER_UP, FASTER_RIGHT, SLOWER_RIGHT = 4, 7, 1, 5, 3


@pytest.fixture(scope="module")
def car():
    return gym.make("Racetrack-v0", noise=0).unwrapped


def cells(rows):
    """The cells of a track, by row and column."""
    width = len(rows[0])
    return [divmod(i, width) for i, letter in enumerate("".join(rows)) if letter != "#"]


def state(row, column, up=0, right=0):
    return 25 * cells(LEFT_TRACK).index((row, column)) + 5 * up + right


def outcomes(env, start, action):
    """What may come of an action: (row, column, up, right), terminated, by probability."""
    model = env.transition_model()
    found = {}
    columns = (model.prob, model.next_state, model.terminated)
    for prob, after, ends in zip(*(column[start, action] for column in columns), strict=True):
        if prob > 0:
            place = cells(env.rows)[after // 25]
            key = (*place, after // 5 % 5, after % 5), bool(ends)
            found[key] = found.get(key, 0) + prob
    return found


def test_sizes_of_the_tracks() -> None:
    shapes = {name: (len(rows), {len(row) for row in rows}) for name, rows in TRACKS.items()}
    assert shapes == {"left": (32, {17}), "right": (30, {32})}
    letters = {name: "".join(rows) for name, rows in TRACKS.items()}
    assert {name: text.count("S") for name, text in letters.items()} == {"left": 6, "right": 23}
    assert {name: text.count("G") for name, text in letters.items()} == {"left": 6, "right": 9}
    assert [len(cells(rows)) for rows in (LEFT_TRACK, RIGHT_TRACK)] == [298, 515]
    for rows in TRACKS.values():
        assert {row[-1] for row in rows} == {"G", "#"}
        assert set(rows[-1]) == {"S", "#"}


@pytest.mark.parametrize(
    ("up", "right", "path"),
    [
        (0, 0, []),
        (3, 0, [(1, 0), (2, 0), (3, 0)]),
        (2, 2, [(1, 1), (2, 2)]),
        (1, 2, [(0, 1), (1, 1), (1, 2)]),
        (1, 3, [(0, 1), (1, 2), (1, 3)]),
        (3, 4, [(0, 1), (1, 1), (1, 2), (2, 2), (2, 3), (3, 3), (3, 4)]),
    ],
)
def test_the_cells_that_a_line_enters(up, right, path) -> None:
    assert crossed_cells(up, right) == path
    assert crossed_cells(right, up) == [(column, row) for row, column in path]


@pytest.mark.parametrize("up", range(5))
@pytest.mark.parametrize("right", range(5))
def test_a_line_enters_the_cells_that_its_points_lie_in(up, right) -> None:
    # Many points of the line, none of them on a border between cells.
    shares = (np.arange(10_000) + 0.5) / 10_000 + 1e-7
    points = {(int(up * t + 0.5), int(right * t + 0.5)) for t in shares if t <= 1}
    assert set(crossed_cells(up, right)) == points - {(0, 0)}


def test_a_car_moves_by_its_new_velocity(car) -> None:
    assert outcomes(car, state(31, 4), FASTER_UP) == {((30, 4, 1, 0), False): 1.0}
    assert outcomes(car, state(20, 5, 2, 1), FASTER_RIGHT) == {((18, 7, 2, 2), False): 1.0}
    assert outcomes(car, state(20, 5, 2, 0), COAST) == {((18, 5, 2, 0), False): 1.0}


def test_velocities_stay_between_0_and_4_and_the_car_does_not_stop(car) -> None:
    assert outcomes(car, state(20, 5, 4, 0), FASTER_UP) == {((16, 5, 4, 0), False): 1.0}
    assert outcomes(car, state(20, 5, 2, 0), SLOWER_RIGHT) == {((18, 5, 2, 0), False): 1.0}
    assert outcomes(car, state(20, 5, 1, 0), SLOWER_UP) == {((19, 5, 1, 0), False): 1.0}
    # On the starting line it may.
    assert outcomes(car, state(31, 5, 0, 1), SLOWER_RIGHT) == {((31, 5, 0, 0), False): 1.0}
    assert outcomes(car, state(31, 5), COAST) == {((31, 5, 0, 0), False): 1.0}


def back_to_the_line(chance=1.0):
    return {((31, column, 0, 0), False): pytest.approx(chance / 6) for column in range(3, 9)}


def test_a_car_that_leaves_the_track_is_put_back(car) -> None:
    assert outcomes(car, state(20, 8, 1, 0), FASTER_RIGHT) == back_to_the_line()
    # The new cell is on the track, and a cell on the way to it is not.
    assert outcomes(car, state(8, 8, 2, 2), FASTER_UP) == back_to_the_line()


def test_the_finishing_line_ends_the_episode_whatever_lies_beyond(car) -> None:
    assert outcomes(car, state(2, 15, 0, 4), COAST) == {((2, 16, 0, 4), True): 1.0}
    assert outcomes(car, state(0, 15, 1, 4), COAST) == {((0, 16, 1, 4), True): 1.0}
    # Beyond the upper edge before the finishing line is no finish.
    assert outcomes(car, state(0, 13, 3, 3), COAST) == back_to_the_line()


def test_with_noise_the_velocity_stays_as_it_is() -> None:
    car = gym.make("Racetrack-v0").unwrapped
    found = outcomes(car, state(20, 5, 2, 0), FASTER_RIGHT)
    expected = {((18, 6, 2, 1), False): 0.9, ((18, 5, 2, 0), False): 0.1}
    assert found == {key: pytest.approx(chance) for key, chance in expected.items()}
    found = outcomes(car, state(20, 8, 1, 0), FASTER_RIGHT)
    expected = {**back_to_the_line(0.9), ((19, 8, 1, 0), False): pytest.approx(0.1)}
    assert found == expected
    assert outcomes(car, state(20, 8, 1, 1), FASTER_RIGHT) == back_to_the_line()
    assert (car.transition_model().reward == -1).all()


def test_without_noise_planning_is_as_fast_as_a_search(car) -> None:
    model = car.transition_model()
    shortest = np.array([shortest_way(model, start) for start in np.flatnonzero(model.initial)])
    assert shortest.tolist() == [10, 10, 10, 10, 11, 12]
    # From the last cell a crash is a gain: one step, and then the mean m of all cells. With that,
    # 6 m = 10 + 10 + 10 + 10 + 11 + (1 + m).
    optimum = finite_horizon_optimum(model, 1000).start_value
    assert optimum == pytest.approx(-52 / 5)


def shortest_way(model, start: int) -> int:
    """Steps to the finishing line without a crash, by breadth-first search."""
    frontier, seen, steps = {start}, {start}, 0
    while frontier:
        steps += 1
        rows = np.array(sorted(frontier))
        sure = model.prob[rows] == 1
        if (sure & model.terminated[rows]).any():
            return steps
        frontier = set(model.next_state[rows][sure].tolist()) - seen
        seen |= frontier
    raise AssertionError("no way")
