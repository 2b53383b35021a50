"""Run folders and trainings: names, locks, records, stops, files; evaluations; what fails."""

import json
import math
import os
import resource
import signal
import time
from pathlib import Path

import gymnasium as gym
import numpy as np
import pytest
from gymnasium import spaces
from gymnasium.envs.registration import EnvSpec
from hypothesis import given, settings
from hypothesis import strategies as st

from rl_yardstick.pipeline import files
from rl_yardstick.pipeline.callbacks import EvaluationCallback
from rl_yardstick.pipeline.errors import Stopped, UserError
from rl_yardstick.pipeline.run import Run, Stop, numbered_runs
from tests.pipeline.short_runs import CART, LAKE, TABLES, run_of, spec_of, trained


@pytest.fixture(autouse=True)
def own_place(tmp_path, monkeypatch, quick_runs):
    monkeypatch.chdir(tmp_path)


def test_numbers_are_given_once_and_the_newest_is_last():
    spec = spec_of("qlearning")
    paths = [Run.claim(Path("logs"), spec).path for _ in range(11)]
    paths.append(Run.claim(Path("logs"), spec, f"_{'a' * 36}").path)
    assert [path.name for path in paths[:2]] == ["FrozenLake-v1_1", "FrozenLake-v1_2"]
    (Path("logs/qlearning") / "FrozenLake-v1_x").mkdir()
    (Path("logs/qlearning") / "FrozenLake-v1-other_3").mkdir()
    found = numbered_runs(Path("logs/qlearning"), "FrozenLake-v1")
    assert [number for number, _ in found] == list(range(1, 13))
    assert [path for _, path in found] == paths
    # Each is held by one command at a time.
    with pytest.raises(UserError, match=r"in use by another command$"), Run(paths[0]):
        Run(paths[0]).__enter__()


@pytest.mark.parametrize(("is_new", "has_begun", "stays"), [(1, 0, 0), (1, 1, 1), (0, 0, 1)])
def test_a_new_run_in_which_nothing_happened_leaves_no_folder(is_new, has_begun, stays):
    run = Run.claim(Path("logs"), spec_of("qlearning"))
    run.is_new, run.has_begun = bool(is_new), bool(has_begun)
    with pytest.raises(UserError), run:
        raise UserError("wrong")
    assert run.path.exists() == bool(stays)
    assert Path("logs").exists() == bool(stays)


def test_the_folder_has_the_layout_of_rl_zoo3():
    entry = {"n_timesteps": 300, "gamma": 0.9, "env_kwargs": {"is_slippery": False}}
    run, outcome = run_of(spec_of("qlearning", LAKE, entry, save_freq=100, eval_freq=100))
    names = {str(path.relative_to(run.path)) for path in run.path.rglob("*") if path.is_file()}
    assert names == {
        *("FrozenLake-v1.zip", "best_model.zip", "evaluations.npz", "run.json", "value_maps.npz"),
        *(f"FrozenLake-v1/{name}" for name in ("args.yml", "config.yml", "command.txt")),
        *("0.monitor.csv", ".lock", *(f"rl_model_{n}_steps.zip" for n in (100, 200, 300))),
    } - ({".lock"} - names)
    assert list(run.checkpoints()) == [100, 200, 300]
    assert run.spec().hyperparams == entry
    record = run.recorded()
    assert (record["state"], record["n_timesteps"]) == ("finished", 300)
    assert record["final"]["mean_return"] == outcome.final.mean_return
    assert np.load(run.path / "evaluations.npz")["timesteps"].tolist() == [100, 200, 300]


def test_the_first_signal_is_a_number_and_the_second_ends_at_once():
    before = {number: signal.getsignal(number) for number in (signal.SIGINT, signal.SIGTERM)}
    stop = Stop().listen()
    stop.check()
    signal.raise_signal(signal.SIGTERM)
    with pytest.raises(Stopped) as stopped:
        stop.check()
    with pytest.raises(KeyboardInterrupt):
        signal.raise_signal(signal.SIGINT)
    for number, handler in before.items():
        signal.signal(number, handler)
    assert stopped.value.number == signal.SIGTERM


