"""Runs that share a process: to the same bits, and each on its own where something goes wrong."""

import copy
import io
import json
import multiprocessing
import os
import signal
import threading
import time
import zipfile
from dataclasses import replace
from functools import partial
from pathlib import Path

import gymnasium as gym
import numpy as np
import pytest
import torch as th

from experiments import child_processes
from experiments.child_processes import (
    StoppedError,
    TaskDiedError,
    TaskFailedError,
    local_executor,
    stop_all,
    supervise,
)
from experiments.launching import execute, local_launcher
from experiments.plan import plan
from experiments.run_folders import draft_path
from experiments.run_in_child import do_run
from experiments.run_limits import RunLimits
from experiments.study import AgentSpec, EnvironmentSpec, StudySpec
from pipeline.evaluation import exact
from pipeline.evaluation.exact import exact_evaluator
from pipeline.settings.hyperparams import ComponentSpec
from pipeline.train_spec import is_plain

AGENTS = (
    AgentSpec("first", "qlearning", tuned=False),
    AgentSpec(
        "second", "sarsa", tuned=False, settings={"learning_rate": 0.3, "mask_actions": True}
    ),
    AgentSpec("third", "double_qlearning", tuned=False, settings={"n_envs": 2}),
)
SMALL = {"engine": "compiled", "n_timesteps": 600, "policy_kwargs": {"net_arch": [8]}}
Q = {"learning_starts": 50, "buffer_size": 300, "batch_size": 16}
NETWORKS = (
    AgentSpec("ppo", "ppo", tuned=False, settings={**SMALL, "n_steps": 64, "n_envs": 2}),
    AgentSpec("dqn", "dqn", tuned=False, settings={**SMALL, **Q}),
)
ENVIRONMENTS = (
    EnvironmentSpec("house", "Warehouse-v0", {"n_episodes": 60, "env_kwargs": {"slip": 0.1}}),
    EnvironmentSpec("mines", "MineMaze-v0", {"n_timesteps": 3000}),
)


def runs_of(root, n_seeds=2, agents=AGENTS, environments=ENVIRONMENTS):
    return plan(StudySpec("s", "S", agents, environments, n_seeds=n_seeds), root)


@pytest.fixture(scope="module", autouse=True)
def server():
    """One that has imported the libraries, so that no child has to."""
    child_processes.start_server()


@pytest.fixture(autouse=True)
def ready(monkeypatch):
    monkeypatch.setattr(child_processes, "_stopping", threading.Event())
    yield
    child_processes._end_idle()
    assert not child_processes._children


@pytest.fixture
def chores(tmp_path, monkeypatch):
    (tmp_path / "shared_chores.py").write_text(
        "import os, signal, time\n"
        "def who(*_): return os.getpid()\n"
        "def fail(words): raise ValueError(words)\n"
        "def die_first(folder):\n"
        "    path = os.path.join(folder, 'died')\n"
        "    if not os.path.exists(path):\n"
        "        open(path, 'w').close()\n"
        "        os.kill(os.getpid(), signal.SIGKILL)\n"
        "    return os.getpid()\n"
        "def nap(seconds):\n"
        "    time.sleep(seconds)\n"
        "    return os.getpid()\n"
    )
    monkeypatch.syspath_prepend(tmp_path)
    import shared_chores

    return shared_chores


def nothing():
    pass


def shared(function, *args, **kwargs):
    return supervise(function, *args, clean_up=nothing, shares_process=True, **kwargs)


def test_tasks_that_may_share_a_process_do_and_others_do_not(chores):
    with local_executor(1) as executor:
        ask = [executor.submit(shared, chores.who) for _ in range(3)]
        assert len({each.result() for each in ask}) == 1
        alone = executor.submit(supervise, chores.who, clean_up=nothing).result()
        limited = executor.submit(shared, chores.who, limits=RunLimits(memory=10**12)).result()
        again = executor.submit(shared, chores.who).result()
    assert len({ask[0].result(), alone, limited, again}) == 4
    assert not child_processes._idle
    assert not child_processes._children


def test_after_one_that_fails_the_next_begins_afresh(chores):
    first = shared(chores.who)
    with pytest.raises(TaskFailedError, match="thin ice"):
        shared(chores.fail, "thin ice")
    assert shared(chores.who) != first


def test_one_that_dies_is_tried_again_in_a_process_of_its_own(chores, tmp_path):
    first = shared(chores.who)
    assert shared(chores.die_first, str(tmp_path)) != first


def test_one_that_was_killed_while_it_waited_is_noticed(chores):
    os.kill(shared(chores.who), signal.SIGKILL)
    assert shared(chores.who) > 0


