"""What holds for every registered environment, whatever its arguments."""

import copy
import pickle
import re
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
    ("Warehouse-v0", {"slip": 0.3, "random_start": True, "observation": "position"}),
    ("MineMaze-v0", {"slip": 0.2, "random_start": True, "power_reward": 0}),
    ("LinearBandit-v0", {"arm_parameters": [[1.0, 0.0], [0.0, 1.0]], "pulls": 30}),
    ("WindyGridworld-v0", {"moves": "king_and_stay", "stochastic": True}),
    ("DynaMaze-v0", {"maze": "shortcut", "changed": True, "change_after_steps": 50}),
    ("DeepSea-v0", {"deterministic": False}),
]


def is_a(kind, env_id):
    return isinstance(gym.make(env_id, **dict(IDS)[env_id]).unwrapped, kind)


def named(variants):
    """A table of environments, each row named by its id and arguments."""
    names = [f"{name} {' '.join(kwargs)}".strip() for name, kwargs in variants]
    return pytest.mark.parametrize(("env_id", "kwargs"), variants, ids=names)


GRID_WORLDS = [row for row in IDS if is_a(GridWorld, row[0])]
FINITE = [row for row in IDS if is_a(FiniteEnv, row[0])]
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


def test_an_id_with_the_package_in_front_registers_it():
    made = ", ".join(f"make('envs:{name}', **{kwargs!r})" for name, kwargs in IDS)
    code = f"from gymnasium import make; print(*(env.unwrapped.spec.id for env in ({made},)))"
    command = [sys.executable, "-W", "error", "-c", code]
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    assert (done.stdout.split(), done.stderr) == ([env_id for env_id, _ in IDS], "")


@every_id
def test_the_checkers_of_gymnasium_and_stable_baselines3_find_nothing(env_id, kwargs):
    env_checker.check_env(gym.make(env_id, **kwargs).unwrapped, skip_render_check=True)
    env = gym.make(env_id, render_mode="rgb_array", **kwargs)
    sb3_checker.check_env(env.unwrapped, warn=True, skip_render_check=False)
    sb3_checker.check_env(env, warn=True)


@every_variant
def test_its_spec_a_seed_and_copies_in_mid_episode_give_the_same_episodes(env_id, kwargs):
    env = gym.make(env_id, render_mode="rgb_array", max_episode_steps=40, **kwargs)
    again = gym.make(EnvSpec.from_json(env.spec.to_json()))
    assert again.spec.max_episode_steps == 40
    assert_equal(env.reset(seed=5), again.reset(seed=5))
    assert_equal(play(env, 77, seed=4), play(again, 77, seed=4))
    env.render()
    copies = [again, pickle.loads(pickle.dumps(env)), copy.deepcopy(env)]
    expected = play(env, 60, seed=3)
    infos = [returned[-1] for returned in expected]
    assert len({id(info) for info in infos}) == len(infos)
    kinds = {type(value) for info in infos for value in info.values()}
    assert kinds <= {bool, int, float, tuple}
    for other in copies:
        assert_equal(play(other, 60, seed=3), expected)
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
    with pytest.raises(ValueError, match="render_mode 'ansy': did you mean 'ansi'"):
        type(silent)(render_mode="ansy", **kwargs)


@every_id
def test_an_action_that_does_not_exist_is_refused(env_id, kwargs):
    env = gym.make(env_id, **kwargs).unwrapped
    env.reset(seed=0)
    for action in (-1, env.action_space.n):
        told = rf"(action|arm) {action} does not exist: (0 up|they are)"
        with pytest.raises(ValueError, match=told):
            env.step(action)
    assert isinstance(env.step(np.array(0))[0], int | np.ndarray)  # arrays without axes may be


