"""Doing the runs of a study: drafts, faults, order, time left; and runs that are in the way."""

import contextlib
import errno
import heapq
import json
import math
import os
import platform
import re
import shutil
import subprocess
import sys
import threading
from concurrent.futures import Future
from dataclasses import replace
from functools import partial
from pathlib import Path

import gymnasium as gym
import numpy as np
import pytest
import yaml

import agents
from agents import ALGORITHMS
from agents.registry import AlgorithmEntry
from agents.tabular.algorithm import TabularAlgorithm
from experiments import child_processes, launching, run_in_child
from experiments.launching import (
    WINDOW,
    TimeLeft,
    available_cores,
    execute,
    expected_seconds,
    failure_log,
    local_launcher,
)
from experiments.plan import plan
from experiments.run_folders import (
    check_settings_kept,
    claim_draft,
    draft_path,
    in_the_way,
    leave_drafts,
    move_replaced_aside,
    remove_dead_drafts,
    remove_draft,
    run_name,
    take_over,
)
from experiments.run_in_child import do_run, take_steps, warm_ups
from experiments.study import AgentSpec, EnvironmentSpec, StudySpec
from machine_code.compiling import inlined
from pipeline import state_saver
from pipeline.errors import UserError
from pipeline.state_files import MAGIC, SOURCES, read_state, state_key, write_state
from pipeline.user_modules import UserModule, import_typed

LAKE = EnvironmentSpec("dry lake", "FrozenLake-v1", {"n_timesteps": 20})
ARMS = EnvironmentSpec("arms", "BernoulliBandit-v0", {"n_timesteps": 20})


def study_of(algo="qlearning", environment=LAKE, n_seeds=2, tensorboard=False, **settings):
    agent = AgentSpec("mine", algo, settings)
    return StudySpec("s", "S", (agent,), (environment,), n_seeds=n_seeds, tensorboard=tensorboard)


def runs_of(root, **fields):
    return plan(study_of(**fields), root)


# --- One run.


def test_a_run_says_what_it_is(tmp_path):
    _, planned = runs_of(tmp_path, tensorboard=True)
    draft, old = draft_path(tmp_path, planned), planned.spec.tensorboard_log / "of an earlier try"
    old.mkdir(parents=True)
    do_run(planned, draft, "compare.py s.yml")
    assert planned.is_finished
    assert not draft.exists()
    assert not old.exists()
    assert list(old.parent.rglob("events.out.tfevents.*"))
    args = yaml.safe_load((planned.run.params_path / "args.yml").read_text())
    given = {key: value for key, value in args.items() if value is not None}
    assert given == {"algo": "qlearning", "env": "FrozenLake-v1", "seed": 1}
    assert "compare.py s.yml" in (planned.run.params_path / "command.txt").read_text()
    info = json.loads(planned.run.info_path.read_text())
    assert (info["state"], info["spec"]["seed"]) == ("finished", 1)
    # Another process was faster: what it has done stays.
    (planned.path / "mark").touch()
    do_run(planned, draft, "again")
    assert (planned.path / "mark").exists()


@pytest.mark.parametrize(
    ("algo", "env_id"), [("qlearning", "FrozenLake-v1"), ("ucb", "GaussianBandit-v0")]
)
def test_a_draft_is_closed_and_on_the_disk_before_it_has_its_name(
    tmp_path, monkeypatch, algo, env_id
):
    """Windows would not rename it else; and after a power cut it may not lack its files."""
    (planned,) = runs_of(tmp_path, algo=algo, environment=replace(LAKE, env_id=env_id), n_seeds=1)
    draft, fsync, rename, events = draft_path(tmp_path, planned), os.fsync, os.replace, []

    def synced(number):
        events.append(Path(f"/proc/self/fd/{number}").readlink().name)
        fsync(number)

    def named(source, target, **folder):
        if Path(target) == planned.path:
            still_open = [os.path.realpath(file) for file in Path("/proc/self/fd").iterdir()]
            assert not [name for name in still_open if name.startswith(str(draft))]
            events.append("named")
        rename(source, target, **folder)

    monkeypatch.setattr(os, "fsync", synced)
    monkeypatch.setattr(os, "replace", named)
    do_run(planned, draft, "")
    place = events.index("named")
    assert {path.name for path in planned.path.rglob("*")} <= set(events[:place])
    assert planned.path.parent.name in events[place:]


