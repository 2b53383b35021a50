"""The wrappers, worked by hand and against their own batched versions."""

import pickle
from typing import Any

import gymnasium as gym
import numpy as np
import pytest
from gymnasium import spaces
from gymnasium.wrappers import TimeLimit
from hypothesis import given
from hypothesis import strategies as st
from numpy.typing import NDArray
from stable_baselines3.common.env_checker import check_env

import envs  # noqa: F401
from envs.warehouse import WarehouseEnv
from envs.wrappers import (
    DiscretizeObservation,
    FlattenToDiscrete,
    OneHotObservation,
    ScaleReward,
    TerminationReward,
)

AnyEnv = gym.Env[Any, Any]


class Showing(gym.Env[Any, Any]):
    """Shows what it is told to, for two steps of reward 1 and 2; the second one terminates."""

    def __init__(self, space: spaces.Space[Any], shown: Any) -> None:
        self.observation_space = space
        self.action_space = spaces.Discrete(2)
        self.shown = shown
        self.n_steps = 0

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[Any, dict[str, Any]]:
        super().reset(seed=seed)
        self.n_steps = 0
        return self.shown, {}

    def step(self, action: int) -> tuple[Any, float, bool, bool, dict[str, Any]]:
        self.n_steps += 1
        return self.shown, float(self.n_steps), self.n_steps == 2, False, {}


def box(low: list[float], high: list[float], shown: list[float] | None = None) -> Showing:
    space = spaces.Box(np.array(low, np.float32), np.array(high, np.float32))
    return Showing(space, np.array(low if shown is None else shown, np.float32))


def cart_pole(**kwargs: Any) -> DiscretizeObservation:
    bounds = {"low": [-0.41887903, -50], "high": [0.41887903, 50]}
    return DiscretizeObservation(
        gym.make("CartPole-v1"), **{"bins": 50, "dims": [2, 3], **bounds, **kwargs}
    )


@pytest.mark.parametrize(
    ("value", "index"),
    [(-9, 0), (-1, 0), (-0.51, 0), (-0.5, 1), (-0.01, 1), (0, 2), (0.5, 3), (1, 3), (9, 3)],
)
def test_bins_worked_by_hand(value: float, index: int) -> None:
    env = DiscretizeObservation(box([-1], [1], [value]), bins=4)
    assert env.observation_space == spaces.Discrete(4)
    assert env.reset()[0] == index
    assert type(env.reset()[0]) is int


def test_infinite_values_fall_into_the_outer_bins() -> None:
    env = DiscretizeObservation(box([-np.inf], [np.inf]), bins=4, low=0, high=1)
    assert env.observation(np.array([-np.inf])) == 0
    assert env.observation(np.array([np.inf])) == 3
    assert env.map_observations(np.array([[-np.inf], [np.inf]])).tolist() == [0, 3]


def test_the_last_dimension_counts_fastest() -> None:
    env = DiscretizeObservation(box([0, 0, 0], [1, 1, 1], [0.9, 0.1, 0.6]), bins=[2, 3, 4])
    assert env.observation_space == spaces.Discrete(24)
    assert env.reset()[0] == (1 * 3 + 0) * 4 + 2


def test_only_the_chosen_dimensions_count() -> None:
    env = DiscretizeObservation(
        box([0, -np.inf, 0], [1, np.inf, 1], [0.9, 7, 0.6]), bins=[2, 4], dims=[2, 0]
    )
    assert env.observation_space == spaces.Discrete(8)
    assert env.reset()[0] == 1 * 4 + 3


def test_cart_pole_in_fifty_bins() -> None:
    env = cart_pole()
    assert env.observation_space == spaces.Discrete(2500)
    middle = env.observation(np.array([0, 0, 0.001, 0.001], np.float32))
    assert middle == 25 * 50 + 25
    assert env.observation(np.array([9, 9, -0.001, 0.001], np.float32)) == 24 * 50 + 25
    check_env(env, warn=True)


@given(
    st.lists(
        st.lists(st.floats(-60, 60, width=32), min_size=4, max_size=4), min_size=1, max_size=20
    ),
    st.integers(1, 60),
)
def test_a_batch_is_discretised_as_its_members(rows: list[list[float]], bins: int) -> None:
    env = cart_pole(bins=bins)
    batch = np.array(rows, np.float32)
    assert env.map_observations(batch).tolist() == [env.observation(row) for row in batch]