# Two are too large to be written as dictionaries in no time.
@named([row for row in GRID_WORLDS + FINITE if row[0] not in {"JacksCarRental-v0", "Racetrack-v0"}])
def test_p_is_the_model_as_dictionaries(env_id, kwargs):
    env = gym.make(env_id, **kwargs).unwrapped
    arrays = env.transition_model()
    again = TransitionModel.from_gymnasium(env.P, env.initial_state_distrib)
    for name in ("prob", "next_state", "reward", "terminated", "initial"):
        np.testing.assert_array_equal(getattr(arrays, name), getattr(again, name))
    assert [type(value) for value in env.P[0][0][0]] == [float, int, float, bool]
    if type(env).observation_of is FiniteEnv.observation_of:
        assert env.observation_space.n == arrays.n_states


class Fixed:
    """A generator whose next uniform number is known."""

    def __init__(self, uniform):
        self.uniform = uniform

    def random(self):
        return self.uniform


# In floating point 0.7 + 0.2 + 0.1 stays below 1.
THREE = {"segment_probabilities": [0.7, 0.2, 0.1], "click_rates": [[0.1, 0.3], [0, 1], [0.7, 0.2]]}
SLIPPERY = {"slip": 0.3, "random_start": True}
ON_EDGES = [("Warehouse-v0", SLIPPERY), ("MineMaze-v0", SLIPPERY), ("SegmentBandit-v0", THREE)]


@named(ON_EDGES)
def test_uniform_numbers_on_the_edge_choose_as_toy_text_does(env_id, kwargs):
    env = gym.make(env_id, **kwargs).unwrapped
    model = env.transition_model()
    edges = [np.cumsum(model.initial), *np.cumsum(model.prob, axis=2)[:3, 0]]
    edges = np.concatenate([[0.0], *edges])
    uniforms = np.concatenate([edges, np.nextafter(edges, 0), np.nextafter(edges, 1)])
    for uniform in np.unique(uniforms[uniforms < 1]).tolist():
        env.np_random = Fixed(uniform)
        env.reset()
        assert env.s == categorical_sample(model.initial, env.np_random)
        for state in {int(env.s), *range(3)}:
            env.s = state
            chosen = categorical_sample(model.prob[state, 0], env.np_random)
            _, reward, *_ = env.step(0)
            assert env.s == model.next_state[state, 0, chosen]
            assert reward == model.reward[state, 0, chosen]


# --- arguments ------------------------------------------------------------------------------------