# An environment that fails as it is told, where it is trained on, with a state in its draft.
FAULTY = """
import errno, pathlib, gymnasium as gym
from gymnasium.envs.toy_text.frozen_lake import FrozenLakeEnv
from pipeline.errors import UserError
from pipeline.state_files import MAGIC, SOURCES, read_state, state_key, write_state

FULL = OSError(errno.ENOSPC, "No space left on device")
FAULTS = {
    "disk": (UserError("the disk takes no more"), FULL),
    "memory": (MemoryError(), None),
    "allocator": (RuntimeError("DefaultCPUAllocator: can't allocate memory"), None),
    "user": (UserError("reward at step 3 is nan"), None),
    "library": (RuntimeError("thin ice"), None),
    "file": (FileNotFoundError(errno.ENOENT, "the environment's own file"), None),
}

class Faulty(FrozenLakeEnv):
    def __init__(self, fault="", root=""):
        super().__init__()
        self.fault, self.root = fault, root

    def step(self, action):
        if self.fault:
            for draft in pathlib.Path(self.root, ".drafts").glob("*"):
                (draft / "state").mkdir(exist_ok=True)
                (draft / "state" / "odd.state").touch()
            error, cause = FAULTS[self.fault]
            raise error from cause
        return super().step(action)

gym.register("Faulty-v0", Faulty, max_episode_steps=20)

class Counting(gym.Env):
    observation_space = action_space = gym.spaces.Discrete(2)

    def __init__(self, path=""):
        self.path = path

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        return 0, {}

    def step(self, action):
        if self.path:
            with open(self.path, "a") as steps:
                steps.write(".")
                if steps.tell() == 15:
                    raise MemoryError
        return 0, 0.0, False, False, {}

gym.register("Counting-v0", Counting, max_episode_steps=4)
"""


@pytest.fixture(scope="module")
def faulty_lake(tmp_path_factory):
    path = tmp_path_factory.mktemp("own") / "faulty_lake.py"
    path.write_text(FAULTY)
    yield import_typed([str(path)])
    del gym.registry["Faulty-v0"], gym.registry["Counting-v0"]
    del sys.modules["faulty_lake"]


@pytest.fixture
def faulty(tmp_path, faulty_lake):
    """Runs on environments that fail so, or not at all, in the folder of their study."""

    def runs(*faults):
        settings = [{"fault": fault, "root": str(tmp_path)} for fault in faults]
        places = [
            EnvironmentSpec(f"lake {n}", "Faulty-v0", {"n_timesteps": 20, "env_kwargs": kwargs})
            for n, kwargs in enumerate(settings)
        ]
        study = replace(study_of(n_seeds=1), environments=tuple(places), user_modules=faulty_lake)
        return tmp_path, plan(replace(study, gym_packages=("faulty_lake",)), tmp_path)

    return runs


KEPT = {"disk": True, "memory": True, "allocator": True, "user": False, "library": False}


@pytest.mark.parametrize(("fault", "is_kept"), [*KEPT.items(), ("file", False)])
def test_what_a_run_failed_by_says_whether_the_next_try_goes_on(faulty, fault, is_kept):
    root, (planned,) = faulty(fault)
    draft = draft_path(root, planned)
    with pytest.raises(Exception, match=r".*"):
        do_run(planned, draft, "c")
    leave_drafts(root, run_name(planned))
    assert draft.exists() == is_kept


@pytest.mark.parametrize(("is_of_others", "n_steps"), [(False, 6), (True, 20)])
def test_a_study_goes_on_from_states_of_its_own_sources_alone(
    tmp_path, faulty_lake, monkeypatch, is_of_others, n_steps
):
    """Of 20 steps, a run that fails within the 15th has saved 14."""
    monkeypatch.setattr(state_saver, "SHARE_OF_TIME", math.inf)  # it saves whenever it may
    monkeypatch.setattr(state_saver, "SHORTEST_INTERVAL", 0.0)
    steps = tmp_path / "steps"
    settings = {"n_timesteps": 20, "train_env_kwargs": {"path": str(steps)}}
    study = replace(
        study_of(n_seeds=1),
        environments=(EnvironmentSpec("counting", "Counting-v0", settings),),
        user_modules=faulty_lake,
        gym_packages=("faulty_lake",),
    )
    (planned,) = plan(study, tmp_path)
    draft = draft_path(tmp_path, planned)
    with pytest.raises(MemoryError):
        do_run(planned, draft, "")
    assert steps.stat().st_size == 15
    saved = [
        path for path in draft.rglob("*") if path.is_file() and path.read_bytes().startswith(MAGIC)
    ]
    for path in saved if is_of_others else ():
        with path.open("rb") as file:
            state = read_state(file, state_key())
        with path.open("wb") as file:
            write_state(file, state.content, {**state.note, SOURCES: "older"}, state_key())
    do_run(planned, draft, "")
    assert planned.is_finished
    assert steps.stat().st_size == 15 + n_steps


