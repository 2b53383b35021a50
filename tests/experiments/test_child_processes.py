"""Work in child processes: what comes back, what is tried again, shared, limited, left behind."""

import mmap
import multiprocessing
import os
import runpy
import signal
import subprocess
import sys
import time
from dataclasses import replace
from functools import partial
from pathlib import Path

import pytest
from rl_yardstick.experiments.child_processes import (
    StoppedError,
    TaskDiedError,
    TaskFailedError,
    local_executor,
    stop_all,
    supervise,
)
from rl_yardstick.experiments.launching import execute, local_launcher
from rl_yardstick.experiments.run_folders import draft_path
from rl_yardstick.experiments.run_in_child import do_run
from rl_yardstick.experiments.run_limits import RunLimits, memory, resident_memory, seconds
from rl_yardstick.pipeline.settings.hyperparams import ComponentSpec
from rl_yardstick.pipeline.train_spec import is_plain

import compare
from rl_yardstick.experiments import child_processes
from rl_yardstick.experiments.plan import plan
from rl_yardstick.experiments.study import AgentSpec, EnvironmentSpec, StudySpec

ROOT = Path(compare.__file__).parent

# What the children are to do; they import it by its name.
CHORES = """
import ctypes, os, signal, time
from pathlib import Path

def who(*_):
    return os.getpid()

def add(first, second):
    return first + second, os.getpid(), os.environ["OMP_NUM_THREADS"]

def fail(words):
    raise ValueError(words)

def die(folder, times):
    tries = len(list(Path(folder).glob("try_*")))
    (Path(folder) / f"try_{os.getpid()}").touch()
    if tries < times:
        os.kill(os.getpid(), signal.SIGKILL)
    return os.getpid()

def leave(code):
    os._exit(code)

def wait(folder):
    (Path(folder) / f"waiting_{os.getpid()}").touch()
    time.sleep(600)

def interrupt_itself():
    for number in (signal.SIGINT, signal.SIGTERM, signal.SIGHUP):
        os.kill(os.getpid(), number)
    time.sleep(0.05)
    return "still here"

def end_program(words):
    raise KeyboardInterrupt(words)

def crash():
    ctypes.string_at(0)

def clean_up(folder):
    with (Path(folder) / "cleaned").open("a") as file:
        file.write(".")
"""


@pytest.fixture(autouse=True)
def ready():
    """Another test may have stopped everything; and none may leave anything behind."""
    child_processes.start_server()
    yield
    with local_executor(1):
        pass
    assert multiprocessing.active_children() == []


@pytest.fixture
def chores(tmp_path, monkeypatch):
    (tmp_path / "study_chores.py").write_text(CHORES)
    monkeypatch.syspath_prepend(tmp_path)
    import study_chores

    yield study_chores
    monkeypatch.delitem(sys.modules, "study_chores")


def nothing():
    pass


alone = partial(supervise, clean_up=nothing)
shared = partial(supervise, clean_up=nothing, shares_process=True)


def is_alive(pid):
    status = Path(f"/proc/{pid}/stat")
    return status.exists() and status.read_text().rpartition(")")[2].split()[0] != "Z"


def wait_for(condition, seconds=60):
    deadline = time.monotonic() + seconds
    while not condition():
        assert time.monotonic() < deadline
        time.sleep(0.02)


def waiting_in(folder):
    return [int(path.name.partition("_")[2]) for path in folder.glob("waiting_*")]


# The chore and what it is given, options, what is said in a line, and what at length.
SEGMENTATION = ("Fatal Python error: Segmentation fault", "in crash\n")
TIMED = {"limits": RunLimits(seconds=0.5)}
TOOK_LONGER = "took longer than --run-timeout allows, 0.5 s"
FAULTS = {
    "an exception": ("fail", ["too\n  hot"], {"tries": 3}, "too hot", ["ValueError: too\n  hot\n"]),
    "interrupt": ("end_program", ["a\n b"], {}, "KeyboardInterrupt: a b", ["Traceback"]),
    "killed": ("die", [".", 9], {}, "its process died 2 times (SIGKILL)", ["SIGKILL, 2 times\n"]),
    "leaving": ("leave", [3], {"tries": 1}, "its process died 1 times (exit code 3)", ()),
    "a crash": ("crash", [], {"tries": 1}, "its process died 1 times (SIGSEGV)", SEGMENTATION),
    "time": ("wait", ["."], TIMED, TOOK_LONGER, ["in wait\n", f"{TOOK_LONGER}\n"]),
}


