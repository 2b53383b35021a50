"""What holds for every registered environment, whatever its arguments."""

import copy
import pickle
import subprocess
import sys
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np
import pytest
import stable_baselines3.common.env_checker as sb3_checker
from gymnasium.envs.registration import EnvSpec
from gymnasium.envs.toy_text.utils import categorical_sample
from gymnasium.utils import env_checker
from gymnasium.utils.seeding import np_random

import envs  # noqa: F401
from envs import TEXTBOOK as TEXTBOOK_IDS
from envs.finite_env import FiniteEnv
from envs.grid import GridWorld
from mdp.transition_model import TransitionModel

GRID_WORLDS: list[tuple[str, dict[str, Any]]] = [
    ("Warehouse-v0", {}),
    ("Warehouse-v0", {"slip": 0.3, "random_start": True}),
    ("Warehouse-v0", {"slip": 1, "shelf_reward": -1, "observation": "position"}),
    ("Warehouse-v0", {"random_start": True, "observation": "one_hot"}),
    ("Warehouse-v0", {"desc": ["S.G"], "observation": "position"}),
    ("MineMaze-v0", {}),
    ("MineMaze-v0", {"slip": 0.2, "random_start": True, "power_reward": 0}),
    ("RandomWarehouse-v0", {}),
    ("RandomWarehouse-v0", {"size": 15, "map_seed": 3, "slip": 0.1, "random_start": True}),
]
LOG = str(Path(__file__).parent / "uniform_log.csv")
BANDITS: list[tuple[str, dict[str, Any]]] = [
    ("BernoulliBandit-v0", {}),
    ("BernoulliBandit-v0", {"probabilities": [0, 1], "pulls": 20}),
    ("GaussianBandit-v0", {}),
    ("GaussianBandit-v0", {"means": [0.0] * 10, "drift_std": 0.01}),
    ("GaussianBandit-v0", {"n_arms": 3, "mean_loc": 4, "reward_std": 0, "pulls": 50}),
    ("LinearBandit-v0", {}),
    ("LinearBandit-v0", {"arm_parameters": [[1.0, 0.0], [0.0, 1.0]], "pulls": 30}),
    ("SegmentBandit-v0", {}),
    ("SegmentBandit-v0", {"batch_size": 7, "pulls": 25}),
    ("ReplayBandit-v0", {"log": LOG}),
]
TEXTBOOK: list[tuple[str, dict[str, Any]]] = [
    ("WindyGridworld-v0", {"moves": "king_and_stay", "stochastic": True}),
    ("DynaMaze-v0", {"maze": "shortcut", "changed": True, "change_after_steps": 50}),
    ("DeepSea-v0", {"deterministic": False}),
]
# An environment that has no variants here yet is held to its contract as it is.
for spec in list(gym.registry.values()):
    is_new = spec.id not in {env_id for env_id, _ in GRID_WORLDS + BANDITS}
    if is_new and str(spec.entry_point).startswith("envs."):
        kind = GRID_WORLDS if isinstance(gym.make(spec.id).unwrapped, GridWorld) else BANDITS
        kind.append((spec.id, {}))
VARIANTS = GRID_WORLDS + BANDITS + TEXTBOOK
FINITE = [env_id for env_id in TEXTBOOK_IDS if env_id not in {"DynaMaze-v0", "Racetrack-v0"}]
# The first variant of each id.
SIMPLEST = dict(reversed(VARIANTS))
HEADINGS = [
    "Description",
    "Action Space",
    "Observation Space",
    "Rewards",
    "Starting State",
    "Episode End",
    "Information",
    "Arguments",
    "Version History",
]

every_variant = pytest.mark.parametrize(("env_id", "kwargs"), VARIANTS)
every_grid_world = pytest.mark.parametrize(("env_id", "kwargs"), GRID_WORLDS)
every_id = pytest.mark.parametrize(("env_id", "kwargs"), sorted(SIMPLEST.items()))


def grid_world(env_id: str, kwargs: dict[str, Any]) -> GridWorld:
    env = gym.make(env_id, **kwargs).unwrapped
    assert isinstance(env, GridWorld)
    return env


