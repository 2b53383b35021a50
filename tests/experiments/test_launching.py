"""Doing the runs of a study: drafts, faults, order, time left; and runs that are in the way."""

import math
import os
import platform
import shutil
import subprocess
import sys
from dataclasses import replace
from functools import partial
from pathlib import Path

import gymnasium as gym
import pytest
from rl_yardstick.experiments.launching import (
    BUSY,
    TimeLeft,
    execute,
    failure_log,
    local_launcher,
)
from rl_yardstick.experiments.run_folders import (
    check_settings_kept,
    draft_path,
    in_the_way,
    leave_drafts,
    move_replaced_aside,
    remove_dead_drafts,
    remove_draft,
    run_name,
    take_over,
)
from rl_yardstick.experiments.run_in_child import do_run
from rl_yardstick.pipeline.state_files import SOURCES, read_state, state_key, write_state
from rl_yardstick.pipeline.user_modules import import_typed

from rl_yardstick.experiments import child_processes
from rl_yardstick.experiments.plan import plan
from rl_yardstick.experiments.study import AgentSpec, EnvironmentSpec, StudySpec
from rl_yardstick.pipeline import state_saver
from rl_yardstick.pipeline.errors import UserError

LAKE = EnvironmentSpec("dry lake", "FrozenLake-v1", {"n_timesteps": 20})
ARMS = EnvironmentSpec("arms", "BernoulliBandit-v0", {"n_timesteps": 20})


def study_of(algo="qlearning", environment=LAKE, n_seeds=2, tensorboard=False, **settings):
    agent = AgentSpec("mine", algo, settings)
    return StudySpec("s", "S", (agent,), (environment,), n_seeds=n_seeds, tensorboard=tensorboard)


def runs_of(root, **fields):
    return plan(study_of(**fields), root)


# --- One run.


def test_a_run_stands_in_its_place_once_with_its_own_log(tmp_path):
    _, planned = runs_of(tmp_path, tensorboard=True)
    draft, old = draft_path(tmp_path, planned), planned.spec.tensorboard_log / "of an earlier try"
    old.mkdir(parents=True)
    do_run(planned, draft, "compare.py s.yml")
    assert planned.is_finished
    assert not draft.exists()
    assert not old.exists()
    assert list(old.parent.rglob("events.out.tfevents.*"))
    assert "compare.py s.yml" in (planned.run.params_path / "command.txt").read_text()
    # Another process was faster: what it has done stays.
    (planned.path / "mark").touch()
    do_run(planned, draft, "again")
    assert (planned.path / "mark").exists()


# An environment that counts its steps in a file, and fails within the fourth as it is told.
COUNTING = """
import errno, gymnasium as gym
from rl_yardstick.pipeline.errors import UserError

FAULTS = {
    "disk": (UserError("the disk takes no more"), OSError(errno.ENOSPC, "No space left on device")),
    "memory": (MemoryError(), None),
    "library": (RuntimeError("thin ice"), None),
}

class Counting(gym.Env):
    observation_space = action_space = gym.spaces.Discrete(2)

    def __init__(self, fault="", path=""):
        self.fault, self.path = fault, path

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        return 0, {}

    def step(self, action):
        if self.fault:
            with open(self.path, "a") as steps:
                steps.write(".")
                if steps.tell() == 4:
                    error, cause = FAULTS[self.fault]
                    raise error from cause
        return 0, 0.0, False, False, {}

gym.register("Counting-v0", Counting, max_episode_steps=4)
"""


@pytest.fixture(scope="module")
def counting_module(tmp_path_factory):
    path = tmp_path_factory.mktemp("own") / "counting_steps.py"
    path.write_text(COUNTING)
    yield import_typed([str(path)])
    del gym.registry["Counting-v0"], sys.modules["counting_steps"]


