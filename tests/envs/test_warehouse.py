"""The warehouse: rewards worked by hand, its optimum by exhaustive search, its arguments."""

import itertools
import subprocess
import sys
import tracemalloc
from collections import Counter
from typing import Any

import gymnasium as gym
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from envs.grid import GridWorld
from envs.warehouse import DEFAULT_MAP, RandomWarehouseEnv, WarehouseEnv

UP, DOWN, LEFT, RIGHT = range(4)
# Read off the map by eye.
ROUTE = "RRRRRUURRUULLUURURRRUU"
BY_LETTER = {"U": UP, "D": DOWN, "L": LEFT, "R": RIGHT}


def walk(env: GridWorld, actions: list[int]) -> list[tuple[Any, ...]]:
    return [env.step(action) for action in actions]


def best_return(env: GridWorld, n_steps: int) -> float:
    """The largest return within so many steps, from stepping out of every state once."""
    assert isinstance(env.observation_space, gym.spaces.Discrete)
    n_states = int(env.observation_space.n)
    target = np.zeros((n_states, 4), int)
    reward = np.zeros((n_states, 4))
    goes_on = np.zeros((n_states, 4))
    for state, action in itertools.product(range(n_states), range(4)):
        env.s = state
        _, reward[state, action], terminated, _, _ = env.step(action)
        target[state, action], goes_on[state, action] = env.s, not terminated
    values = np.zeros(n_states)
    for _ in range(n_steps):
        values = (reward + goes_on * values[target]).max(axis=1)
    return float(values[env.map.start])


def test_spaces_and_time_limit() -> None:
    env = gym.make("Warehouse-v0")
    assert env.observation_space == gym.spaces.Discrete(100)
    assert env.action_space == gym.spaces.Discrete(4)
    env.reset(seed=0)
    truncated = [env.step(LEFT)[3] for _ in range(1000)]
    assert truncated == [False] * 999 + [True]


def test_rewards_worked_by_hand() -> None:
    env = WarehouseEnv()
    observation, info = env.reset(seed=0)
    assert (observation, info["position"]) == (90, (9, 0))
    # Against the wall, up, against a shelf, off the map, back.
    steps = walk(env, [DOWN, LEFT, UP, RIGHT, LEFT, DOWN])
    assert [step[0] for step in steps] == [90, 90, 80, 80, 80, 90]
    assert [step[1] for step in steps] == [-1, -1, -1, -100, -1, -1]
    assert [step[4]["bumped"] for step in steps] == [True, True, False, True, True, False]
    assert not any(step[2] or step[3] for step in steps)


def test_the_shortest_way_earns_79() -> None:
    env = WarehouseEnv()
    env.reset(seed=0)
    steps = walk(env, [BY_LETTER[letter] for letter in ROUTE])
    assert len(steps) == 22
    assert [step[1] for step in steps] == [-1] * 21 + [100]
    assert [step[2] for step in steps] == [False] * 21 + [True]
    assert [step[4]["is_success"] for step in steps] == [False] * 21 + [True]
    assert steps[-1][4]["position"] == (0, 9)
    assert sum(step[1] for step in steps) == 79


def test_after_the_end_nothing_moves() -> None:
    env = WarehouseEnv()
    env.reset(seed=0)
    env.s = 9
    assert env.step(DOWN)[:3] == (9, 0.0, True)


def test_79_is_the_best_return_under_either_shelf_reward() -> None:
    assert best_return(WarehouseEnv(), 1000) == 79
    assert best_return(WarehouseEnv(shelf_reward=-1), 1000) == 79
    assert best_return(WarehouseEnv(), 21) == -21