def test_an_error_is_recorded_and_what_was_written_stays(monkeypatch):
    evaluate, calls = EvaluationCallback.evaluate, []

    def fail_at_the_third(self):
        calls.append(1)
        if len(calls) == 3:
            raise OSError(28, "No space left on device", "evaluations.npz")
        return evaluate(self)

    monkeypatch.setattr(EvaluationCallback, "evaluate", fail_at_the_third)
    spec = spec_of("qlearning", n_timesteps=1000, eval_freq=100)
    with pytest.raises(OSError, match="No space"):
        run_of(spec)
    run = Run(Path("logs/qlearning/FrozenLake-v1_1"))
    record = run.recorded()
    assert record["state"] == "failed"
    assert "No space left on device" in record["reason"]
    assert (run.path / "best_model.zip").exists()


def test_a_file_has_its_name_when_it_is_whole(tmp_path):
    path = tmp_path / "a.txt"
    path.write_text("before")
    with pytest.raises(ZeroDivisionError), files.replacing(path) as beside:
        beside.write_text(f"half {beside.suffix == '.txt'}: {1 / 0}")
    assert path.read_text() == "before"
    handler, limits = signal.getsignal(signal.SIGXFSZ), resource.getrlimit(resource.RLIMIT_FSIZE)
    signal.signal(signal.SIGXFSZ, signal.SIG_IGN)
    resource.setrlimit(resource.RLIMIT_FSIZE, (10, limits[1]))  # as if the disk were full
    try:
        full = pytest.raises(OSError, match="File too large")
        with full as refused, files.replacing(path) as beside:
            beside.write_bytes(bytes(1000))
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, limits)
        signal.signal(signal.SIGXFSZ, handler)
    assert refused.value.filename == str(path)
    assert [each.name for each in tmp_path.iterdir()] == ["a.txt"]


def test_only_regular_files_of_moderate_size_are_read(tmp_path):
    (tmp_path / "large").write_bytes(bytes(11))
    (tmp_path / "bad.json").write_text('{"a": ')
    (tmp_path / "latin.txt").write_bytes("ä".encode("latin-1"))
    os.mkfifo(tmp_path / "pipe")
    begun = time.monotonic()
    for call, said in (
        (lambda: files.read_bytes(tmp_path / "large", 10), "is larger than 10 bytes"),
        (lambda: files.read_bytes(tmp_path / "pipe"), "is no regular file"),
        (lambda: files.read_bytes(tmp_path), "is a directory|is no regular file"),
        (lambda: files.read_bytes(tmp_path / "none"), "no such file"),
        (lambda: files.read_json(tmp_path / "bad.json"), r"bad\.json is no valid JSON"),
        (lambda: files.read_text(tmp_path / "latin.txt"), "is no UTF-8 text"),
    ):
        with pytest.raises(UserError, match=said):
            call()
    assert time.monotonic() - begun < 20
    # Into such as /dev/stdout results are written.
    reading = os.open(tmp_path / "pipe", os.O_RDONLY | os.O_NONBLOCK)
    files.write_json(tmp_path / "pipe", [1])
    assert json.loads(os.read(reading, 99)) == [1]
    os.close(reading)


@settings(max_examples=40)
@given(st.text(min_size=1))
def test_a_portable_name_is_one_and_stays_one(name):
    found = files.portable_name(name)
    assert files.portable_name(found) == found
    assert not set('<>:"/\\|?*') & set(found)
    assert len(found.encode(errors="replace")) <= files.LONGEST_NAME


def test_json_has_no_nan_and_keeps_infinity(tmp_path):
    data = {"a": np.float64(0.1), "b": [math.nan, -math.inf], "c": np.arange(2), 3: None}
    files.write_json(tmp_path / "a.json", data)
    read = json.loads((tmp_path / "a.json").read_text())
    assert read == {"a": 0.1, "b": [None, -math.inf], "c": [0, 1], "3": None}
    assert files.json_text(math.inf) == "1e999"


SMALL_PPO = {"n_steps": 32, "batch_size": 16, "n_epochs": 1, "n_envs": 1}