def test_every_run_is_told_of_and_failures_are_kept(faulty):
    child_processes.start_server()
    root, runs = faulty("", "library")
    log = failure_log(root, runs[0])
    log.parent.mkdir()
    log.write_text("of an earlier try")
    told = {}
    launchers = partial(local_launcher, root, "c", 2)
    (failure,) = execute(
        runs, root, launchers, lambda run, failure: told.update({run.path: failure})
    )
    assert told == {runs[0].path: None, runs[1].path: failure}
    assert (failure.planned, failure.reason) == (runs[1], "thin ice")
    assert failure.log == root / "failures" / "mine@lake_1_1.txt"
    # What an earlier try left of a run that has now been done is gone.
    assert list(log.parent.iterdir()) == [failure.log]
    assert failure.log.read_text().endswith("RuntimeError: thin ice\n")
    assert [run.is_finished for run in runs] == [True, False]
    assert not (root / ".drafts").exists()


class Exhausted:
    """A system that has none left of something."""

    def __init__(self, error):
        self.error = error

    def get_start_method(self):
        return "spawn"

    def Pipe(self, **options):  # noqa: N802  # as it is called in Python
        raise self.error


@pytest.mark.parametrize(
    "error", [EOFError("unexpected EOF"), BlockingIOError(errno.EAGAIN, "none left")]
)
def test_a_failure_whose_details_cannot_be_written_is_told(
    tmp_path, monkeypatch, small_disk, error
):
    monkeypatch.setattr(child_processes, "context", Exhausted(error))
    planned, _ = runs_of(tmp_path)
    with local_launcher(tmp_path, "c", 1) as launcher, small_disk(0):
        failure = launcher.submit(planned).result()
    assert failure.reason == f"its process could not be started: {error}"
    assert failure.log is None
    assert "Traceback" in failure.details


def test_nothing_to_do_starts_nothing(tmp_path):
    assert execute([], tmp_path, pytest.fail, pytest.fail) == []


class Growing:
    """Has no worker at first, and two from the moment on at which it has been given something."""

    n_workers = 0
    words = ""

    def __init__(self):
        self.given, self.most = [], 0

    def submit(self, planned):
        self.n_workers = 2
        future = Future()
        self.given.append(future)
        self.most = max(self.most, sum(not future.done() for future in self.given))
        threading.Timer(0.05, future.set_result, [None]).start()
        return future


def test_runs_are_handed_over_in_windows_as_wide_as_there_are_workers(tmp_path, monkeypatch):
    monkeypatch.setattr(launching, "SECONDS_BETWEEN_LOOKS", 0.01)
    runs, launcher, told, given_then = runs_of(tmp_path, n_seeds=12), Growing(), [], []

    def meanwhile():
        given_then.append(len(launcher.given))

    def listen(run, failure):
        told.append(run.seed)

    where = contextlib.nullcontext(launcher)
    assert execute(runs, tmp_path, lambda: where, listen, meanwhile) == []
    assert sorted(told) == list(range(12))
    assert launcher.most == 2 * WINDOW
    assert given_then == [WINDOW]  # once, after the first runs are handed over


def test_the_cores_that_this_process_may_use(monkeypatch):
    monkeypatch.setattr(os, "sched_getaffinity", lambda pid: {pid, 3, 5}, raising=False)
    assert available_cores() == 3
    monkeypatch.delattr(os, "sched_getaffinity")  # not on every system
    for known, expected in ((7, 7), (None, 1)):
        monkeypatch.setattr(os, "cpu_count", lambda known=known: known)
        assert available_cores() == expected


# --- Drafts: whose are left alone, and whose are cleared away or taken over.