@pytest.mark.parametrize("fault", FAULTS)
def test_faults(chores, tmp_path, fault):
    name, given_to, options, reason, details = FAULTS[fault]
    given_to = [str(tmp_path) if each == "." else each for each in given_to]
    clean_up = partial(chores.clean_up, str(tmp_path))
    with pytest.raises(TaskFailedError) as error:
        supervise(getattr(chores, name), *given_to, clean_up=clean_up, **options)
    assert str(error.value) == reason
    assert all(words in error.value.details for words in details)
    assert "Extension modules" not in error.value.details
    has_died = reason.startswith("its process died")
    assert isinstance(error.value, TaskDiedError) == has_died
    # Only a process that dies is tried again; after each try there is cleaned up.
    n_tries = options.get("tries", 2) if has_died else 1
    assert (tmp_path / "cleaned").read_text() == "." * n_tries


def test_leaving_early_ends_the_children(chores, tmp_path):
    clean_up = partial(chores.clean_up, str(tmp_path))
    outcomes = []

    def run_and_leave():
        with local_executor(2) as executor:
            wait = partial(supervise, chores.wait, str(tmp_path), clean_up=clean_up)
            outcomes.extend(executor.submit(wait) for _ in range(3))
            wait_for(lambda: len(waiting_in(tmp_path)) == 2)
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        run_and_leave()
    assert not any(map(is_alive, waiting_in(tmp_path)))
    assert (tmp_path / "cleaned").read_text() == ".."
    assert [type(future.exception()) for future in outcomes[:2]] == [StoppedError] * 2
    assert outcomes[2].cancelled()
    # The next block starts afresh; after its end nothing is started.
    with local_executor(1) as executor:
        assert executor.submit(alone, chores.add, 1, 1).result()[0] == 2
        stop_all()
        assert isinstance(executor.submit(alone, chores.add, 1, 1).exception(), StoppedError)


def test_signals_of_a_whole_group_do_not_reach_the_children(chores):
    """The terminal sends Ctrl-C to all; what it means is decided above."""
    assert alone(chores.interrupt_itself, tries=1) == "still here"
    # Programs that a task starts can be ended as usual.
    assert alone(subprocess.getoutput, "kill $$; echo still here") == ""


# A supervisor of its own, which is to be killed.
DRIVER = """
import multiprocessing, sys
from functools import partial
import study_chores
from rl_yardstick.experiments import child_processes

if __name__ == "__main__":
    method, folder = sys.argv[1:]
    child_processes.PRELOADED.clear()
    child_processes.context = multiprocessing.get_context(method)
    child_processes.supervise(
        study_chores.wait, folder, clean_up=partial(study_chores.clean_up, folder)
    )
"""


@pytest.mark.usefixtures("chores")
@pytest.mark.parametrize("method", ["forkserver", "spawn"])  # of Linux; of Windows and macOS
def test_a_child_ends_with_its_supervisor_and_cleans_up(tmp_path, method):
    (tmp_path / "driver.py").write_text(DRIVER)
    paths = os.pathsep.join([str(tmp_path), *filter(None, sys.path)])
    command = [sys.executable, str(tmp_path / "driver.py"), method, str(tmp_path)]
    with subprocess.Popen(command, env={**os.environ, "PYTHONPATH": paths}) as process:
        wait_for(lambda: waiting_in(tmp_path))
        process.kill()
    (pid,) = waiting_in(tmp_path)
    wait_for(lambda: not is_alive(pid))
    assert (tmp_path / "cleaned").read_text() == "."


# --- Tasks that share a process.


def test_which_tasks_share_a_process(chores, tmp_path):
    with local_executor(1) as executor:
        ask = [executor.submit(shared, chores.who) for _ in range(3)]
        assert len({each.result() for each in ask}) == 1
        by_itself = executor.submit(alone, chores.who).result()
        limited = executor.submit(shared, chores.who, limits=RunLimits(memory=10**12)).result()
        assert len({ask[0].result(), by_itself, limited}) == 3
    # After a fault, and after its process was killed while it waited, the next begins afresh.
    pids = [shared(chores.who)]
    with pytest.raises(TaskFailedError, match="thin ice"):
        shared(chores.fail, "thin ice")
    pids += [shared(chores.who), shared(chores.die, str(tmp_path), 1)]  # it is tried again
    os.kill(pids[-1], signal.SIGKILL)
    wait_for(lambda: multiprocessing.active_children() == [])
    assert len({*pids, shared(chores.who, tries=1)}) == 4


# --- Runs that share a process: to the same bits, and which those are.

