"""What holds for every registered environment, whatever its arguments."""

import copy
import pickle
import re
import subprocess
import sys
from contextlib import nullcontext
from pathlib import Path

import gymnasium as gym
import numpy as np
import pytest
import stable_baselines3.common.env_checker as sb3_checker
from gymnasium.envs.registration import EnvSpec
from gymnasium.utils import env_checker

import envs  # noqa: F401 (registers the environments)
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


def named(variants):
    """A table of environments, each row named by its id and arguments."""
    names = [f"{name} {' '.join(kwargs)}".strip() for name, kwargs in variants]
    return pytest.mark.parametrize(("env_id", "kwargs"), variants, ids=names)


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
    sb3_checker.check_env(env, warn=True, skip_render_check=False)


@every_variant
def test_its_spec_a_seed_and_copies_in_mid_episode_give_the_same_episodes(env_id, kwargs):
    env = gym.make(env_id, render_mode="rgb_array", max_episode_steps=15, **kwargs)
    again = gym.make(EnvSpec.from_json(env.spec.to_json()))
    assert_equal(env.reset(seed=5), again.reset(seed=5))
    assert_equal(play(env, 37, seed=4), play(again, 37, seed=4))
    env.render()
    copies = [again, pickle.loads(pickle.dumps(env)), copy.deepcopy(env)]
    expected = play(env, 30, seed=3)
    infos = [returned[-1] for returned in expected]
    assert len({id(info) for info in infos}) == len(infos)
    kinds = {type(value) for info in infos for value in info.values()}
    assert kinds <= {bool, int, float, tuple}
    for other in copies:
        assert_equal(play(other, 30, seed=3), expected)
    np.testing.assert_array_equal(copies[1].render(), env.render())


@every_id
def test_it_renders_as_text_and_as_pictures_and_closes_twice(env_id, kwargs):
    for mode, result in (("ansi", str), ("rgb_array", np.ndarray), (None, type(None))):
        env = gym.make(env_id, render_mode=mode, **kwargs).unwrapped
        env.reset(seed=0)
        env.step(0)
        with nullcontext() if mode else pytest.warns(UserWarning, match="without render_mode"):
            assert isinstance(env.render(), result)
        env.close()
        env.close()
    with pytest.raises(ValueError, match="render_mode 'ansy': did you mean 'ansi'"):
        type(env)(render_mode="ansy", **kwargs)


@every_id
def test_an_action_that_does_not_exist_is_refused(env_id, kwargs):
    env = gym.make(env_id, **kwargs).unwrapped
    env.reset(seed=0)
    for action in (-1, env.action_space.n):
        told = rf"(action|arm) {action} does not exist: (0 up|they are)"
        with pytest.raises(ValueError, match=told):
            env.step(action)
    assert isinstance(env.step(np.array(0))[0], int | np.ndarray)  # arrays without axes may be


@named([(f"{name}-v0", {}) for name in ("Warehouse", "MaximizationBias", "Tiger", "RandomWalk")])
def test_p_is_the_model_as_dictionaries(env_id, kwargs):
    env = gym.make(env_id, **kwargs).unwrapped
    arrays = env.transition_model()
    again = TransitionModel.from_gymnasium(env.P, env.initial_state_distrib)
    for name in ("prob", "next_state", "reward", "terminated", "initial"):
        np.testing.assert_array_equal(getattr(arrays, name), getattr(again, name))
    assert [type(value) for value in env.P[0][0][0]] == [float, int, float, bool]


# --- arguments ------------------------------------------------------------------------------------

REFUSED = [
    ("Warehouse", {"slip": -0.1}, "slip must be a finite number from 0 to 1, not -0.1"),
    ("Warehouse", {"observation": "positon"}, "'positon': did you mean 'position'? It must be one"),
    ("MineMaze", {"random_start": 1}, "random_start must be true or false, not 1"),
    ("RandomWarehouse", {"shelf_density": 1.1}, "shelf_density must be a finite number from 0 to"),
    ("DynaMaze", {"maze": "blocking", "change_after_steps": 5}, "change_after_steps needs changed"),
    ("WindyGridworld", {"moves": "queen"}, "unknown moves 'queen'"),
    ("DeepSea", {"size": 1}, "size must be a whole number from 2"),
    ("JacksCarRental", {"variant": "exam"}, "unknown variant 'exam': did you mean 'exam"),
    ("BernoulliBandit", {"probabilities": [0.5]}, "must hold 2 numbers or more, not 1"),
    ("BernoulliBandit", {"pulls": 0}, "pulls must be a whole number from 1 to 1000000000, not 0"),
    ("GaussianBandit", {"means": [1, 2], "n_arms": 3}, "n_arms is 3, but 2 are given: leave it"),
    ("LinearBandit", {"arm_parameters": [[1, 2], [1]]}, "[1] has length 1, arm_parameters[0] has"),
    ("SegmentBandit", {"segment_probabilities": [0.3, 0.6]}, "must sum to 1, not to 0.9"),
]


@pytest.mark.parametrize(("name", "wrong", "line"), REFUSED, ids=str)
def test_arguments_out_of_range_are_refused(name, wrong, line):
    with pytest.raises(ValueError, match=re.escape(line)) as refused:
        gym.make(f"{name}-v0", **wrong)
    assert "\n" not in str(refused.value)
