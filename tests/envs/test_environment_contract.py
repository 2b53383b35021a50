"""What holds for every registered environment, whatever its arguments."""

import copy
import pickle
import subprocess
import sys
from pathlib import Path

import gymnasium as gym
import numpy as np
import pytest
import stable_baselines3.common.env_checker as sb3_checker
from gymnasium.envs.registration import EnvSpec
from gymnasium.envs.toy_text.utils import categorical_sample
from gymnasium.utils import env_checker
from gymnasium.utils.seeding import np_random

import envs  # noqa: F401 (registers the environments)
from envs.finite_env import FiniteEnv
from envs.grid import GridWorld
from mdp import TransitionModel

LOG = {"log": str(Path(__file__).parent / "uniform_log.csv")}
# An environment that is registered later is held to its contract as it is.
SPECS = [spec for spec in gym.registry.values() if str(spec.entry_point).startswith("envs.")]
IDS = [(spec.id, LOG if spec.id == "ReplayBandit-v0" else {}) for spec in SPECS]
VARIANTS = [
    *IDS,
    ("Warehouse-v0", {"slip": 0.3, "random_start": True}),
    ("Warehouse-v0", {"slip": 1, "shelf_reward": -1, "observation": "position"}),
    ("Warehouse-v0", {"random_start": True, "observation": "one_hot"}),
    ("Warehouse-v0", {"desc": ["S.G"], "observation": "position"}),
    ("MineMaze-v0", {"slip": 0.2, "random_start": True, "power_reward": 0}),
    ("RandomWarehouse-v0", {"size": 15, "map_seed": 3, "slip": 0.1, "random_start": True}),
    ("BernoulliBandit-v0", {"probabilities": [0, 1], "pulls": 20}),
    ("GaussianBandit-v0", {"means": [0.0] * 10, "drift_std": 0.01}),
    ("GaussianBandit-v0", {"n_arms": 3, "mean_loc": 4, "reward_std": 0, "pulls": 50}),
    ("LinearBandit-v0", {"arm_parameters": [[1.0, 0.0], [0.0, 1.0]], "pulls": 30}),
    ("SegmentBandit-v0", {"batch_size": 7, "pulls": 25}),
    ("WindyGridworld-v0", {"moves": "king_and_stay", "stochastic": True}),
    ("DynaMaze-v0", {"maze": "shortcut", "changed": True, "change_after_steps": 50}),
    ("DeepSea-v0", {"deterministic": False}),
]
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


def is_a(kind, env_id):
    return isinstance(gym.make(env_id, **dict(IDS)[env_id]).unwrapped, kind)


def named(variants):
    """A table of environments, each row named by its id and arguments."""
    names = [f"{name} {' '.join(kwargs)}".strip() for name, kwargs in variants]
    return pytest.mark.parametrize(("env_id", "kwargs"), variants, ids=names)


GRID_WORLDS = [variant for variant in VARIANTS if is_a(GridWorld, variant[0])]
FINITE = [variant for variant in VARIANTS if is_a(FiniteEnv, variant[0])]
every_id, every_variant = named(IDS), named(VARIANTS)


def play(env, n_steps, seed):
    """What `reset` and `step` return while random actions are taken."""
    actions = np.random.default_rng(seed).integers(env.action_space.n, size=n_steps)
    history = []
    for action in actions.tolist():
        history.append(env.step(action))
        if history[-1][2] or history[-1][3]:
            history.append(env.reset())
    return tuple(history)


def assert_equal(one, other):
    assert env_checker.data_equivalence(one, other, exact=True)


@every_id
def test_the_docstring_has_the_headings_of_toy_text(env_id, kwargs):
    lines = [
        line.strip() for line in type(gym.make(env_id, **kwargs).unwrapped).__doc__.split("\n")
    ]
    assert [line[3:] for line in lines if line.startswith("## ")] == HEADINGS


def test_an_id_with_the_package_in_front_registers_it():
    made = ", ".join(f"make('envs:{name}', **{kwargs!r})" for name, kwargs in IDS)
    code = f"from gymnasium import make; print(*(env.unwrapped.spec.id for env in ({made},)))"
    command = [sys.executable, "-W", "error", "-c", code]
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    assert (done.stdout.split(), done.stderr) == ([env_id for env_id, _ in IDS], "")


@every_variant
def test_the_checkers_of_gymnasium_and_stable_baselines3_find_nothing(env_id, kwargs):
    env_checker.check_env(gym.make(env_id, **kwargs).unwrapped, skip_render_check=True)
    env = gym.make(env_id, render_mode="rgb_array", **kwargs)
    sb3_checker.check_env(env.unwrapped, warn=True, skip_render_check=False)
    sb3_checker.check_env(env, warn=True)