INF, NAN = float("inf"), float("nan")
MANY = {"segment_probabilities": [1 / 1024] * 1024, "click_rates": [[0.5, 0.5]] * 1024}
ONE = {"segment_probabilities": [1], "click_rates": [[0.5]]}
CHANGING = {"maze": "blocking", "changed": True}
REFUSED = [
    ("Warehouse", {"slip": -0.1}, "slip must be a finite number from 0 to 1, not -0.1"),
    ("Warehouse", {"slip": NAN}, "slip must be a finite number from 0 to 1, not nan"),
    ("Warehouse", {"slip": True}, "slip must be a finite number from 0 to 1, not True"),
    ("Warehouse", {"shelf_reward": "a"}, "shelf_reward must be a finite number, not 'a'"),
    ("Warehouse", {"observation": "positon"}, "'positon': did you mean 'position'? It must be one"),
    ("MineMaze", {"step_reward": INF}, "step_reward must be a finite number, not inf"),
    ("MineMaze", {"random_start": 1}, "random_start must be true or false, not 1"),
    ("RandomWarehouse", {"size": 1}, "size must be a whole number from 2 to 4096, not 1"),
    ("RandomWarehouse", {"shelf_density": 1.1}, "shelf_density must be a finite number from 0 to"),
    ("RandomWarehouse", {"map_seed": -1}, "map_seed must be a whole number from 0 to 9223372036"),
    ("DynaMaze", {"maze": "block"}, "unknown maze 'block': did you mean 'blocking'"),
    ("DynaMaze", {"changed": True}, "changed: the maze 'dyna' never changes"),
    ("DynaMaze", {"maze": "blocking", "change_after_steps": 5}, "change_after_steps needs changed"),
    ("DynaMaze", {**CHANGING, "change_after_steps": 0}, "change_after_steps must be a whole num"),
    ("RandomWalk", {"n_states": 0}, "n_states must be a whole number from 1 to 10000"),
    ("RandomWalk", {"n_states": 9999, "max_jump": 9999}, "is too much: twice their product"),
    ("WindyGridworld", {"moves": "queen"}, "unknown moves 'queen'"),
    ("WindyGridworld", {"stochastic": 1}, "stochastic must be true or false"),
    ("GamblersProblem", {"heads_probability": 2}, "heads_probability must be a finite"),
    ("GamblersProblem", {"start_capital": 100}, "start_capital must be a whole number"),
    ("MaximizationBias", {"n_actions": 1}, "n_actions must be a whole number from 2"),
    ("MaximizationBias", {"reward_std": -1}, "reward_std must be a finite number"),
    ("RiverSwim", {"n_states": 1}, "n_states must be a whole number from 2"),
    ("DeepSea", {"size": 1}, "size must be a whole number from 2"),
    ("Racetrack", {"track": "middle"}, "unknown track 'middle'"),
    ("JacksCarRental", {"variant": "exam"}, "unknown variant 'exam': did you mean 'exam"),
    ("JacksCarRental", {"first_cars": 21}, "first_cars must be a whole number from 0 to 20"),
    ("BernoulliBandit", {"probabilities": [0.5]}, "must hold 2 numbers or more, not 1"),
    ("BernoulliBandit", {"probabilities": 0.5}, "must be a list of numbers, not 0.5"),
    ("BernoulliBandit", {"probabilities": [0.5, 1.5]}, "[1] must be a finite number from"),
    ("BernoulliBandit", {"pulls": 0}, "pulls must be a whole number from 1 to 1000000000, not 0"),
    ("GaussianBandit", {"means": [1, 2], "n_arms": 3}, "n_arms is 3, but 2 are given: leave it"),
    ("GaussianBandit", {"means": [1, 2], "mean_loc": 4}, "mean_loc is for means that are drawn"),
    ("GaussianBandit", {"means": [1, None]}, "means[1] must be a finite number, not None"),
    ("GaussianBandit", {"reward_std": -1}, "reward_std must be a finite number"),
    ("LinearBandit", {"arm_parameters": []}, "arm_parameters must be a list of rows of numbers"),
    ("LinearBandit", {"arm_parameters": [[1, 2]]}, "arm_parameters must have two rows or more"),
    ("LinearBandit", {"arm_parameters": [[1, 2], [1]]}, "[1] has length 1, arm_parameters[0] has"),
    ("LinearBandit", {"arm_parameters": [[1, 2], [3, 4]], "n_features": 3}, "is 3, but 2 are"),
    ("LinearBandit", {"n_features": 0}, "n_features must be a whole number from 1 to 10000, not 0"),
    ("SegmentBandit", {"segment_probabilities": [0.3, 0.6]}, "must sum to 1, not to 0.9"),
    ("SegmentBandit", {"segment_probabilities": [0.3, 0.3, 0.4]}, "a row for each segment: 3"),
    ("SegmentBandit", ONE, "click_rates must have a column for each treatment, two or more"),
    ("SegmentBandit", {"click_rates": [[0.1, 0.2], [0.3, -0.1]]}, "[1][1] must be a finite"),
    ("SegmentBandit", {"batch_size": 0}, "batch_size must be a whole number from 1 to"),
    ("SegmentBandit", MANY, "1024 contexts and 2 arms are too many: twice"),
]


NAMED = [f"{name} {line}" for name, _, line in REFUSED]


@pytest.mark.parametrize(("name", "wrong", "line"), REFUSED, ids=NAMED)
def test_arguments_out_of_range_are_refused(name, wrong, line):
    with pytest.raises(ValueError, match=re.escape(line)) as refused:
        gym.make(f"{name}-v0", **wrong)
    assert "\n" not in str(refused.value)
