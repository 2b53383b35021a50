"""What is said of a run that seldom occurs, and of how far a study is."""

import io
import sys
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
from rich.console import Console

from commands import compare, terminal
from commands.compare import StudyProgress
from commands.terminal import TextConsole
from commands.train import print_outcome
from experiments.launching import RunFailure
from experiments.plan import plan
from experiments.study import AgentSpec, EnvironmentSpec, StudySpec
from machine_code import WorkTime
from pipeline import signs_of_life
from pipeline.evaluation.sampled import Evaluation
from pipeline.runs import Run
from pipeline.settings.hyperparams import split
from pipeline.train_spec import TrainSpec


def test_a_run_in_words(monkeypatch):
    """What is printed of whole runs is recorded in ``tests/golden``; here, what seldom happens."""
    monkeypatch.setattr(sys, "argv", ["train.py"])
    outcome = SimpleNamespace(
        run=Run(Path("logs/qlearning/Lake-v1_3"), "Lake-v1"),
        state="interrupted",
        n_steps=1000,
        taken=WorkTime(),
        evaluating=WorkTime(3.0, 0.5),
        evaluation_steps=700,
        engine="compiled",
        pulls=SimpleNamespace(n_pulls=1500, regret=None, reward=0.25, n_matched=1200),
        final=Evaluation(np.array([1.0, 3.0]), np.array([5.0, 7.0]), successes=None),
        best_return=3.25,
        best_timesteps=10_000,
        best_episodes=5,
    )
    spec = TrainSpec("qlearning", "Lake-v1", split({}), {}, seed=7, log_folder=Path("else where"))
    console = Console(file=io.StringIO(), width=200)
    print_outcome(console, spec, outcome)
    assert [line.rstrip() for line in console.file.getvalue().splitlines()] == [
        "interrupted  1,000 steps in 0.0 s of processor time (1,000,000,000,000 steps/s)",
        "engine       compiled",
        "regret       not known; reward 0.2500 a pull over the 1,200 of 1,500 that are in the log",
        "final        return 2.00 ± 1.00 over 2 episodes",
        "best         return 3.25 over 5 episodes, first at step 10,000",
        "tests        700 steps beside training (70% of it); 0.5 s of processor time",
        "files        logs/qlearning/Lake-v1_3",
        "watch        python enjoy.py --algo qlearning --env Lake-v1 -f 'else where'",
    ]


# --- how far a study is, where there is no terminal ----------------------------------------------


@pytest.fixture
def clock(monkeypatch):
    """A clock that stands until it is told to go on."""
    fake = SimpleNamespace(now=1000.0)
    for place in (compare, terminal, signs_of_life):
        monkeypatch.setattr(place, "time", SimpleNamespace(monotonic=lambda: fake.now))
    still = SimpleNamespace(start=lambda: None, stop=lambda: None)
    monkeypatch.setattr(terminal, "Heartbeat", lambda *_: still)  # nothing beats by itself
    return fake


def test_a_line_now_and_then_and_failures_at_once(clock):
    """After more than ten seconds, from the last line on; and at once for the last run."""
    agents = (AgentSpec("[b]one[/b]", "qlearning"), AgentSpec("two", "sarsa"))
    places = (EnvironmentSpec("lake", "FrozenLake-v1", {"n_timesteps": 10}),)
    runs = plan(StudySpec("s", "S", agents, places, n_seeds=4), Path("nowhere"))
    file = io.StringIO()
    console = TextConsole(file=file, width=100, force_terminal=False)
    counts = zip(runs[2:], (5, 5, 0.5, 9.9, 70, 0), (0, 0, 1, 1, 2, 4), strict=True)
    with StudyProgress(console, runs, runs[:2]) as progress:
        for run, seconds, n_lines in counts:
            clock.now += seconds
            is_last = run is runs[-1]
            progress.note(run, RunFailure(run, "too [hot]", Path("log.txt")) if is_last else None)
            assert file.getvalue().count("\n") == n_lines
    assert file.getvalue().splitlines() == [
        "3 of 6 runs in 10 s, about 13 s left by the clock",
        "5 of 6 runs in 1 min 30 s, about 7 s left by the clock",
        "failed: two on lake, seed 3: too [hot]",
        "6 of 6 runs in 1 min 30 s, 1 failed",
    ]