@every_variant
def test_its_spec_and_a_seed_give_the_same_episodes_again(env_id, kwargs):
    env = gym.make(env_id, max_episode_steps=40, **kwargs)
    again = gym.make(EnvSpec.from_json(env.spec.to_json()))
    assert again.spec.max_episode_steps == 40
    assert_equal(env.reset(seed=5), again.reset(seed=5))
    assert_equal(play(env, 200, seed=4), play(again, 200, seed=4))


@every_variant
def test_a_copy_made_in_mid_episode_goes_on_alike(env_id, kwargs):
    env = gym.make(env_id, render_mode="rgb_array", **kwargs)
    env.reset(seed=5)
    play(env, 37, seed=2)
    env.render()
    copies = [pickle.loads(pickle.dumps(env)), copy.deepcopy(env)]
    expected = play(env, 100, seed=3)
    for other in copies:
        assert_equal(play(other, 100, seed=3), expected)
        np.testing.assert_array_equal(other.render(), env.render())


@every_id
def test_every_render_mode_renders_and_closes_twice(env_id, kwargs):
    for mode, result in (("ansi", str), ("rgb_array", np.ndarray), ("human", type(None))):
        env = gym.make(env_id, render_mode=mode, **kwargs)
        env.reset(seed=0)
        env.step(0)
        assert isinstance(env.render(), result)
        env.close()
        env.close()
    silent = gym.make(env_id, **kwargs).unwrapped
    silent.reset(seed=0)
    with pytest.warns(UserWarning, match="made without render_mode"):
        assert silent.render() is None


@every_id
@pytest.mark.parametrize("place", ["below", "above"])
def test_an_action_that_does_not_exist_is_refused(env_id, kwargs, place):
    env = gym.make(env_id, **kwargs).unwrapped
    env.reset(seed=0)
    action = -1 if place == "below" else env.action_space.n
    with pytest.raises(ValueError, match=rf"(action|arm) {action} does not exist: (0 up|they are)"):
        env.step(action)


@named(IDS[:1])
def test_actions_may_be_arrays_without_axes(env_id, kwargs):
    env = gym.make(env_id, **kwargs)
    env.reset(seed=0)
    observation = env.step(np.array(3))[0]
    assert (observation, type(observation)) == (91, int)


# Two are too large to be written as dictionaries in no time.
@named([row for row in GRID_WORLDS + FINITE if row[0] not in {"JacksCarRental-v0", "Racetrack-v0"}])
def test_p_is_the_model_as_dictionaries(env_id, kwargs):
    env = gym.make(env_id, **kwargs).unwrapped
    arrays = env.transition_model()
    again = TransitionModel.from_gymnasium(env.P, env.initial_state_distrib)
    for name in ("prob", "next_state", "reward", "terminated", "initial"):
        np.testing.assert_array_equal(getattr(arrays, name), getattr(again, name))
    assert [type(value) for value in env.P[0][0][0]] == [float, int, float, bool]


class Fixed:
    """A generator whose next uniform number is known."""

    def __init__(self, uniform):
        self.uniform = uniform

    def random(self):
        return self.uniform


@named([(name, kwargs) for name, kwargs in GRID_WORLDS if kwargs])
def test_uniform_numbers_on_the_edge_choose_as_toy_text_does(env_id, kwargs):
    env = gym.make(env_id, **kwargs).unwrapped
    listed = [prob for prob, *_ in env.P[0][0]]
    edges = np.concatenate([[0.0], np.cumsum(env.initial_state_distrib), np.cumsum(listed)])
    uniforms = np.concatenate([edges, np.nextafter(edges, 0), np.nextafter(edges, 1)])
    for uniform in np.unique(uniforms[uniforms < 1]).tolist():
        env.np_random = Fixed(uniform)
        env.reset()
        assert env.s == categorical_sample(env.initial_state_distrib, env.np_random)
        outcomes = env.P[int(env.s)][0]
        chosen = categorical_sample([outcome[0] for outcome in outcomes], env.np_random)
        env.step(0)
        assert env.s == outcomes[chosen][1]


@named(GRID_WORLDS)
def test_information_of_a_grid_world_is_complete_and_fresh(env_id, kwargs):
    env = gym.make(env_id, **kwargs)
    rng, _ = np_random(0)
    _, first = env.reset(seed=0)
    second = env.step(0)[4]
    assert first is not second
    assert (first["bumped"], first["is_success"]) == (False, False)
    for info in (first, second):
        assert {name: type(value) for name, value in info.items()} == {
            "position": tuple,
            "bumped": bool,
            "is_success": bool,
        }
        assert [type(index) for index in info["position"]] == [int, int]
    # One uniform number for the start and one for the step, also where nothing is random.
    rng.random(2)
    assert env.np_random.random() == rng.random()