def test_a_limit_of_time_is_that_of_the_task_alone(chores):
    limits = RunLimits(seconds=3)
    first = shared(chores.nap, 1.2, limits=limits)
    for _ in range(3):
        assert shared(chores.nap, 1.2, limits=limits) == first
    with pytest.raises(TaskFailedError, match="--run-timeout allows, 3 s") as error:
        shared(chores.nap, 60, limits=limits)
    assert not isinstance(error.value, TaskDiedError)
    assert "in nap\n" in error.value.details
    assert shared(chores.who) != first


def test_a_stop_ends_those_that_work_and_those_that_wait(chores):
    with local_executor(2) as executor:
        ask = [executor.submit(shared, chores.nap, 0.3) for _ in range(2)]
        pids = {each.result() for each in ask}
        working = executor.submit(shared, chores.nap, 60)
        time.sleep(0.2)
        stop_all()
        assert isinstance(working.exception(), StoppedError)
    for pid in pids:
        assert not Path(f"/proc/{pid}").exists() or "Z" in Path(f"/proc/{pid}/stat").read_text()


@pytest.mark.parametrize("method", ["spawn"])
def test_it_is_the_same_where_nothing_forks(chores, method, monkeypatch):
    monkeypatch.setattr(child_processes, "context", multiprocessing.get_context(method))
    assert shared(chores.who) == shared(chores.who)


def one_at_a_time(root):
    return root, partial(local_launcher, root, "c", 1), lambda *_: None


def data_of(path):
    """The JSON of an agent, without the seconds that its last episodes took."""
    with zipfile.ZipFile(path) as archive:
        data = json.loads(archive.read("data"))
    episodes = data["ep_info_buffer"]["iterable"]
    assert [[name for name, _ in each["pairs"]] for each in episodes] == [["r", "l", "t"]] * len(
        episodes
    )
    return {**data, "ep_info_buffer": [each["pairs"][:2] for each in episodes]}


def bits_of(folder):
    """All that a run leaves, but for moments, durations and places."""
    found = {}
    for path in sorted(path for path in folder.rglob("*") if path.is_file()):
        name = path.relative_to(folder).as_posix()
        if path.suffix == ".zip":
            with zipfile.ZipFile(path) as archive:
                tables = th.load(io.BytesIO(archive.read("policy.pth")))
            found[name] = [(key, table.numpy().tobytes()) for key, table in tables.items()]
            found[f"{name}: data"] = data_of(path)
        elif path.suffix == ".npz":
            found[name] = {key: array.tobytes() for key, array in np.load(path).items()}
        elif name.endswith("monitor.csv"):
            found[name] = [line.split(",")[:2] for line in path.read_text().splitlines()[1:]]
        elif name == "run.json":
            info = json.loads(path.read_text())
            assert set(info.pop("files")) == set(found_files(folder)) | {"run.json"}
            found[name] = {k: v for k, v in info.items() if k not in ("seconds", "cpu_seconds")}
        else:
            found[name] = path.read_bytes()
    return found


def found_files(folder):
    files = (path.relative_to(folder).as_posix() for path in folder.rglob("*") if path.is_file())
    return [name for name in files if name != "run.json"]


def test_runs_in_one_process_leave_what_each_leaves_alone(tmp_path):
    """Of the last seed, whose runs come after all others, one of each agent."""
    (tmp_path / "together").mkdir()
    together, alone = runs_of(tmp_path / "together"), runs_of(tmp_path / "alone")[-5::2]
    assert all(is_plain(run.spec) for run in together)
    assert not execute(together, *one_at_a_time(tmp_path / "together"))
    with local_executor(1) as executor:
        for run in alone:
            draft = draft_path(tmp_path / "alone", run)
            work = (do_run, run, draft, "c")
            executor.submit(supervise, *work, clean_up=nothing).result()
    assert {run.agent for run in alone} == {agent.label for agent in AGENTS}
    for mine, its in zip(together[-5::2], alone, strict=True):
        ours, theirs = bits_of(mine.path), bits_of(its.path)
        assert ours.keys() == theirs.keys()
        for name, found in ours.items():
            assert found == theirs[name], (mine.path, name)


def test_so_do_runs_of_compiled_networks(tmp_path):
    """On an environment that is evaluated exactly, and on one where episodes are played."""
    lake = EnvironmentSpec("lake", "FrozenLake-v1", {"train_env_wrapper": CLIPPED})
    poles = EnvironmentSpec("poles", "CartPole-v1", {})
    (tmp_path / "together").mkdir()
    together = runs_of(tmp_path / "together", 2, NETWORKS, (lake, poles))
    alone = runs_of(tmp_path / "alone", 2, NETWORKS, (lake, poles))[-4:]
    assert all(is_plain(run.spec) for run in together)
    assert not execute(together, *one_at_a_time(tmp_path / "together"))
    with local_executor(2) as executor:
        tasks = [
            executor.submit(
                supervise, do_run, run, draft_path(tmp_path / "alone", run), "c", clean_up=nothing
            )
            for run in alone
        ]
        for task in tasks:
            task.result()
    for mine, its in zip(together[-4:], alone, strict=True):
        assert mine.run.read_info()["engine"] == "compiled"
        assert learnt(mine.path) == learnt(its.path)