def test_there_are_two_shortest_paths_and_62_cells_to_stand_on() -> None:
    """Counted on the text of the map, apart from the package's own search."""
    free = {
        (row, column): letter
        for row, letters in enumerate(DEFAULT_MAP)
        for column, letter in enumerate(letters)
        if letter != "#"
    }
    ways, moves, visited = Counter({(9, 0): 1}), 0, {(9, 0)}
    while (0, 9) not in ways:
        further: Counter[tuple[int, int]] = Counter()
        for (row, column), n in ways.items():
            for cell in (
                (row - 1, column),
                (row + 1, column),
                (row, column - 1),
                (row, column + 1),
            ):
                if cell in free and cell not in visited:
                    further[cell] += n
        visited |= further.keys()
        ways, moves = further, moves + 1
    env = WarehouseEnv()
    assert (moves, ways[0, 9]) == (22, 2)
    assert env.shortest_path_length == 22
    assert len(free) == 62
    assert np.count_nonzero(env.map.distances >= 0) == 62


@pytest.mark.parametrize(("shelf_reward", "expected"), [(-100, -27_427), (-1, -776)])
def test_the_random_policys_expected_return(shelf_reward: float, expected: float) -> None:
    model = WarehouseEnv(shelf_reward=shelf_reward).transition_model()
    goes_on = ~model.terminated[..., 0]
    values = np.zeros(100)
    for _ in range(1000):
        values = (model.reward[..., 0] + goes_on * values[model.next_state[..., 0]]).mean(axis=1)
    assert round(float(values @ model.initial)) == expected


@pytest.mark.parametrize(("gamma", "expected"), [(0.9, 2.0361), (0.5, -1.99995), (0.1, -1.1111)])
@pytest.mark.parametrize("shelf_reward", [-100, -1])
def test_discounted_values_of_the_start(gamma: float, expected: float, shelf_reward: float) -> None:
    model = WarehouseEnv(shelf_reward=shelf_reward).transition_model()
    goes_on = gamma * ~model.terminated[..., 0]
    values = np.zeros(100)
    for _ in range(500):
        values = (model.reward[..., 0] + goes_on * values[model.next_state[..., 0]]).max(axis=1)
    assert values @ model.initial == pytest.approx(expected, abs=5e-5)


def test_the_rewards_are_arguments() -> None:
    env = WarehouseEnv(desc=["S#", ".G"], shelf_reward=-7, step_reward=-0.5, goal_reward=3)
    env.reset(seed=0)
    assert [step[1] for step in walk(env, [RIGHT, UP, DOWN, RIGHT])] == [-7.0, -0.5, -0.5, 3.0]


def test_slip_goes_to_both_sides_in_the_stated_order() -> None:
    env = WarehouseEnv(desc=["...", ".S.", "..G"], slip=0.2)
    middle = env.P[4]
    assert middle[UP] == [(0.8, 1, -1.0, False), (0.1, 3, -1.0, False), (0.1, 5, -1.0, False)]
    assert middle[DOWN] == [(0.8, 7, -1.0, False), (0.1, 3, -1.0, False), (0.1, 5, -1.0, False)]
    assert middle[LEFT] == [(0.8, 3, -1.0, False), (0.1, 1, -1.0, False), (0.1, 7, -1.0, False)]
    assert middle[RIGHT] == [(0.8, 5, -1.0, False), (0.1, 1, -1.0, False), (0.1, 7, -1.0, False)]


def test_slipping_against_a_shelf_costs_as_much_as_driving_there() -> None:
    env = WarehouseEnv(desc=["#", "S", "G"], slip=1)
    assert env.P[1][LEFT] == [(0.0, 1, -1.0, False), (0.5, 1, -100.0, False), (0.5, 2, 100.0, True)]


def test_slip_happens_as_often_as_stated() -> None:
    """20,000 moves from the middle; four standard deviations are 113 and 85 moves."""
    env = WarehouseEnv(desc=["...", ".S.", "..G"], slip=0.2)
    env.reset(seed=3)
    reached: Counter[int] = Counter()
    for _ in range(20_000):
        env.s = 4
        env.step(UP)
        reached[env.s] += 1
    assert set(reached) == {1, 3, 5}
    assert abs(reached[1] - 16_000) < 4 * 56.6
    assert abs(reached[3] - 2_000) < 4 * 42.5
    assert abs(reached[5] - 2_000) < 4 * 42.5


