"""Runs in processes of their own: what fails, is killed, takes too long or is stopped."""

import io
import json
import os
import shutil
import signal
import threading
import time
from pathlib import Path

import pytest
from rich.console import Console

from rl_yardstick.experiments.plan import plan
from rl_yardstick.experiments.pool import ERROR_FILE, Workers, do_aside, do_run, do_runs
from rl_yardstick.experiments.results import read_results
from rl_yardstick.experiments.study import AgentSpec, EnvironmentSpec, StudySpec
from rl_yardstick.pipeline.components import import_modules
from rl_yardstick.pipeline.errors import Stopped, UserError
from rl_yardstick.pipeline.run import FAILED, FINISHED, INTERRUPTED, Run, Stop, versions


@pytest.fixture
def walk(own_folder):
    """Plans runs on the user's environment, one for each seed."""
    shutil.copy(Path(__file__).with_name("walks.py"), own_folder)
    import_modules(["walks"])

    def planned(*seeds, n_timesteps=300):
        agents = (AgentSpec("sarsa", "sarsa", {"engine": "interpreted"}, tuned=False),)
        place = EnvironmentSpec("Walk-v0", "Walk-v0", {"n_timesteps": n_timesteps})
        study = StudySpec("s", "S", agents, (place,), 10, gym_packages=("walks",), eval_freq=300)
        return study, [run for run in plan(study, own_folder / "s") if run.seed in seeds]

    return planned


def done(runs, n_at_once=2, timeout=None, stop=None):
    """The reasons of failures by seed, and what was told."""
    console = Console(record=True, file=io.StringIO(), width=300)
    with Workers(n_at_once, timeout) as workers:
        failures = do_runs(runs, workers, "compare.py", console, stop or Stop())
    seeds = {run.path: run.seed for run in runs}
    return {seeds[path]: reason for path, reason in failures.items()}, console.export_text()


def states(runs):
    return [run.recorded().get("state") for run in runs]


def test_each_run_ends_for_itself_alone(walk):
    study, runs = walk(0, 1, 2, 4)
    failures, told = done(runs)
    assert states(runs) == [FINISHED, FAILED, INTERRUPTED, FINISHED]
    assert failures.keys() == {1, 2}
    assert failures[1] == f"thin ice; see {runs[1].path / ERROR_FILE}"
    assert "in step" in (runs[1].path / ERROR_FILE).read_text()
    assert failures[2].startswith("its process died with code")
    assert "failed: sarsa on Walk-v0, seed 1: thin ice" in told
    assert "4 of 4 runs in" in told
    results = read_results(study, runs, runs[0].path.parents[2])
    assert results.summary["seed"].tolist() == [0, 4]


def test_a_run_that_takes_too_long_goes_on_later(walk, own_folder):
    _, (run,) = walk(3, n_timesteps=5000)
    failures, _ = done([run], timeout=6.0)
    assert failures == {3: "took longer than --run-timeout allows, 6 s"}
    assert states([run]) == [INTERRUPTED]
    assert (run.path / "state.bin").exists()
    (own_folder / "mark").touch()
    assert done([run])[0] == {}
    assert states([run]) == [FINISHED]
    assert not (run.path / "state.bin").exists()


def test_a_stop_leaves_no_run_running(walk):
    _, runs = walk(3, 4, 5, n_timesteps=20_000)
    stop = Stop()

    def signal_comes():
        while not (runs[0].path / "0.monitor.csv").exists():
            time.sleep(0.02)
        time.sleep(0.5)
        stop.number = signal.SIGTERM

    threading.Thread(target=signal_comes).start()
    with pytest.raises(Stopped):
        done(runs, n_at_once=1, stop=stop)
    assert states(runs) == [INTERRUPTED, None, None]


def test_what_an_earlier_attempt_left_is_resumed_or_removed(tmp_path):
    place = EnvironmentSpec("lake", "FrozenLake-v1", {"n_timesteps": 3000})
    agents = (AgentSpec("sarsa", "sarsa", {"engine": "interpreted"}),)
    study = StudySpec("s", "S", agents, (place,), 1)
    (whole,), (run,) = (plan(study, tmp_path / name) for name in ("whole", "cut"))
    whole.path.mkdir(parents=True)
    with Run(whole.path), pytest.raises(UserError, match="in use by another command"):
        do_run(whole)
    do_run(whole)
    stop = Stop()
    stop.number = signal.SIGTERM
    with pytest.raises(Stopped):
        do_run(run, stop=stop)
    assert states([run]) == [INTERRUPTED]
    state = (run.path / "state.bin").read_bytes()
    (run.path / "of-an-earlier-attempt").touch()
    do_run(run)
    assert (run.path / "of-an-earlier-attempt").exists()  # it was resumed
    do_run(run)  # it is finished
    clocks = ["seconds", "cpu_seconds", "path"]
    one, other = (read_results(study, [each], tmp_path).summary for each in (whole, run))
    assert one.drop(columns=clocks).equals(other.drop(columns=clocks))
    # A state of other versions, or of other settings, is of no use.
    record = run.recorded()
    for changes in (
        {"versions": {**versions(), "torch": "0.1"}},
        {"spec": {**record["spec"], "n_timesteps": 2999}},
    ):
        (run.path / "run.json").write_text(json.dumps({**record, "state": INTERRUPTED, **changes}))
        (run.path / "state.bin").write_bytes(state)
        (run.path / "of-an-earlier-attempt").touch()
        do_run(run)
        assert run.is_finished
        assert not (run.path / "of-an-earlier-attempt").exists()


def test_a_function_is_called_in_another_process():
    assert do_aside(os.getpid) != os.getpid()