HERE, RUN = platform.node(), "mine@dry_lake_1"
OWN = draft_path(Path(), runs_of(Path())[0]).name.partition("@")[0]
PLACE = OWN.rpartition("-")[2]


def draft_of(root, owner, machine=HERE, state=False, run=RUN):
    """A draft as a process has left it on that machine."""
    draft = root / ".drafts" / f"{owner}@{machine}@{run}"
    (draft / "inner").mkdir(parents=True)
    (draft / "inner" / "0.monitor.csv").write_text("half a li")
    if state:
        (draft / "state").mkdir()
        (draft / "state" / "odd.state").write_text("far")
    return draft


@pytest.fixture(scope="module")
def owners():
    """How drafts name processes of this machine: one that is gone, one at work, and others."""
    gone = subprocess.Popen([sys.executable, "-c", ""])
    assert gone.wait() == 0
    with subprocess.Popen([sys.executable, "-c", "input()"], stdin=subprocess.PIPE) as other:
        stat = Path(f"/proc/{other.pid}/stat").read_text()
        began = stat.rpartition(")")[2].split()[19]
        yield {
            "dead": f"{gone.pid}-1-{PLACE}",
            "dead too": f"{gone.pid}-2-{PLACE}",
            "alive": f"{other.pid}-{began}-{PLACE}",
            "its number before": f"{other.pid}-1-{PLACE}",
            "own": OWN,
            "elsewhere": "1-1-00000000",
            "nobody": "nobody",
        }
        other.communicate(b"\n")


@pytest.mark.parametrize(
    ("owner", "silent", "is_removed"),
    [
        ("dead", 0, True),
        ("its number before", 0, True),
        ("alive", 99, False),
        ("own", 99, False),
        # On another machine, or before the last boot, it counts as gone once it is silent.
        ("elsewhere", 0, False),
        ("elsewhere", 44, False),
        ("elsewhere", 46, True),
        ("nobody", 44, False),
        ("nobody", 46, True),
    ],
)
def test_what_a_dead_process_has_left_is_removed(tmp_path, owners, owner, silent, is_removed):
    machine = "far" if owner in ("elsewhere", "nobody") else HERE
    draft = draft_of(tmp_path, owners[owner], machine)
    then = draft.stat().st_mtime - silent
    os.utime(draft, (then, then))
    remove_dead_drafts(tmp_path)
    assert (draft / "inner" / "0.monitor.csv").is_file() != is_removed
    assert list(tmp_path.rglob("*dead*")) == []


def test_a_draft_is_kept_for_a_run_that_is_still_to_do(tmp_path, owners):
    draft = draft_of(tmp_path, owners["dead too"])
    remove_dead_drafts(tmp_path, {RUN})
    assert draft.is_dir()
    leave_drafts(tmp_path, RUN)
    assert not draft.exists()
    # One with a state waits for the next command.
    draft = draft_of(tmp_path, owners["dead"], state=True)
    remove_dead_drafts(tmp_path, {RUN})
    leave_drafts(tmp_path, RUN)
    assert draft.is_dir()
    remove_dead_drafts(tmp_path, {"mine@dry_lake_2"})
    # With the folders that are empty now, up to the study's own.
    assert not tmp_path.exists()


def test_the_next_process_takes_over_what_a_dead_one_has_left(tmp_path, owners):
    own = tmp_path / ".drafts" / f"{OWN}@{HERE}@{RUN}"
    assert not take_over(own)
    draft_of(tmp_path, owners["dead"], run="mine@dry_lake_2", state=True)
    draft_of(tmp_path, owners["alive"], state=True)
    outside = draft_of(tmp_path / "outside", owners["dead"], state=True)
    link = tmp_path / ".drafts" / outside.name
    link.symlink_to(outside)
    assert not take_over(own)
    assert not own.exists()
    link.unlink()
    stateless = draft_of(tmp_path, owners["dead too"])
    left = draft_of(tmp_path, owners["dead"], state=True)
    assert take_over(own)
    assert not left.exists()
    assert (own / "state" / "odd.state").read_text() == "far"
    # What holds no state says that the run was cut off before its first.
    remove_draft(own)
    assert take_over(own)
    assert not stateless.exists()
    assert own.is_dir()


