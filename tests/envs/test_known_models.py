"""What is known exactly about an environment: its model must be the environment, step for step."""

import copy
from typing import Any

import gymnasium as gym
import numpy as np
import pytest
from gymnasium.wrappers import (
    ClipReward,
    RecordEpisodeStatistics,
    TimeAwareObservation,
    TimeLimit,
    TransformReward,
)
from stable_baselines3.common.monitor import Monitor

import envs  # noqa: F401 (registers the environments)
from envs.known_models import (
    model_check,
    observations_of_states,
    success_outcomes,
    time_limit,
    transition_model,
)
from envs.wrappers import (
    DiscretizeObservation,
    FlattenToDiscrete,
    OneHotObservation,
    ScaleReward,
    TerminationReward,
)

ENVIRONMENTS: list[tuple[str, dict[str, Any]]] = [
    ("Warehouse-v0", {}),
    ("Warehouse-v0", {"slip": 0.3, "random_start": True, "shelf_reward": -1}),
    ("RandomWarehouse-v0", {"size": 7, "map_seed": 3, "slip": 0.2}),
    ("MineMaze-v0", {}),
    ("MineMaze-v0", {"slip": 0.4, "random_start": True}),
    ("FrozenLake-v1", {}),
    ("FrozenLake-v1", {"is_slippery": False}),
    ("FrozenLake-v1", {"map_name": "8x8", "success_rate": 0.6, "reward_schedule": (3, -2, -0.1)}),
    ("FrozenLake-v1", {"desc": ["SFS", "HFG"]}),
    ("CliffWalking-v1", {}),
    ("CliffWalking-v1", {"is_slippery": True}),
    ("Taxi-v4", {}),
    ("Taxi-v4", {"is_rainy": True, "rainy_probability": 0.7}),
    ("DynaMaze-v0", {"maze": "shortcut", "changed": True}),
    ("RandomWalk-v0", {"n_states": 1000, "max_jump": 100, "left_reward": -1}),
    ("WindyGridworld-v0", {"moves": "king", "stochastic": True}),
    ("GamblersProblem-v0", {"heads_probability": 0.55, "goal": 20}),
    ("RiverSwim-v0", {}),
    ("ShortCorridor-v0", {}),
    ("DeepSea-v0", {"size": 4}),
    ("Racetrack-v0", {}),
]
EACH_ENVIRONMENT = pytest.mark.parametrize(("env_id", "kwargs"), ENVIRONMENTS)


def next_uniform(base: Any) -> float:
    """The uniform number that the environment is about to draw."""
    return float(copy.deepcopy(base.np_random).random())


def first_above(probabilities: Any, uniform: float) -> int:
    return int(np.argmax(np.cumsum(probabilities) > uniform))


def assert_replays(env: gym.Env[Any, Any], steps: int = 1500) -> None:
    """Predict every start and step from the model and the environment's next random number."""
    model, base = transition_model(env), env.unwrapped
    observations = observations_of_states(env)
    assert model is not None
    assert observations is not None
    rng = np.random.default_rng(5)
    env.reset(seed=3)
    over = True
    for _ in range(steps):
        if over:
            start = first_above(model.initial, next_uniform(base))
            obs, _ = env.reset()
            assert base.s == start  # type: ignore[attr-defined]
            np.testing.assert_array_equal(obs, observations[start])
        state = base.s  # type: ignore[attr-defined]
        action = int(rng.integers(model.n_actions))
        outcome = (state, action, first_above(model.prob[state, action], next_uniform(base)))
        obs, reward, terminated, truncated, _ = env.step(action)
        assert base.s == model.next_state[outcome]  # type: ignore[attr-defined]
        assert reward == model.reward[outcome]
        assert terminated == model.terminated[outcome]
        np.testing.assert_array_equal(obs, observations[base.s])  # type: ignore[attr-defined]
        assert env.observation_space.contains(obs)
        over = terminated or truncated


@EACH_ENVIRONMENT
def test_the_model_replays_the_environment(env_id: str, kwargs: dict[str, Any]) -> None:
    assert_replays(gym.make(env_id, **kwargs))


@EACH_ENVIRONMENT
def test_rewards_are_folded_in(env_id: str, kwargs: dict[str, Any]) -> None:
    env: Any = gym.make(env_id, **kwargs)
    env = TerminationReward(ScaleReward(Monitor(env), 0.01), reward=-0.7)
    assert_replays(
        ScaleReward(RecordEpisodeStatistics(env, stats_key="statistics"), -3.0), steps=400
    )


@pytest.mark.parametrize("bounds", [(-0.5, 0.3), (None, -0.2), (0.1, None)])
@EACH_ENVIRONMENT
def test_so_are_bounds_of_rewards(env_id: str, kwargs: dict[str, Any], bounds: Any) -> None:
    env = ClipReward(ScaleReward(gym.make(env_id, **kwargs), 0.1), *bounds)
    assert_replays(ScaleReward(env, 0.7), steps=200)


@pytest.mark.parametrize("observation", ["discrete", "position", "one_hot"])
def test_observations_of_the_warehouse(observation: str) -> None:
    assert_replays(gym.make("Warehouse-v0", observation=observation, slip=0.1))