CLIPPED = [{"gymnasium.wrappers.ClipReward": {"min_reward": 0, "max_reward": 0.5}}]


def learnt(folder):
    """The bits of weights and optimizers; what Monitor and evaluations have seen."""
    found = {}
    for path in sorted(folder.rglob("*.zip")):
        with zipfile.ZipFile(path) as archive:
            names = ("policy.pth", "policy.optimizer.pth")
            found[path.name] = [archive.read(name) for name in names]
    with np.load(folder / "evaluations.npz") as evaluations:
        found |= {name: array.tobytes() for name, array in evaluations.items()}
    for path in sorted(folder.glob("*.monitor.csv")):
        found[path.name] = [row.split(",")[:2] for row in path.read_text().splitlines()[1:]]
    return found


def test_seconds_of_runs_that_share_a_process_are_their_own(tmp_path):
    short = AgentSpec("short", "qlearning", tuned=False, settings={"n_timesteps": 1000})
    long = AgentSpec("long", "qlearning", tuned=False, settings={"n_timesteps": 6_000_000})
    lake = (EnvironmentSpec("lake", "FrozenLake-v1", {}),)
    runs = runs_of(tmp_path, 2, (short, long), lake)
    execute(runs, *one_at_a_time(tmp_path))
    taken = {"short": [], "long": []}
    for run in runs:
        taken[run.agent].append(run.run.read_info()["cpu_seconds"])
    assert max(taken["short"]) < min(taken["long"]) / 3


def test_what_a_run_must_not_share_its_process_with():
    spec = runs_of(Path("x"))[0].spec
    special = spec.hyperparams
    own = ComponentSpec("mine.Wrapper")
    library = replace(special, algorithm={"engine": "library"})
    for other in (
        replace(spec, gym_packages=("mine",)),
        replace(spec, tensorboard_log=Path("t")),
        replace(spec, trained_agent=Path("a.zip")),
        replace(spec, algo="dqn"),
        replace(spec, algo="ppo", hyperparams=library),
        replace(spec, algo="sac", hyperparams=replace(special, algorithm={"engine": "compiled"})),
        replace(spec, algo="no_such_agent"),
        replace(spec, hyperparams=replace(special, callback="mine.Callback")),
        replace(spec, hyperparams=replace(special, env_wrapper="mine.Wrapper")),
        replace(spec, hyperparams=replace(special, train_env_wrapper=(own,))),
        replace(spec, hyperparams=replace(special, normalize={})),
        replace(spec, vec_env="subproc"),
        replace(spec, env_id="Nowhere-v0"),
    ):
        assert not is_plain(other)


@pytest.fixture
def registered(monkeypatch):
    """The warehouse's entry, which may be changed."""
    entry = copy.deepcopy(gym.registry["Warehouse-v0"])
    monkeypatch.setitem(gym.registry, "Warehouse-v0", entry)
    return entry


def test_an_environment_registered_by_somebody_else_is_no_plain_one(registered):
    spec = runs_of(Path("x"))[0].spec
    registered.entry_point = "mine.houses:Warehouse"
    assert not is_plain(spec)


def test_an_evaluator_is_kept_for_runs_on_the_very_same_environment(registered):
    exact._kept.clear()
    runs = runs_of(Path("x"), 1)
    spec, other = (
        next(run.spec for run in runs if run.environment == name) for name in ("house", "mines")
    )
    first = exact.evaluator_of(spec)
    assert exact.evaluator_of(replace(spec, seed=5)) is first
    assert first.yardstick == exact_evaluator(spec).yardstick
    slippery = replace(spec.hyperparams, eval_env_kwargs={"slip": 0.4})
    changed = exact.evaluator_of(replace(spec, hyperparams=slippery))
    assert changed.yardstick != first.yardstick
    masked = replace(spec.hyperparams, algorithm={"mask_actions": True})
    assert exact.evaluator_of(replace(spec, hyperparams=masked)) is not first
    assert exact.evaluator_of(other).model.n_states != first.model.n_states
    registered.kwargs["shelf_reward"] = -7
    assert exact.evaluator_of(spec).yardstick != first.yardstick
    assert len(exact._kept) <= exact.MOST_KEPT