@pytest.mark.parametrize("error", [FileNotFoundError, PermissionError])
def test_a_draft_that_cannot_be_renamed(tmp_path, owners, monkeypatch, error):
    """Another process was faster; or it is Windows, where somebody has a file of it open."""
    draft = draft_of(tmp_path, owners["dead"], state=True)

    def refuse(path, target):
        raise error(13, "is being used by another process", str(path))

    monkeypatch.setattr(Path, "replace", refuse)
    assert not take_over(draft.with_name(f"{OWN}@{HERE}@{RUN}"))
    remove_draft(draft)
    assert not draft.exists()


def test_a_draft_says_whose_it_is_however_long_the_labels_are(tmp_path):
    paths = [draft_path(tmp_path, run) for run in runs_of(tmp_path)]
    names = [f"{OWN}@{HERE}@mine@dry_lake_{number}" for number in (1, 2)]
    assert paths == [tmp_path / ".drafts" / name for name in names]
    study = study_of(environment=replace(LAKE, label="ä" * 90))
    study = replace(study, agents=(AgentSpec("ö" * 90, "qlearning"),))
    paths = [draft_path(tmp_path, run) for run in plan(study, tmp_path)]
    assert len({path.name for path in paths}) == 2
    drafts = [path.with_name(f"{path.name}.dead") for path in paths]
    for draft in drafts:
        claim_draft(draft)
    (tmp_path / "study.yml").touch()
    # To remove one leaves the others, and the study.
    for draft, n_left in ((drafts[0], 1), (drafts[1], 0), (drafts[1], 0)):
        remove_draft(draft)
        assert len([*tmp_path.rglob("*.dead")]) == n_left
    assert [path.name for path in tmp_path.iterdir()] == ["study.yml"]


def test_a_draft_is_a_new_folder_whatever_lies_there(tmp_path):
    """Its name can be told beforehand, and a link there would lead out."""
    outside, draft = tmp_path / "outside", tmp_path / "study" / ".drafts" / "1@here@mine@lake_1"
    outside.mkdir()
    (outside / "precious").touch()
    draft.parent.mkdir(parents=True)
    draft.symlink_to(outside)
    claim_draft(draft)
    assert draft.is_dir()
    assert not draft.is_symlink()
    assert [path.name for path in draft.parent.iterdir()] == [draft.name]
    (draft / "left over").touch()
    claim_draft(draft)
    assert list(draft.iterdir()) == []
    assert [path.name for path in outside.iterdir()] == ["precious"]
    (tmp_path / "a").touch()
    with pytest.raises(FileExistsError):
        claim_draft(tmp_path / "a" / "b")


@pytest.mark.parametrize(("n_times", "is_made"), [(3, True), (10**6, False)])
def test_a_folder_is_made_while_another_run_removes_the_one_above(
    tmp_path, monkeypatch, n_times, is_made
):
    tries, mkdir = [], Path.mkdir

    def vanishing(path, *args, **kwargs):
        tries.append(path)
        if len(tries) <= n_times:
            raise FileNotFoundError(path)
        mkdir(path, *args, **kwargs)

    monkeypatch.setattr(Path, "mkdir", vanishing)
    with contextlib.nullcontext() if is_made else pytest.raises(FileNotFoundError):
        claim_draft(tmp_path / "a" / "b")
    assert (tmp_path / "a" / "b").is_dir() == is_made


# --- Finished runs of other settings: named, kept, and moved aside when that is asked for.


@pytest.fixture(scope="module")
def finished(tmp_path_factory, do_study):
    root = tmp_path_factory.mktemp("done")
    do_study(study_of(), root)
    return root


@pytest.fixture
def done(finished, tmp_path):
    shutil.copytree(finished, tmp_path / "s")
    return tmp_path / "s"


def contents(folder):
    return {path.relative_to(folder): path.read_bytes() for path in folder.rglob("*.json")}


def test_other_settings_are_refused_by_name(done):
    before = contents(done)
    words = f"{done}: 2 finished runs have other settings (gamma: 0.995 there, 0.5 now): --name"
    with pytest.raises(UserError, match=f"^{re.escape(words)} .*, --replace "):
        check_settings_kept(runs_of(done, gamma=0.5), done)
    assert contents(done) == before
    study = study_of(gamma=0.5, learning_rate=0.2, initial_q=2.0)
    with pytest.raises(UserError, match=r"; and 2 more\)"):
        check_settings_kept(plan(replace(study, eval_freq=7, eval_episodes=3), done), done)