@pytest.mark.parametrize(
    ("entry", "fields", "steps"),
    [
        ({"n_envs": 4}, {"eval_freq": 250}, [248, 496, 744, 992]),
        ({}, {}, list(range(50, 1001, 50))),
        ({}, {"eval_freq": 5000}, [1000]),  # at the end, if at no other time
        ({}, {"eval_freq": -1}, None),
    ],
)
def test_when_evaluations_come(entry, fields, steps):
    run, outcome = trained("qlearning", LAKE, entry, n_timesteps=1000, **fields)
    path = run.path / "evaluations.npz"
    assert (steps is None) == (outcome.final is None) == (not path.exists())
    if steps is not None:
        assert np.load(path)["timesteps"].tolist() == steps
        assert outcome.evaluation.best_timesteps in steps


class Sick(gym.Env):
    """Returns a wrong number, or raises an error, at its 30th step."""

    observation_space = spaces.Box(-1, 1, (2,), np.float32)
    action_space = spaces.Discrete(2)

    def __init__(self, fault):
        self.fault, self.n_steps = fault, 0

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        return np.zeros(2, np.float32), {}

    def step(self, action):
        self.n_steps += 1
        is_time = self.n_steps == 30
        if is_time and self.fault == "error":
            raise RuntimeError("the motor is broken")
        if is_time and self.fault == "exit":
            raise SystemExit("enough")
        obs = np.full(2, np.nan if is_time and self.fault == "observation" else 0, np.float32)
        reward = float("inf") if is_time and self.fault == "reward" else 1.0
        return obs, reward, self.n_steps % 10 == 0, False, {}


@pytest.mark.parametrize(
    ("fault", "kind", "said"),
    [
        ("reward", UserError, "reward of environment 0 at step 30 is inf"),
        ("observation", UserError, "observation of an episode of environment 0 at step 30 is nan"),
        ("error", RuntimeError, "the motor is broken"),  # of the user's own code, as it is
        ("exit", SystemExit, "enough"),
    ],
)
def test_what_an_environment_does_wrong(fault, kind, said, monkeypatch):
    sick = EnvSpec("Sick-v0", Sick, max_episode_steps=50, kwargs={"fault": fault})
    monkeypatch.setitem(gym.registry, "Sick-v0", sick)
    spec = spec_of("ppo", "Sick-v0", SMALL_PPO, n_timesteps=64, eval_freq=16, eval_episodes=1)
    with pytest.raises(kind, match=said):
        run_of(spec)
    run = Run(Path("logs/ppo/Sick-v0_1"))
    record = run.recorded()
    assert record["state"] == "failed"
    assert said.split()[-1] in record["reason"]
    assert not (run.path / "Sick-v0.zip").exists()


def test_an_agent_that_learns_nonsense_is_not_saved():
    entry = {**SMALL_PPO, "learning_rate": 1e30, "max_grad_norm": 1e30}
    with pytest.raises(UserError, match=r"is (nan|inf|-inf)"):
        trained("ppo", CART, entry, n_timesteps=128, eval_freq=-1)
    assert not list(Path("logs").rglob("CartPole-v1.zip"))


@pytest.mark.parametrize(("algo", "entry", "said"), TABLES["constructors"])
def test_what_only_the_constructor_knows_is_one_line_and_leaves_no_folder(algo, entry, said):
    with pytest.raises(UserError) as caught:
        trained(algo, CART, entry, n_timesteps=64)
    assert said in str(caught.value)
    assert not Path("logs").exists()


def test_subprocesses_do_the_same():
    common = {"n_timesteps": 64, "eval_freq": 32, "eval_episodes": 1, "final_episodes": 1}
    common["n_eval_envs"], entry = 1, {**SMALL_PPO, "n_envs": 2}
    here, _ = trained("ppo", CART, entry, **common)
    there, _ = trained("ppo", CART, entry, vec_env="subproc", **common)
    one, other = (np.load(run.path / "evaluations.npz")["results"] for run in (here, there))
    np.testing.assert_array_equal(one, other)