@pytest.mark.parametrize(
    ("kwargs", "message"),
    [
        ({"low": None}, "dimension 3 of the observation has the bounds -inf and 50.0: give finite"),
        ({"low": [1, -50]}, "dimension 2: low 1.0 is not below high 0.418"),
        ({"bins": 0}, "bins must be whole numbers from 1 on, not 0"),
        ({"bins": 2.5}, r"bins must be whole numbers from 1 on, not 2\.5"),
        ({"bins": [2, 2, 2]}, r"bins must be one number, or one for each of the dimensions \[2, 3"),
        (
            {"low": "left"},
            "low must be one number, or one for each of the dimensions .* not 'left'",
        ),
        ({"dims": [4]}, "dims must be a whole number from 0 to 3, not 4"),
        ({"dims": [2, 2]}, r"dims must list dimensions, each once, not \[2, 2\]"),
        ({"dims": []}, r"dims must list dimensions, each once, not \[\]"),
        ({"dims": 2}, "dims must list dimensions, each once, not 2"),
    ],
)
def test_bins_that_make_no_sense_are_refused(kwargs: dict[str, Any], message: str) -> None:
    with pytest.raises(ValueError, match=message):
        cart_pole(**kwargs)


@pytest.mark.parametrize("space", [spaces.Discrete(3), spaces.Box(0, 1, (2, 2))])
def test_only_vectors_are_discretised(space: spaces.Space[Any]) -> None:
    with pytest.raises(ValueError, match="DiscretizeObservation needs a Box of one axis, not"):
        DiscretizeObservation(Showing(space, None), bins=2)


@pytest.mark.parametrize(
    ("space", "shown", "n", "index"),
    [
        (spaces.MultiDiscrete([2, 3, 4]), np.array([1, 0, 2]), 24, (1 * 3 + 0) * 4 + 2),
        (spaces.MultiDiscrete([2, 3], start=[5, -1]), np.array([6, 1]), 6, 1 * 3 + 2),
        (spaces.MultiDiscrete(np.array([[2, 3], [4, 5]])), np.array([[1, 2], [3, 4]]), 120, 119),
        (spaces.Tuple([spaces.Discrete(32), spaces.Discrete(11)]), (13, 10), 352, 153),
        (spaces.Tuple([spaces.Discrete(3, start=1), spaces.Discrete(2)]), (3, 0), 6, 4),
        (spaces.Discrete(5, start=-2), 2, 5, 4),
        (spaces.Discrete(5), np.int64(3), 5, 3),
    ],
)
def test_flattening_worked_by_hand(
    space: spaces.Space[Any], shown: Any, n: int, index: int
) -> None:
    env = FlattenToDiscrete(Showing(space, shown))
    assert env.observation_space == spaces.Discrete(n)
    observed = [env.reset()[0], env.step(0)[0]]
    assert observed == [index, index]
    assert type(observed[0]) is int
    assert env.map_observations([shown, shown]).tolist() == [index, index]


def test_every_value_gets_a_number_of_its_own() -> None:
    env = FlattenToDiscrete(Showing(spaces.MultiDiscrete([2, 3, 4], start=[1, 0, -3]), None))
    grid = np.stack(np.meshgrid([1, 2], [0, 1, 2], [-3, -2, -1, 0], indexing="ij"), axis=-1)
    assert env.map_observations(grid.reshape(-1, 3)).tolist() == list(range(24))


def test_blackjack_is_flattened() -> None:
    env = FlattenToDiscrete(gym.make("Blackjack-v1"))
    assert env.observation_space == spaces.Discrete(32 * 11 * 2)
    check_env(env, warn=True)


@pytest.mark.parametrize(
    ("space", "message"),
    [
        (spaces.Box(0, 1, (2,)), "FlattenToDiscrete needs MultiDiscrete, a Tuple of Discrete, or"),
        (spaces.Tuple([spaces.Discrete(2), spaces.Box(0, 1)]), "FlattenToDiscrete needs"),
        (spaces.Tuple([]), "FlattenToDiscrete needs"),
        (spaces.MultiDiscrete([2**31] * 3), "too many to be numbered"),
    ],
)
def test_what_cannot_be_flattened_is_refused(space: spaces.Space[Any], message: str) -> None:
    with pytest.raises(ValueError, match=message):
        FlattenToDiscrete(Showing(space, None))