SMALL = {"engine": "compiled", "policy_kwargs": {"net_arch": [8]}}
CLIPPED = ComponentSpec("gymnasium.wrappers.ClipReward", {"min_reward": 0, "max_reward": 0.5})
AGENTS = {
    "qlearning": {},
    "ppo": {**SMALL, "n_steps": 64, "n_envs": 2},
    "dqn": {**SMALL, "learning_starts": 50, "buffer_size": 300, "batch_size": 16},
}


def runs_of(root):
    specs = [AgentSpec(algo, algo, settings, tuned=False) for algo, settings in AGENTS.items()]
    lake = EnvironmentSpec("lake", "FrozenLake-v1", {"n_timesteps": 300})
    return plan(StudySpec("s", "S", tuple(specs), (lake,), n_seeds=2), root)


def test_runs_in_one_process_leave_what_each_leaves_alone(tmp_path):
    """Of the last seed, whose runs come after all others."""
    contents = runpy.run_path(str(ROOT / "benchmarks/_run_contents.py"))["contents"]
    root = tmp_path / "together"
    together, others = runs_of(root), runs_of(tmp_path / "alone")[len(AGENTS) :]
    root.mkdir()
    assert not execute(together, root, partial(local_launcher, root, "c", 1), lambda *_: None)
    for mine, its in zip(together[len(AGENTS) :], others, strict=True):
        alone(do_run, its, draft_path(tmp_path / "alone", its), "c")
        assert is_plain(mine.spec)
        assert mine.run.read_info()["engine"] == "compiled"
        ours, theirs = contents(mine.path), contents(its.path)
        assert {name: repr(ours[name]) for name in ours} == {n: repr(theirs[n]) for n in theirs}


HYPERPARAMS = runs_of(Path("x"))[0].spec.hyperparams
NOT_PLAIN = [
    {"gym_packages": ("mine",)},
    {"trained_agent": Path("a.zip")},
    {"vec_env": "subproc"},
    *(
        {"hyperparams": replace(HYPERPARAMS, **{name: value})}
        for name, value in (
            ("callback", "mine.Callback"),
            ("env_wrapper", "mine.Wrapper"),
            ("train_env_wrapper", (ComponentSpec("mine.Wrapper"),)),
            ("normalize", {}),
        )
    ),
    # Networks share a process in our engines alone.
    {"algo": "ppo", "hyperparams": replace(HYPERPARAMS, algorithm={"engine": "library"})},
]


@pytest.mark.parametrize("changes", NOT_PLAIN)
def test_what_a_run_must_not_share_its_process_with(changes):
    spec = runs_of(Path("x"))[0].spec
    assert not is_plain(replace(spec, **changes))
    clipped = replace(HYPERPARAMS, train_env_wrapper=(CLIPPED,))
    assert is_plain(replace(spec, hyperparams=clipped))


# --- Limits: how they are written, and what a process takes.


TIMES = {"90": 90, "0.5 s": 0.5, "10m": 600, "10min": 600, "1.5h": 5400, "2D": 172800, "4": 4}
SIZES = {"4gb": 4e9, "1.5 GB": 1.5e9, "500MB": 5e8, "4GiB": 2**32, "5000000": 5e6}
NEITHER = ("", "0", "-1", "nan", "1e3s", "10 parsecs", "m", "10m5", "\u0663m", "9" * 40)


def test_times_and_sizes():
    for read, values, refused in ((seconds, TIMES, NEITHER), (memory, SIZES, (*NEITHER, "4"))):
        assert {text: read(text) for text in values} == values
        for text in refused:
            with pytest.raises(ValueError, match=r"must be a (time|size)"):
                read(text)
    assert isinstance(memory("1MB"), int)


@pytest.mark.parametrize(
    ("limits", "elapsed", "words"),
    [
        ({}, 1e9, ""),
        ({"seconds": 5}, 5, ""),
        ({"seconds": 5}, 5.1, "took longer than --run-timeout allows, 5 s"),
        ({"memory": 2 * 10**6}, 3, "of memory after 3 s; --run-memory allows 2 MB"),
        ({"is_wanted": lambda: False}, 1, "nobody waits for it any more"),
    ],
)
def test_which_limit_is_exceeded(limits, elapsed, words):
    told = RunLimits(**limits).exceeded(os.getpid(), elapsed)
    assert words in told
    assert bool(told) == bool(words)


def test_the_memory_that_a_process_takes():
    before = resident_memory(os.getpid())
    # Of the system: what Python asks for may be memory that this process has had before.
    with mmap.mmap(-1, 50_000_000) as kept:
        for start in range(0, len(kept), mmap.PAGESIZE):
            kept[start] = 1
        assert 45e6 < resident_memory(os.getpid()) - before < 60e6
    assert resident_memory(2**31 - 2) == 0
