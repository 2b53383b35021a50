"""Policies and zips by themselves: what loads them needs, and what it may replace."""

import pickletools
import subprocess
import sys
import zipfile
from base64 import b64decode
from json import loads

import gymnasium as gym
import numpy as np
import pytest
import torch as th
from stable_baselines3.common.env_util import make_vec_env

import envs  # noqa: F401  # registers the bandits
from agents import ALGORITHMS, load_algorithm
from agents.common.model_files import JsonAlgorithm
from agents.common.schedules import ExponentialSchedule, library_schedule
from pipeline.settings.components import build_algorithm_kwargs

# Classes of ours on agents of the library, whose zips are its own.
ON_THE_LIBRARY = ("dqn", "double_dqn", "deep_qlearning", "ppo", "a2c", "ars")
HAND_WRITTEN = [
    name
    for name, entry in ALGORITHMS.items()
    if entry.entry_point.startswith("agents.") and entry.is_installed and name not in ON_THE_LIBRARY
]
EXPONENTIAL = {
    "ppo": {"learning_rate": "exp_0.1_0.001", "clip_range": "exp_0.4_0.1"},
    "a2c": {"learning_rate": "exp_0.1_0.001"},
    "dqn": {"learning_rate": "exp_0.1_0.001"},
    "double_dqn": {"learning_rate": "exp_0.1_0.001"},
    "deep_qlearning": {"learning_rate": "exp_0.1_0.001"},
    "qrdqn": {"learning_rate": "exp_0.1_0.001"},
}


def made(name):
    env_id = "SegmentBandit-v0" if ALGORITHMS[name].for_bandits else "FrozenLake-v1"
    env_id = {
        "angle": "CartPole-v1",
        "mabwiser_thompson": "BernoulliBandit-v0",
        "thompson": "BernoulliBandit-v0",
    }.get(name, env_id)
    algorithm = load_algorithm(name)
    return algorithm(next(iter(algorithm.policy_aliases)), make_vec_env(env_id, seed=0), seed=0)


def observations(space):
    space.seed(0)
    return np.stack([space.sample() for _ in range(50)])


def test_all_of_them_are_tried():
    classes = {name: load_algorithm(name) for name, e in ALGORITHMS.items() if e.is_installed}
    assert {n for n, cls in classes.items() if issubclass(cls, JsonAlgorithm)} == set(HAND_WRITTEN)


@pytest.mark.parametrize("name", HAND_WRITTEN)
def test_a_loaded_policy_predicts_the_same(name, tmp_path):
    policy = made(name).learn(300).policy
    policy.save(tmp_path / "policy.pth")
    loaded = type(policy).load(tmp_path / "policy.pth")
    for key, value in policy.state_dict().items():
        assert th.equal(loaded.state_dict()[key], value)
    obs = observations(policy.observation_space)
    for deterministic in (True, False):
        ours, theirs = (p.predict(obs, deterministic=deterministic)[0] for p in (policy, loaded))
        np.testing.assert_array_equal(ours, theirs)


@pytest.mark.parametrize("name", HAND_WRITTEN)
def test_custom_objects_replace_what_the_file_holds_and_nothing_else(name, tmp_path):
    model = made(name)
    model.save(tmp_path / "agent")
    replaced = {"stats_window_size": 7, "predict": "shadowed", "no_such_thing": 1}
    loaded = type(model).load(tmp_path / "agent", custom_objects=replaced)
    assert loaded._stats_window_size == model._stats_window_size
    assert "predict" not in vars(loaded)
    assert "no_such_thing" not in vars(loaded)
    loaded = type(model).load(tmp_path / "agent", custom_objects={"_stats_window_size": 7})
    assert loaded._stats_window_size == 7


def test_what_is_replaced_need_not_be_readable(tmp_path):
    model = made("qlearning")
    model.save(tmp_path / "agent")
    with zipfile.ZipFile(tmp_path / "agent.zip") as archive:
        parts = {name: archive.read(name) for name in archive.namelist()}
    parts["data"] = parts["data"].replace(
        b'"learning_rate": 0.1', b'"learning_rate": {"type": "?"}'
    )
    with zipfile.ZipFile(tmp_path / "other.zip", "w") as archive:
        for name, content in parts.items():
            archive.writestr(name, content)
    with pytest.raises(ValueError, match="unknown type '\\?'"):
        type(model).load(tmp_path / "other")
    loaded = type(model).load(tmp_path / "other", custom_objects={"learning_rate": 0.25})
    assert loaded.lr_schedule(0.5) == 0.25
    with pytest.raises(ValueError, match="custom_objects must be a dictionary"):
        type(model).load(tmp_path / "agent", custom_objects=["learning_rate"])


@pytest.mark.parametrize(("start", "end"), [(0.1, 0.001), (0.001, 0.1), (0.5, 0.5)])
def test_a_librarys_schedule_is_ours(start, end):
    ours = ExponentialSchedule(start, end)
    theirs = library_schedule(ours)
    for remaining in np.linspace(0.0, 1.0, 11).tolist():
        assert float(theirs(remaining)) == pytest.approx(ours(remaining), rel=1e-12)


def zip_with_exponential_schedule(name, tmp_path):
    algorithm = load_algorithm(name)
    kwargs = build_algorithm_kwargs(algorithm, {"policy": "MlpPolicy", **EXPONENTIAL[name]}, name)
    model = algorithm(env=gym.make("CartPole-v1"), **kwargs)
    model.save(tmp_path / name)
    return tmp_path / f"{name}.zip"


@pytest.mark.parametrize("name", EXPONENTIAL)
def test_a_library_agents_zip_names_no_module_of_this_project(name, tmp_path):
    with zipfile.ZipFile(zip_with_exponential_schedule(name, tmp_path)) as archive:
        data = loads(archive.read("data"))
    words = [
        str(argument)
        for value in data.values()
        if isinstance(value, dict) and ":serialized:" in value
        for _, argument, _ in pickletools.genops(b64decode(value[":serialized:"]))
    ]
    assert any(word.startswith("stable_baselines3") for word in words)
    ours = {"agents", "envs", "mdp", "pipeline", "experiments", "commands"}
    assert ours.isdisjoint(word.partition(".")[0] for word in words)


def test_a_library_agents_zip_opens_where_this_project_is_not(tmp_path):
    path = zip_with_exponential_schedule("ppo", tmp_path)
    code = (
        "import sys\n"
        f"sys.path = [p for p in sys.path if 'site-packages' in p or 'lib/python' in p]\n"
        "sys.meta_path = [f for f in sys.meta_path if 'editable' not in repr(f)]\n"
        "import importlib.util\n"
        "assert importlib.util.find_spec('agents') is None\n"
        "from stable_baselines3 import PPO\n"
        f"model = PPO.load({str(path)!r})\n"
        "print(model.lr_schedule(0.5), model.clip_range(0.5))\n"
    )
    done = subprocess.run(
        [sys.executable, "-I", "-W", "error", "-c", code],
        capture_output=True,
        text=True,
        cwd=tmp_path,
        check=False,
    )
    assert done.returncode == 0, done.stderr
    assert [float(word) for word in done.stdout.split()] == pytest.approx([0.01, 0.2])