def test_what_is_moved_aside_is_whole_and_each_time_elsewhere(done, do_study):
    for n_seeds in (1, 2, 5):  # more or fewer seeds go without a word
        planned = runs_of(done, n_seeds=n_seeds)
        check_settings_kept(planned, done)
        assert move_replaced_aside(planned, done) == ([], None)
        assert [run.is_finished for run in planned] == [True, True, False, False, False][:n_seeds]
    before = contents(done / "runs")
    for number, gamma in enumerate((0.5, 0.6), start=1):
        planned = runs_of(done, gamma=gamma)
        assert move_replaced_aside(planned, done) == (planned, done / "replaced" / str(number))
        assert contents(done / "replaced" / str(number)) == before
        do_study(study_of(gamma=gamma), done)
        before = contents(done / "runs")


def test_a_batch_of_more_seeds_takes_the_place_of_one_of_fewer(tmp_path, do_study):
    batch = {"algo": "ucb", "environment": ARMS}
    do_study(study_of(**batch), tmp_path)
    planned = runs_of(tmp_path, **batch, n_seeds=3)
    check_settings_kept(planned, tmp_path)
    assert in_the_way(planned) == planned
    assert move_replaced_aside(planned, tmp_path) == (planned, tmp_path / "replaced" / "1")
    do_study(study_of(**batch), tmp_path)
    longer = replace(ARMS, settings={"n_timesteps": 30})
    with pytest.raises(UserError, match=r"1 finished run has other settings \(n_timesteps"):
        check_settings_kept(runs_of(tmp_path, algo="ucb", environment=longer), tmp_path)


def test_first_runs_with_checkpoints_take_the_place_of_those_without(done):
    planned = plan(replace(study_of(), render_every=2), done)
    check_settings_kept(planned, done)
    assert in_the_way(planned) == planned[:1]


def test_a_run_that_was_cut_off_is_kept_and_an_empty_folder_is_not(done):
    planned = runs_of(done, n_seeds=4)
    planned[0].run.update_info(state="interrupted")
    planned[2].path.mkdir()
    check_settings_kept(planned, done)
    assert move_replaced_aside(planned, done) == (planned[:1], done / "replaced" / "1")
    assert not planned[2].path.exists()


def test_another_driver_deletes_nothing_either(done):
    """Programs of a user's own take no lock, and come without being checked."""
    (run, _) = runs_of(done, gamma=0.5)
    before = contents(run.path)
    do_run(run, draft_path(done, run), "c")
    assert run.is_finished
    assert contents(done / "replaced" / "1" / "mine" / "dry_lake_1") == before


# --- How long a study may still take, held against simulated times.

# What a run takes by agent, in seconds; environments change it twofold.
TAKES = {"qlearning": 0.5, "sarsa": 0.6, "dqn": 40.0, "double_dqn": 90.0, "ppo": 25.0}
PLACES = {"FrozenLake-v1": 0.7, "FrozenLake8x8-v1": 1.0, "Taxi-v4": 1.4, "CliffWalking-v1": 1}


def runs_to_time(n_seeds):
    specs = tuple(AgentSpec(algo, algo) for algo in TAKES)
    places = tuple(EnvironmentSpec(name, name, {"n_timesteps": 9}) for name in PLACES)
    return plan(StudySpec("s", "S", specs, places, n_seeds=n_seeds), Path("nowhere"))


def played(runs, takes, n_workers, expected, shares):
    """The estimate by the truth, where so many of the runs have ended."""
    left, now, n_ended, estimates = TimeLeft(runs, expected), 0.0, 0, {}
    waiting, under_way = list(enumerate(runs)), []
    left.start(now, n_workers)
    for _ in range(n_workers):
        number, run = waiting.pop(0)
        heapq.heappush(under_way, (takes[number], number, run))
    while under_way:
        now, _, run = heapq.heappop(under_way)
        n_ended += 1
        left.end(run, now)
        left.start(now, n_workers)
        if waiting:
            number, run = waiting.pop(0)
            heapq.heappush(under_way, (now + takes[number], number, run))
        for share in shares:
            if share not in estimates and n_ended >= share * len(runs):
                estimates[share] = (now, left.seconds(now, n_workers))
    return {share: guess / (now - at) for share, (at, guess) in estimates.items()}