@pytest.fixture
def counting(tmp_path, counting_module):
    """Runs of six steps each that fail so, or not at all."""

    def runs(*faults):
        places = [
            EnvironmentSpec(
                f"place {n}",
                "Counting-v0",
                {
                    "n_timesteps": 6,
                    "train_env_kwargs": {"fault": fault, "path": str(tmp_path / f"steps {n}")},
                },
            )
            for n, fault in enumerate(faults)
        ]
        study = replace(study_of(n_seeds=1), environments=tuple(places))
        study = replace(study, user_modules=counting_module, gym_packages=("counting_steps",))
        return plan(study, tmp_path / "study")

    return runs


@pytest.mark.parametrize(
    ("fault", "is_of_others", "n_steps"),
    [("disk", False, 3), ("memory", True, 6), ("library", False, 6)],
)
def test_a_run_goes_on_where_another_try_may_help_from_states_of_its_own_sources(
    tmp_path, counting, monkeypatch, fault, is_of_others, n_steps
):
    """A run that fails within the fourth step has saved three; each state takes long."""
    monkeypatch.setattr(state_saver, "SHARE_OF_TIME", math.inf)  # it saves whenever it may
    monkeypatch.setattr(state_saver, "SHORTEST_INTERVAL", 0.0)
    (planned,), steps = counting(fault), tmp_path / "steps 0"
    draft = draft_path(tmp_path / "study", planned)
    with pytest.raises(Exception, match=r".*"):
        do_run(planned, draft, "")
    assert steps.stat().st_size == 4
    leave_drafts(tmp_path / "study", run_name(planned))
    assert draft.exists() == (fault != "library")
    for path in draft.rglob("*.state") if is_of_others else ():
        with path.open("rb") as file:
            state = read_state(file, state_key())
        with path.open("wb") as file:
            write_state(file, state.content, {**state.note, SOURCES: "older"}, state_key())
    do_run(planned, draft, "")
    assert planned.is_finished
    assert steps.stat().st_size == 4 + n_steps


def test_every_run_is_told_of_and_failures_are_kept(tmp_path, counting):
    child_processes.start_server()
    root, runs = tmp_path / "study", counting("", "library")
    log = failure_log(root, runs[0])
    log.parent.mkdir(parents=True)
    log.write_text("of an earlier try")
    told = {}
    launchers = partial(local_launcher, root, "c", 2)
    (failure,) = execute(
        runs, root, launchers, lambda run, failure: told.update({run.path: failure})
    )
    assert told == {runs[0].path: None, runs[1].path: failure}
    assert (failure.planned, failure.reason) == (runs[1], "thin ice")
    # What an earlier try left of a run that has now been done is gone.
    assert list(log.parent.iterdir()) == [failure.log]
    assert failure.log.read_text().endswith("RuntimeError: thin ice\n")
    assert [run.is_finished for run in runs] == [True, False]
    assert not (root / ".drafts").exists()


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
        }
        other.communicate(b"\n")


OWNERS = [
    ("dead", 0, True),
    ("its number before", 0, True),
    ("alive", 99, False),
    ("own", 99, False),
    # On another machine, or before the last boot, it counts as gone once it is silent.
    ("elsewhere", 44, False),
    ("elsewhere", 46, True),
]


@pytest.mark.parametrize(("owner", "silent", "is_removed"), OWNERS)
def test_what_a_dead_process_has_left_is_removed(tmp_path, owners, owner, silent, is_removed):
    machine = "far" if owner == "elsewhere" else HERE
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
    assert not take_over(own)
    assert not own.exists()
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


def test_what_is_moved_aside_is_whole_and_each_time_elsewhere(done, do_study):
    empty = done / "runs" / "mine" / "dry_lake_3"
    empty.mkdir()  # which is not kept
    for n_seeds in (1, 2, 5):  # more or fewer seeds go without a word
        planned = runs_of(done, n_seeds=n_seeds)
        check_settings_kept(planned, done)
        assert move_replaced_aside(planned, done) == ([], None)
        assert [run.is_finished for run in planned] == [True, True, False, False, False][:n_seeds]
    assert not empty.exists()
    before = contents(done / "runs")
    for number, gamma in enumerate((0.5, 0.6), start=1):
        planned = runs_of(done, gamma=gamma)
        assert move_replaced_aside(planned, done) == (planned, done / "replaced" / str(number))
        assert contents(done / "replaced" / str(number)) == before
        do_study(study_of(gamma=gamma), done)
        before = contents(done / "runs")