def play(env: gym.Env[Any, Any], n_steps: int, seed: int) -> list[Any]:
    """What `reset` and `step` return while random actions are taken."""
    n_actions = int(getattr(env.action_space, "n", 0))
    actions = np.random.default_rng(seed).integers(n_actions, size=n_steps)
    history: list[Any] = []
    for action in actions:
        history.append(env.step(int(action)))
        if history[-1][2] or history[-1][3]:
            history.append(env.reset())
    return history


def equal(left: list[Any], right: list[Any]) -> bool:
    return env_checker.data_equivalence(tuple(left), tuple(right), exact=True)


def test_the_variants_cover_every_registered_id() -> None:
    specs = gym.registry.values()
    registered = {spec.id for spec in specs if str(spec.entry_point).startswith("envs.")}
    assert registered == {env_id for env_id, _ in VARIANTS}


@every_id
def test_the_docstring_has_the_headings_of_toy_text(env_id: str, kwargs: dict[str, Any]) -> None:
    documentation = type(gym.make(env_id, **kwargs).unwrapped).__doc__ or ""
    lines = [line.strip() for line in documentation.splitlines()]
    assert [line[3:] for line in lines if line.startswith("## ")] == HEADINGS


@every_variant
def test_gymnasiums_checker_finds_nothing(env_id: str, kwargs: dict[str, Any]) -> None:
    env_checker.check_env(gym.make(env_id, **kwargs).unwrapped)


@every_variant
def test_stable_baselines3s_checker_finds_nothing(env_id: str, kwargs: dict[str, Any]) -> None:
    env = gym.make(env_id, render_mode="rgb_array", **kwargs)
    sb3_checker.check_env(env.unwrapped, warn=True, skip_render_check=False)
    sb3_checker.check_env(env, warn=True, skip_render_check=False)


@every_variant
def test_the_same_seed_gives_the_same_episodes(env_id: str, kwargs: dict[str, Any]) -> None:
    one, other = gym.make(env_id, **kwargs), gym.make(env_id, **kwargs)
    assert equal([one.reset(seed=5)], [other.reset(seed=5)])
    assert equal(play(one, 300, seed=1), play(other, 300, seed=1))


@every_variant
def test_a_copy_made_in_mid_episode_goes_on_alike(env_id: str, kwargs: dict[str, Any]) -> None:
    env = gym.make(env_id, render_mode="rgb_array", **kwargs)
    env.reset(seed=5)
    play(env, 37, seed=2)
    env.render()
    copies = [pickle.loads(pickle.dumps(env)), copy.deepcopy(env)]
    expected = play(env, 100, seed=3)
    for other in copies:
        assert equal(play(other, 100, seed=3), expected)
        assert np.array_equal(np.asarray(other.render()), np.asarray(env.render()))


@every_variant
def test_the_spec_makes_the_same_environment_again(env_id: str, kwargs: dict[str, Any]) -> None:
    env = gym.make(env_id, max_episode_steps=40, **kwargs)
    assert env.spec is not None
    again = gym.make(EnvSpec.from_json(env.spec.to_json()))
    assert again.spec is not None
    assert again.spec.max_episode_steps == 40
    env.reset(seed=5)
    again.reset(seed=5)
    assert equal(play(env, 200, seed=4), play(again, 200, seed=4))


@every_grid_world
def test_simulating_the_model_with_the_same_generator_replays_every_step(
    env_id: str, kwargs: dict[str, Any]
) -> None:
    env = grid_world(env_id, kwargs)
    rng, _ = np_random(7)
    actions = np.random.default_rng(8).integers(4, size=2000)
    n_columns, n_cells = env.map.n_columns, env.map.n_cells

    observation, info = env.reset(seed=7)
    state = int(categorical_sample(env.initial_state_distrib, rng))
    for action in actions:
        assert np.array_equal(observation, env.observation_of(np.array([state]))[0])
        assert (env.s, info["position"]) == (state, divmod(state % n_cells, n_columns))
        outcomes = env.P[state][int(action)]
        chosen = categorical_sample([outcome[0] for outcome in outcomes], rng)
        _, state, expected_reward, ends = outcomes[chosen]
        observation, reward, terminated, truncated, info = env.step(int(action))
        assert (reward, terminated, truncated) == (expected_reward, ends, False)
        if terminated:
            assert env.s == state
            observation, info = env.reset()
            state = int(categorical_sample(env.initial_state_distrib, rng))
    assert env.np_random.random() == rng.random()