def test_one_hot_worked_by_hand() -> None:
    env = OneHotObservation(Showing(spaces.Discrete(4, start=2), 3))
    assert env.observation_space == spaces.Box(0, 1, (4,), np.float32)
    first, _ = env.reset()
    assert first.dtype == np.float32
    assert first.tolist() == [0, 1, 0, 0]
    assert env.step(0)[0].tolist() == [0, 1, 0, 0]
    batch = env.map_observations(np.array([5, 2]))
    assert batch.dtype == np.float32
    assert batch.tolist() == [[0, 0, 0, 1], [1, 0, 0, 0]]


def test_one_hot_passes_the_checker_and_fits_discrete_alone() -> None:
    check_env(OneHotObservation(gym.make("MineMaze-v0")), warn=True)
    with pytest.raises(ValueError, match="OneHotObservation needs Discrete observations, not Box"):
        OneHotObservation(gym.make("CartPole-v1"))


def test_rewards_are_scaled() -> None:
    env = ScaleReward(Showing(spaces.Discrete(2), 0), scale=0.25)
    env.reset()
    assert [env.step(0)[1], env.step(0)[1]] == [0.25, 0.5]
    assert env.scale == 0.25


@pytest.mark.parametrize(("scale", "message"), [(0, "must not be 0"), ("x", "finite number")])
def test_a_scale_that_makes_no_sense_is_refused(scale: Any, message: str) -> None:
    with pytest.raises(ValueError, match=message):
        ScaleReward(Showing(spaces.Discrete(2), 0), scale=scale)


@pytest.mark.parametrize(
    ("limit", "on_truncation", "rewards"),
    [(9, False, [1, -10]), (9, True, [1, -10]), (1, False, [1]), (1, True, [-10])],
)
def test_the_last_reward_is_replaced(limit: int, on_truncation: bool, rewards: list[float]) -> None:
    inner = TimeLimit(Showing(spaces.Discrete(2), 0), limit)
    env = TerminationReward(inner, reward=-10, on_truncation=on_truncation)
    env.reset()
    assert [env.step(0)[1] for _ in rewards] == rewards


def test_a_last_reward_that_makes_no_sense_is_refused() -> None:
    env = Showing(spaces.Discrete(2), 0)
    with pytest.raises(ValueError, match="reward must be a finite number, not nan"):
        TerminationReward(env, reward=float("nan"))
    with pytest.raises(ValueError, match="on_truncation must be true or false, not 'yes'"):
        TerminationReward(env, reward=0, on_truncation="yes")  # type: ignore[arg-type]


def wrapped() -> list[AnyEnv]:
    return [
        cart_pole(),
        FlattenToDiscrete(gym.make("Blackjack-v1")),
        OneHotObservation(gym.make("Warehouse-v0", slip=0.2)),
        ScaleReward(gym.make("Warehouse-v0"), 0.01),
        TerminationReward(gym.make("CartPole-v1"), -10, on_truncation=True),
    ]


def rollout(env: AnyEnv) -> list[tuple[NDArray[Any], float]]:
    history = [(np.asarray(env.reset(seed=3)[0]), 0.0)]
    for action in np.random.default_rng(0).integers(2, size=100):
        observation, reward, terminated, truncated, _ = env.step(int(action))
        history.append((np.asarray(observation), float(reward)))
        if terminated or truncated:
            env.reset()
    return history


@pytest.mark.parametrize("env", wrapped(), ids=lambda env: type(env).__name__)
def test_wrapped_environments_are_remade_from_their_spec_and_pickled(env: AnyEnv) -> None:
    assert env.spec is not None
    expected = rollout(env)
    for other in (gym.make(env.spec), pickle.loads(pickle.dumps(env))):
        assert str(other) == str(env)
        for (observation, reward), (again, reward_again) in zip(
            expected, rollout(other), strict=True
        ):
            assert reward == reward_again
            assert np.array_equal(observation, again)


def test_states_are_mapped_through_observation_and_wrapper() -> None:
    env = OneHotObservation(WarehouseEnv(desc=["S.", ".G"]))
    states = np.arange(4)
    grid_world = env.unwrapped
    assert isinstance(grid_world, WarehouseEnv)
    assert env.map_observations(grid_world.observation_of(states)).tolist() == np.eye(4).tolist()