@pytest.mark.parametrize("n_workers", [1, 2, 8])
@pytest.mark.parametrize("off", [0.6, 1.7, 4.0])
def test_after_a_tenth_of_the_runs_it_is_right_within_a_factor_of_two(n_workers, off):
    """Also where all take more or less than was expected, as on a busy machine."""
    for seed, runs in enumerate((runs_to_time(3), runs_to_time(10))):
        rng = np.random.default_rng(seed)
        usual = [TAKES[run.agent] * PLACES[run.environment] for run in runs]
        takes = [time * rng.uniform(0.8, 1.25) for time in usual]
        expected = {
            (run.agent, run.environment): time / off * rng.uniform(0.8, 1.25)
            for run, time in zip(runs, usual, strict=True)
        }
        found = played(runs, takes, n_workers, expected, (0.1, 0.25, 0.5))
        assert all(0.5 < ratio < 2 for ratio in found.values()), found


def test_expectations_go_by_agent_and_budget():
    table, network = runs_to_time(1)[0].spec, runs_to_time(1)[2].spec
    assert (table.algo, network.algo) == ("qlearning", "dqn")
    assert expected_seconds(table) < expected_seconds(network) < expected_seconds(network, 60.0)


def test_nothing_is_said_while_an_agent_of_the_users_has_not_ended_a_run(monkeypatch):
    """Nobody knows whether it is compiled."""
    monkeypatch.setitem(ALGORITHMS, "own", AlgorithmEntry("own:Own", "own"))
    runs = [replace(run, spec=replace(run.spec, algo="own")) for run in runs_to_time(3)[:12]]
    left = TimeLeft(runs, {})
    left.start(0.0, 1)
    assert left.seconds(1.0, 1) is None
    for n, run in enumerate(runs, start=1):
        left.end(run, 2.0 * n)
        left.start(2.0 * n, 1)
    assert left.seconds(24.0, 1) == pytest.approx(0.0)


# --- What is compiled once for a study: rules of the user's own, and nothing else.


@inlined
def mean_value(agent, env, progress, table):
    """The mean value of the next actions."""
    return agent.room.values.mean()


class Mean(TabularAlgorithm):
    next_value = mean_value


class Other(agents.load_algorithm("dqn")):
    """One that is not compiled."""


MODULES = (UserModule("gymnasium", "gymnasium"),)


@pytest.fixture
def with_rules(tmp_path):
    before = dict(ALGORITHMS)
    for cls in (Mean, Other):
        agents.register(cls.__name__.lower(), f"{__name__}:{cls.__name__}")
    specs = tuple(AgentSpec(a, a, {"n_episodes": 50}) for a in ("mean", "other", "qlearning"))
    places = tuple(EnvironmentSpec(name, name) for name in ("FrozenLake-v1", "Warehouse-v0"))
    yield plan(StudySpec("s", "s", specs, places, n_seeds=2, user_modules=MODULES), tmp_path)
    ALGORITHMS.clear()
    ALGORITHMS.update(before)


def test_each_rule_of_the_users_is_compiled_once_on_each_environment(with_rules, monkeypatch):
    places = [("mean", "FrozenLake-v1"), ("mean", "Warehouse-v0")]
    wanted = json.loads(warm_ups(with_rules))
    assert [(item["algo"], item["env_id"]) for item in wanted] == places
    trained = []
    monkeypatch.setattr(run_in_child, "train_aside", trained.append)  # it would compile for seconds
    take_steps(json.dumps([{"algo": "no_such", "modules": []}, {}, *wanted]))
    assert [(spec.algo, spec.env_id) for spec in trained] == places
    budgets = {(spec.hyperparams.n_timesteps, spec.hyperparams.n_episodes) for spec in trained}
    assert budgets == {(run_in_child.N_STEPS, None)}
    assert {spec.user_modules for spec in trained} == {MODULES}
    # Without modules of the user's there is nothing to do, nor where they are too many to say.
    bare = [replace(run, spec=replace(run.spec, user_modules=())) for run in with_rules]
    assert json.loads(warm_ups(bare)) == []
    monkeypatch.setattr(run_in_child, "MAX_CHARACTERS", 10)
    assert json.loads(warm_ups(with_rules)) == []