class Fixed:
    """A generator whose next uniform number is known."""

    def __init__(self, uniform: float) -> None:
        self.uniform = uniform

    def random(self) -> float:
        return self.uniform


@every_grid_world
def test_uniform_numbers_on_the_edge_choose_as_toy_text_does(
    env_id: str, kwargs: dict[str, Any]
) -> None:
    env = grid_world(env_id, kwargs)
    starts = np.cumsum(env.initial_state_distrib)
    outcomes = np.cumsum(env.dynamics.outcome_prob)
    edges = np.concatenate([[0.0], starts, outcomes])
    uniforms = np.concatenate([edges, np.nextafter(edges, 0), np.nextafter(edges, 1)])
    for uniform in np.unique(uniforms[uniforms < 1]).tolist():
        env._np_random = Fixed(uniform)  # type: ignore[assignment]
        env.reset()
        start = categorical_sample(env.initial_state_distrib, env.np_random)
        assert env.s == start
        listed = env.P[int(start)][0]
        chosen = categorical_sample([outcome[0] for outcome in listed], env.np_random)
        env.step(0)
        assert env.s == listed[chosen][1]


@every_grid_world
def test_p_and_the_arrays_say_the_same(env_id: str, kwargs: dict[str, Any]) -> None:
    env = grid_world(env_id, kwargs)
    arrays = env.transition_model()
    from_dictionaries = TransitionModel.from_gymnasium(env.P, env.initial_state_distrib)
    for name in ("prob", "next_state", "reward", "terminated", "initial"):
        assert np.array_equal(getattr(arrays, name), getattr(from_dictionaries, name))
    assert type(env.P[0][0][0][0]) is float
    assert type(env.P[0][0][0][1]) is int
    assert type(env.P[0][0][0][3]) is bool
    assert arrays.n_outcomes == (3 if len(env.dynamics.outcome_prob) > 1 else 1)