def test_observation_wrappers() -> None:
    env = gym.make("FrozenLake-v1")
    assert_replays(OneHotObservation(env), steps=200)
    assert_replays(OneHotObservation(FlattenToDiscrete(env)), steps=200)
    position = gym.make("Warehouse-v0", observation="position")
    assert_replays(DiscretizeObservation(position, bins=4), steps=200)
    one_hot = observations_of_states(OneHotObservation(env))
    assert one_hot is not None
    np.testing.assert_array_equal(one_hot, np.eye(16))


def test_what_wrappers_make_of_drawn_rewards() -> None:
    env: Any = gym.make("MaximizationBias-v0", reward_std=2)
    scaled = transition_model(ScaleReward(env, 3))
    assert scaled is not None
    assert scaled.reward_variance is not None
    assert scaled.reward_variance[1, 0, 0] == 36
    replaced = transition_model(TerminationReward(env, -5))
    assert replaced is not None
    assert replaced.reward_variance is not None
    assert not replaced.reward_variance.any()
    assert transition_model(ClipReward(env, -1, 1)) is None


class Anything(gym.Wrapper[Any, Any, Any, Any]):
    """A wrapper of somebody else's."""


def clip_otherwise(env: gym.Env[Any, Any]) -> gym.Env[Any, Any]:
    clipping: Any = ClipReward(env, -1, 1)
    clipping.func = lambda reward: 2 * reward
    return clipping


class OurOwnTimeLimit(TimeLimit):
    """Not the one that is known."""


@pytest.mark.parametrize(
    "wrap",
    [
        Anything,
        lambda env: OurOwnTimeLimit(env, 10),
        lambda env: TransformReward(env, lambda reward: reward),
        lambda env: TerminationReward(env, -10, on_truncation=True),
        lambda env: ClipReward(env, np.array([-1.0, 0.0])),
        clip_otherwise,
        lambda env: Monitor(Anything(env)),
    ],
    ids=["unknown", "subclass", "function", "on_truncation", "bounds", "otherwise", "inside"],
)
@pytest.mark.parametrize("env_id", ["FrozenLake-v1", "Warehouse-v0"])
def test_unknown_wrappers_hide_the_model(env_id: str, wrap: Any) -> None:
    env = wrap(gym.make(env_id))
    assert transition_model(env) is None
    assert success_outcomes(env) is None
    # Only what is observed through them stays unknown as well.
    assert observations_of_states(TimeAwareObservation(gym.make(env_id))) is None


@pytest.mark.parametrize(
    ("env_id", "kwargs"),
    [("CartPole-v1", {}), ("Taxi-v4", {"fickle_passenger": True})],
)
def test_environments_without_a_model(env_id: str, kwargs: dict[str, Any]) -> None:
    env = gym.make(env_id, **kwargs)
    assert transition_model(env) is None
    assert success_outcomes(env) is None
    assert observations_of_states(env) is None


def test_a_broken_model_is_not_used() -> None:
    env: Any = gym.make("FrozenLake-v1")
    env.unwrapped.P[3][1] = [(0.5, 0, 0.0, False)]
    assert transition_model(env) is None
    check = model_check(env)
    assert check is not None
    assert check.refusal == (
        "the environment's P is no model: "
        "state 3, action 1 has probabilities that do not sum to one"
    )


@pytest.mark.parametrize(
    ("env_id", "limit"),
    [
        ("Warehouse-v0", 1000),
        ("MineMaze-v0", 100),
        ("FrozenLake-v1", 100),
        ("CliffWalking-v1", None),
    ],
)
def test_time_limits(env_id: str, limit: int | None) -> None:
    env = gym.make(env_id)
    assert time_limit(env) == limit
    assert time_limit(Monitor(TimeLimit(env, 5000))) == (limit or 5000)
    assert time_limit(TimeLimit(ScaleReward(env, 0.5), 7)) == 7


def successes(env: gym.Env[Any, Any]) -> list[tuple[int, int]]:
    """(state, action) of the transitions that count as success."""
    mask = success_outcomes(env)
    assert mask is not None
    return [(int(s), int(a)) for s, a, _ in np.argwhere(mask)]


def test_success_in_frozen_lake() -> None:
    # The goal, 15, is reached from 14 by moving right or slipping there; 11 is a hole.
    assert successes(gym.make("FrozenLake-v1")) == [(14, 1), (14, 2), (14, 3)]
    assert successes(gym.make("FrozenLake-v1", is_slippery=False)) == [(14, 2)]


def test_success_in_cliff_walking() -> None:
    assert successes(gym.make("CliffWalking-v1")) == [(35, 2)]


def test_success_in_taxi() -> None:
    # Dropping the passenger, who sits in the taxi (4), where he wants to go.
    corners = [0, 4, 20, 23]
    expected = [(20 * corner + 16 + i, 5) for i, corner in enumerate(corners)]
    assert successes(gym.make("Taxi-v4")) == sorted(expected)


@pytest.mark.parametrize("mine_reward", [-100, 500])
def test_success_in_grid_worlds_is_the_goal(mine_reward: float) -> None:
    env = gym.make("MineMaze-v0", desc=["S.M", "..G"], mine_reward=mine_reward)
    assert successes(env) == [(4, 3)]


def test_success_does_not_depend_on_wrapped_rewards() -> None:
    env = gym.make("FrozenLake-v1", is_slippery=False)
    assert successes(TerminationReward(ScaleReward(env, -1), 0)) == [(14, 2)]