def test_random_starts_leave_out_the_goal_shelves_and_what_is_cut_off() -> None:
    env = WarehouseEnv(desc=["S.G#.", "..###"], random_start=True)
    assert np.flatnonzero(env.initial_state_distrib).tolist() == [0, 1, 5, 6]
    assert np.count_nonzero(WarehouseEnv(random_start=True).initial_state_distrib) == 61


def test_position_is_normalised() -> None:
    env = WarehouseEnv(desc=["S....", ".....", "....G"], observation="position")
    assert env.observation_space == gym.spaces.Box(0, 1, (2,), np.float32)
    observation, _ = env.reset(seed=0)
    assert isinstance(observation, np.ndarray)
    assert observation.dtype == np.float32
    assert observation.tolist() == [0, 0]
    assert [step[0].tolist() for step in walk(env, [DOWN, RIGHT])] == [[0.5, 0], [0.5, 0.25]]
    batch = env.observation_of(np.array([0, 6, 14]))
    assert batch.dtype == np.float32
    assert batch.tolist() == [[0, 0], [0.5, 0.25], [1, 1]]


def test_one_hot() -> None:
    env = WarehouseEnv(desc=["S.", ".G"], observation="one_hot")
    assert env.observation_space == gym.spaces.Box(0, 1, (4,), np.float32)
    observation, _ = env.reset(seed=0)
    assert isinstance(observation, np.ndarray)
    assert observation.dtype == np.float32
    assert observation.tolist() == [1, 0, 0, 0]
    assert env.step(RIGHT)[0].tolist() == [0, 1, 0, 0]  # type: ignore[union-attr]
    assert env.observation_of(np.array([3, 2])).tolist() == [[0, 0, 0, 1], [0, 0, 1, 0]]


def test_states_are_observed_as_they_are_by_default() -> None:
    assert WarehouseEnv().observation_of(np.array([4, 90])).tolist() == [4, 90]


def test_an_unknown_observation_is_refused() -> None:
    with pytest.raises(ValueError, match=r"'positon': did you mean 'position'\? It must be one of"):
        WarehouseEnv(observation="positon")
    with pytest.raises(ValueError, match="'xyz': it must be one of discrete, position, one_hot"):
        WarehouseEnv(observation="xyz")


@st.composite
def maps(draw: st.DrawFn) -> list[str]:
    """Small maps, whether or not they can be solved."""
    n_rows, n_columns = draw(st.integers(1, 5)), draw(st.integers(2, 5))
    size = n_rows * n_columns
    letters = draw(st.lists(st.sampled_from("..#"), min_size=size, max_size=size))
    start, goal = draw(st.lists(st.integers(0, size - 1), min_size=2, max_size=2, unique=True))
    letters[start], letters[goal] = "S", "G"
    return ["".join(letters[i : i + n_columns]) for i in range(0, size, n_columns)]


def rules(rows: list[str], state: int, action: int) -> tuple[int, float, bool, bool]:
    """What the warehouse's description says, spelt out: state, reward, terminated, bumped."""
    row, column = divmod(state, len(rows[0]))
    row += {UP: -1, DOWN: 1}.get(action, 0)
    column += {LEFT: -1, RIGHT: 1}.get(action, 0)
    if row < 0 or column < 0 or row == len(rows) or column == len(rows[0]):
        return state, -1, False, True
    if rows[row][column] == "#":
        return state, -100, False, True
    at_goal = rows[row][column] == "G"
    return row * len(rows[0]) + column, 100 if at_goal else -1, at_goal, False


def flood(desc: list[str]) -> set[int]:
    """The cells that can be reached from the start, the goal included."""
    n_columns = len(desc[0])
    text = "".join(desc)
    found, waiting = set(), [text.index("S")]
    while waiting:
        state = waiting.pop()
        if state not in found:
            found.add(state)
            if text[state] != "G":
                waiting += [rules(desc, state, action)[0] for action in range(4)]
    assert n_columns * len(desc) == len(text)
    return found