@pytest.mark.parametrize("env_id", FINITE)
def test_p_of_a_finite_environment_is_its_model(env_id: str) -> None:
    env = gym.make(env_id).unwrapped
    assert isinstance(env, FiniteEnv)
    model = env.transition_model()
    assert len(env.P) == model.n_states
    for state in range(0, model.n_states, 1 + model.n_states // 20):
        listed = (list(zip(*outcomes, strict=True)) for outcomes in env.P[state].values())
        for action, (prob, next_state, reward, terminated) in enumerate(listed):
            assert np.array_equal(prob, model.prob[state, action])
            assert np.array_equal(next_state, model.next_state[state, action])
            assert np.array_equal(reward, model.reward[state, action])
            assert np.array_equal(terminated, model.terminated[state, action])
    assert np.array_equal(env.initial_state_distrib, model.initial)
    kinds = [type(value) for value in env.P[0][0][0]]
    assert kinds == [float, int, float, bool]


@pytest.mark.parametrize("env_id", FINITE)
def test_a_finite_environment_refuses_actions_that_do_not_exist(env_id: str) -> None:
    env = gym.make(env_id).unwrapped
    env.reset(seed=0)
    n = env.action_space.n  # type: ignore[attr-defined]
    for action in (-1, n):
        with pytest.raises(ValueError, match=f"action {action} does not exist"):
            env.step(action)


@every_grid_world
def test_every_move_of_every_state_is_in_the_model(env_id: str, kwargs: dict[str, Any]) -> None:
    env = grid_world(env_id, {**kwargs, "slip": 0})
    model = env.transition_model()
    for state in range(model.n_states):
        for action in range(4):
            env.s = state
            _, reward, terminated, _, _ = env.step(action)
            listed = (model.next_state, model.reward, model.terminated)
            assert (env.s, reward, terminated) == tuple(a[state, action, 0] for a in listed)


@every_grid_world
def test_starts_are_drawn_by_the_stated_probabilities(env_id: str, kwargs: dict[str, Any]) -> None:
    env = grid_world(env_id, kwargs)
    possible = np.flatnonzero(env.initial_state_distrib)
    assert np.cumsum(env.initial_state_distrib)[-1] == 1.0
    assert np.allclose(env.initial_state_distrib[possible], 1 / len(possible), rtol=1e-12)
    assert (len(possible) > 1) == bool(kwargs.get("random_start"))
    assert np.all(env.map.distances[possible] > 0)
    env.reset(seed=0)
    drawn = set()
    for _ in range(30 * len(possible)):
        env.reset()
        drawn.add(env.s)
    assert drawn == set(possible.tolist())


@every_grid_world
def test_one_uniform_number_is_drawn_each_time(env_id: str, kwargs: dict[str, Any]) -> None:
    env = grid_world(env_id, kwargs)
    rng, _ = np_random(11)
    env.reset(seed=11)
    env.step(0)
    env.step(1)
    rng.random(3)
    assert env.np_random.random() == rng.random()


@every_variant
def test_every_render_mode_renders_and_closes_twice(env_id: str, kwargs: dict[str, Any]) -> None:
    for mode, result in (("ansi", str), ("rgb_array", np.ndarray), ("human", type(None))):
        env = gym.make(env_id, render_mode=mode, **kwargs)
        env.reset(seed=0)
        env.step(0)
        assert isinstance(env.render(), result)
        env.close()
        env.close()


@every_grid_world
def test_information_is_complete_and_fresh(env_id: str, kwargs: dict[str, Any]) -> None:
    env = gym.make(env_id, **kwargs)
    _, first = env.reset(seed=0)
    second = env.step(0)[4]
    assert first is not second
    for info in (first, second):
        assert set(info) == {"position", "bumped", "is_success"}
        assert [type(index) for index in info["position"]] == [int, int]
        assert (type(info["bumped"]), type(info["is_success"])) == (bool, bool)
    assert (first["bumped"], first["is_success"]) == (False, False)


@pytest.mark.parametrize("env_id", [env_id for env_id, kwargs in GRID_WORLDS if not kwargs])
@pytest.mark.parametrize("action", [-1, 4])
def test_an_action_that_does_not_exist_is_refused(env_id: str, action: int) -> None:
    env = gym.make(env_id).unwrapped
    env.reset(seed=0)
    with pytest.raises(ValueError, match=f"action {action} does not exist: 0 up, 1 down"):
        env.step(action)


def test_actions_may_be_arrays_without_axes() -> None:
    env = gym.make("Warehouse-v0")
    env.reset(seed=0)
    observation = env.step(np.array(3))[0]
    assert observation == 91
    assert type(observation) is int


def test_rendering_without_a_mode_warns() -> None:
    env = gym.make("Warehouse-v0").unwrapped
    env.reset(seed=0)
    with pytest.warns(UserWarning, match="made without render_mode"):
        assert env.render() is None


@pytest.mark.parametrize("env_id", [env_id for env_id, kwargs in GRID_WORLDS if not kwargs])
@pytest.mark.parametrize(
    ("wrong", "message"),
    [
        ({"slip": -0.1}, "slip must be a finite number from 0 to 1, not -0.1"),
        ({"slip": 1.5}, "slip must be a finite number from 0 to 1, not 1.5"),
        ({"slip": float("nan")}, "slip must be a finite number from 0 to 1, not nan"),
        ({"slip": "0.1"}, "slip must be a finite number from 0 to 1, not '0.1'"),
        ({"slip": True}, "slip must be a finite number from 0 to 1, not True"),
        ({"step_reward": float("inf")}, "step_reward must be a finite number, not inf"),
        ({"goal_reward": None}, "goal_reward must be a finite number, not None"),
        ({"random_start": 1}, "random_start must be true or false, not 1"),
    ],
)
def test_arguments_out_of_range_are_refused(
    env_id: str, wrong: dict[str, Any], message: str
) -> None:
    with pytest.raises(ValueError, match=message):
        gym.make(env_id, **wrong)


def test_an_unknown_render_mode_is_refused() -> None:
    from envs.warehouse import WarehouseEnv

    with pytest.raises(ValueError, match="render_mode 'ansy': did you mean 'ansi'"):
        WarehouseEnv(render_mode="ansy")


@every_id
def test_an_id_with_the_package_in_front_registers_it(env_id: str, kwargs: dict[str, Any]) -> None:
    made = f"gymnasium.make('envs:{env_id}', **{kwargs!r})"
    code = f"import gymnasium; print({made}.unwrapped.spec.id)"
    done = subprocess.run(
        [sys.executable, "-W", "error", "-c", code], capture_output=True, text=True, check=False
    )
    assert (done.stdout.strip(), done.stderr) == (env_id, "")