def test_a_batch_of_more_seeds_takes_the_place_of_one_of_fewer(tmp_path, do_study):
    batch = {"algo": "ucb", "environment": ARMS}
    first = do_study(study_of(**batch), tmp_path)
    planned = runs_of(tmp_path, **batch, n_seeds=3)
    check_settings_kept(planned, tmp_path)
    assert in_the_way(planned) == planned
    assert move_replaced_aside(planned, tmp_path) == (planned, tmp_path / "replaced" / "1")
    more = do_study(study_of(**batch, n_seeds=3), tmp_path)
    assert more.summary["regret"].tolist()[:2] == first.summary["regret"].tolist()
    assert len(more.summary) == 3
    assert planned[0].is_finished
    assert list((tmp_path / ".drafts").iterdir()) == []
    longer = replace(ARMS, settings={"n_timesteps": 30})
    with pytest.raises(UserError, match=r"1 finished run has other settings \(n_timesteps"):
        check_settings_kept(runs_of(tmp_path, algo="ucb", environment=longer), tmp_path)


@pytest.mark.parametrize("change", ["cut off", "checkpoints"])
def test_what_is_in_the_way_of_a_run_is_kept(done, change):
    """Also by programs of a user's own, which take no lock and come without being checked."""
    planned = plan(replace(study_of(), render_every=2 if change == "checkpoints" else 0), done)
    if change == "cut off":
        planned[0].run.update_info(state="interrupted")
    else:
        assert in_the_way(planned) == planned[:1]
    before = contents(planned[0].path)
    do_run(planned[0], draft_path(done, planned[0]), "c")
    assert planned[0].is_finished
    assert contents(done / "replaced" / "1" / "mine" / "dry_lake_1") == before


# --- How long a study may still take.


@pytest.mark.parametrize(("n_workers", "off"), [(1, 4.0), (4, 0.6)])
def test_after_a_tenth_of_the_runs_the_time_left_is_right_within_a_factor_of_two(n_workers, off):
    """Also where all take more or less than was expected, as on a busy machine."""
    runs = runs_of(Path("nowhere"), n_seeds=40)
    left = TimeLeft(runs, {("mine", "dry lake"): 10.0 / off})
    left.start(0.0, n_workers)
    for n_ended, run in enumerate(runs[: len(runs) // 2], start=1):
        now = 10.0 * math.ceil(n_ended / n_workers)  # each takes 10 s
        left.end(run, now)
        left.start(now, n_workers)
        if n_ended >= 4 and n_ended % n_workers == 0:
            truth = 10.0 * (len(runs) - n_ended) / n_workers
            assert 0.5 < left.seconds(now, n_workers) / truth < 2


def test_what_is_expected_of_an_agent_is_corrected_by_its_own_runs_else_by_its_kind():
    """Of 10 s each, Q-learning took 20 and SARSA 80; DQN is of another kind."""
    algos = {"one": "qlearning", "two": "sarsa", "three": "qlearning", "four": "r_max"}
    agents = tuple(AgentSpec(label, algo) for label, algo in {**algos, "five": "dqn"}.items())
    runs = plan(StudySpec("s", "S", agents, (LAKE,), n_seeds=1), Path("nowhere"))
    left = TimeLeft(runs, dict.fromkeys((run.labels for run in runs), 10.0))
    now = 0.0
    for run, seconds in zip(runs, (20, 80), strict=False):
        left.start(now, 1)
        now += seconds
        left.end(run, now)
    # The third as the first, the fourth as both, the last as a busy machine would have it.
    both = (2 + 8) / 2
    busy = (min(2, BUSY) + min(8, BUSY)) / 2
    assert left.seconds(now, 1) == pytest.approx(10 * (2 + both + busy))