@given(maps(), st.sampled_from([0, 0.25, 1]), st.integers(0, 2**32))
def test_any_map_follows_the_rules_or_is_refused(desc: list[str], slip: float, seed: int) -> None:
    reachable = flood(desc)
    if "".join(desc).index("G") not in reachable:
        with pytest.raises(ValueError, match="cannot be reached"):
            WarehouseEnv(desc=desc, slip=slip)
        return
    env = WarehouseEnv(desc=desc, slip=slip)
    model = env.transition_model()
    assert np.allclose(model.prob.sum(axis=2), 1)
    text = "".join(desc)
    sideways = {UP: (LEFT, RIGHT), DOWN: (LEFT, RIGHT), LEFT: (UP, DOWN), RIGHT: (UP, DOWN)}
    for state in reachable - {text.index("G")}:
        for action in range(4):
            for k, direction in enumerate((action, *sideways[action])[: model.n_outcomes]):
                listed = (model.next_state, model.reward, model.terminated)
                outcome = tuple(array[state, action, k] for array in listed)
                assert outcome == rules(desc, state, direction)[:3]
    env.reset(seed=seed)
    for action in np.random.default_rng(seed).integers(4, size=30):
        before = env.s
        _, reward, terminated, _, info = env.step(int(action))
        possible = [rules(desc, before, way) for way in (action, *sideways[int(action)])]
        outcome = (env.s, reward, terminated, info["bumped"])
        assert outcome in (possible if slip else possible[:1])
        assert env.s in reachable
        if terminated:
            env.reset()


def test_a_random_warehouse_is_limited_by_ten_shortest_paths() -> None:
    env = gym.make("envs:RandomWarehouse-v0", size=50)
    limit = 10 * env.unwrapped.shortest_path_length  # type: ignore[attr-defined]
    assert limit >= 10 * 98
    assert env.spec is not None
    assert env.spec.max_episode_steps == limit
    env.reset(seed=0)
    bump = LEFT
    truncated = [env.step(bump)[3] for _ in range(limit)]
    assert truncated == [False] * (limit - 1) + [True]


@pytest.mark.parametrize("limit", [3, 10**6])
def test_an_explicit_limit_wins(limit: int) -> None:
    env = gym.make("RandomWarehouse-v0", max_episode_steps=limit)
    assert env.spec is not None
    assert env.spec.max_episode_steps == limit
    assert str(env).count("TimeLimit") == 1


def test_a_random_warehouse_can_do_without_a_limit() -> None:
    assert "TimeLimit" not in str(gym.make("RandomWarehouse-v0", max_episode_steps=-1))


def test_a_random_warehouse_remade_from_its_spec_is_the_same() -> None:
    env = gym.make("RandomWarehouse-v0", size=20, map_seed=4, slip=0.1)
    assert env.spec is not None
    again = gym.make(env.spec)
    assert again.spec is not None
    assert str(again) == str(env)
    assert again.spec.max_episode_steps == env.spec.max_episode_steps
    assert np.array_equal(again.unwrapped.desc, env.unwrapped.desc)  # type: ignore[attr-defined]


def test_a_million_cells_stay_small_and_fast() -> None:
    """Making, resetting and 1000 steps took 54 MB beyond the imports and 0.9 s when measured."""
    code = """
import resource, sys, time
import gymnasium as gym, envs.warehouse, envs.warehouse
peak = lambda: resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
before, began = peak(), time.monotonic()
env = gym.make("RandomWarehouse-v0", size=1000)
env.reset(seed=0)
for step in range(1000):
    env.step(step % 4)
print((peak() - before) * (1 if sys.platform == "darwin" else 1024), time.monotonic() - began)
"""
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    n_bytes, seconds = map(float, done.stdout.split())
    assert n_bytes < 80e6
    assert seconds < 20


def test_resetting_a_million_cells_at_random_touches_few_of_them() -> None:
    env = RandomWarehouseEnv(size=1000, random_start=True)
    env.reset(seed=0)
    tracemalloc.start()
    for _ in range(100):
        env.reset()
    peak = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    assert peak < 100e3
