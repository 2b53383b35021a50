"""What is said of runs, of their engines, and of how far a study is; lists; to the letter."""

import io
import sys
from contextlib import nullcontext, suppress
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
from rich.console import Console
from stable_baselines3.common.callbacks import BaseCallback, CallbackList

from agents.networks import engine_setting
from agents.networks.engine_setting import TOO_SHORT, EnginePlan, Work
from commands import compare, terminal, tune
from commands.compare import StudyProgress
from commands.terminal import (
    TextConsole,
    about,
    describe,
    describe_others,
    search_line,
    study_line,
    training_line,
)
from commands.train import print_header, print_outcome
from commands.tune import TuningProgress
from experiments.launching import RunFailure
from experiments.plan import plan
from experiments.study import AgentSpec, EnvironmentSpec, StudySpec
from machine_code import WorkTime
from pipeline import signs_of_life
from pipeline.evaluation.sampled import Evaluation, OtherReturns
from pipeline.evaluation.yardstick import Yardstick
from pipeline.preparation import EngineOutlook
from pipeline.runs import Run
from pipeline.settings.hyperparams import split
from pipeline.train_spec import TrainSpec


@pytest.fixture(autouse=True)
def typed(monkeypatch):
    """How the command was begun."""
    words = ["train.py"]
    monkeypatch.setattr(sys, "argv", words)
    return words


def console_of(width=200):
    return Console(file=io.StringIO(), width=width)


def spec_of(log_folder="logs", **entry):
    return TrainSpec(
        "qlearning", "Lake-v1", split(entry), entry, seed=7, log_folder=Path(log_folder)
    )


SAMPLED = Evaluation(np.array([1.0, 3.0]), np.array([5.0, 7.0]), successes=None)
EXACT = Evaluation(
    np.array([70.0]),
    np.array([9.0]),
    successes=np.array([0.875]),
    exact_std=1.0,
    yardstick=Yardstick(optimum=80.0, baseline=-20.0),
)


def outcome_of(**changes):
    fields = {"run": Run(Path("logs/qlearning/Lake-v1_3"), "Lake-v1"), "state": "finished"}
    fields |= {"n_steps": 12_345, "taken": WorkTime(2.0, 1.5), "evaluating": WorkTime(3.0, 0.5)}
    fields |= {"best_timesteps": 0, "best_episodes": 0, "evaluation_steps": 0}
    fields |= dict.fromkeys(("final", "best_return", "engine", "pulls"))
    return SimpleNamespace(**{**fields, **changes})


def printed(outcome, spec):
    console = console_of()
    print_outcome(console, spec, outcome)
    return [line.rstrip() for line in console.file.getvalue().splitlines()]


# --- one run ----------------------------------------------------------------------------------


def test_a_run_in_words():
    """What is printed of whole runs is recorded in ``tests/golden``; here, what seldom happens."""
    assert describe(SAMPLED) == "return 2.00 ± 1.00 over 2 episodes"
    assert describe(EXACT) == (
        "return 70.00 (exact), success 87.5%, optimum 80.00, "
        "best random or constant policy -20.00, score 0.90"
    )
    pulls = SimpleNamespace(n_pulls=1500, regret=None, reward=0.25, n_matched=1200)
    known = {"state": "interrupted", "engine": "compiled", "pulls": pulls, "final": SAMPLED}
    known |= {"best_return": 3.25, "best_timesteps": 10_000, "best_episodes": 5}
    known |= {"evaluation_steps": 700, "taken": WorkTime(), "n_steps": 1000}
    outcome = outcome_of(**known)
    assert printed(outcome, spec_of("else where")) == [
        "interrupted  1,000 steps in 0.0 s of processor time (1,000,000,000,000 steps/s)",
        "engine       compiled",
        "regret       not known; reward 0.2500 a pull over the 1,200 of 1,500 that are in the log",
        "final        return 2.00 ± 1.00 over 2 episodes",
        "best         return 3.25 over 5 episodes, first at step 10,000",
        "tests        700 steps beside training (70% of it); 0.5 s of processor time",
        "files        logs/qlearning/Lake-v1_3",
        "watch        python enjoy.py --algo qlearning --env Lake-v1 -f 'else where'",
    ]


def test_exact_returns_beside_that_of_the_greedy_policy_in_words():
    both = OtherReturns("epsilon 0.1", 61.25, 0.9, 30.5, 40.0)
    learnt = "return 61.25 with epsilon 0.1, as in training"
    discounted = "discounted by 0.9: 30.5, optimum 40"
    outcome = outcome_of(final=replace(EXACT, others=both))
    assert f"beside   {learnt}; {discounted} (exact)" in printed(outcome, spec_of())
    assert describe_others(replace(both, discount=1.0)) == f"{learnt} (exact)"
    assert describe_others(replace(both, acts_by="the same policy")) == f"{discounted} (exact)"
    assert describe_others(OtherReturns()) == ""


HEADERS = [
    ("dqn", {"policy": "MlpPolicy"}, ["policy=MlpPolicy  n_timesteps=9"]),
    ("qlearning", {"learning_rate": "exp_0.3_0.05"},
     ["n_timesteps=9", "learning_rate=exp_0.3_0.05 (falls exponentially from 0.3 to 0.05)"]),
    ("qlearning", {"train_env_kwargs": {"slip": 0.1}},
     ["n_timesteps=9", "train_env_kwargs={'slip': 0.1} (in training only)"]),
    # Long ones are cut short.
    ("dqn", {"env_wrapper": "S" * 201}, [f"env_wrapper={'S' * 200}...  n_timesteps=9"]),
]  # fmt: skip


@pytest.mark.parametrize(("algo", "settings", "lines"), HEADERS)
def test_what_is_about_to_be_trained_is_explained(algo, settings, lines):
    console = console_of(1000)
    print_header(console, replace(spec_of(**settings, n_timesteps=9), algo=algo))
    assert console.file.getvalue().splitlines() == [f"{algo} on Lake-v1, seed 7, 9 steps", *lines]


# --- engines: how long a training will take, known to a factor of two ---------------------------


COMPILED, LIBRARY = EnginePlan(is_compiled=True, world=(1, 2)), EnginePlan(is_compiled=False)
BRIDGED = EnginePlan(is_compiled=True, in_python="Mine must be asked after each step")
SHORT = EnginePlan(is_compiled=False, reason=TOO_SHORT)
# 10,000 updates of 2 ms, as many calls of 0.3 ms, and steps of 0.05 ms; 10 rows each, compiled.
WORK = Work("q", 10_000, 1, 10_000, 1000, 4, 0, 0)


class Mine(BaseCallback):
    def _on_step(self):
        return True


@pytest.fixture
def pace(monkeypatch):
    """A machine of the pace of that on which the constants were measured."""
    monkeypatch.setattr(engine_setting, "machine_pace", lambda: 1.0)
    monkeypatch.setattr(engine_setting, "is_compiled_before", lambda name: True)


def test_times_that_are_roughly_known():
    words = [about(seconds) for seconds in (0.4, 4.4, 119, 150, 7200)]
    assert words == ["less than 1 s", "about 4 s", "about 119 s", "about 2 min", "about 2 h"]
    found = [WORK.library_seconds, WORK.compiled_seconds, WORK.bridged_seconds]
    assert found == pytest.approx([23.5, 1.515, 2.515])


def outlook(chosen, auto=COMPILED, work=WORK):
    return EngineOutlook(chosen, auto, work)


def head(*plans, callbacks=(), **more):
    return lambda: training_line(outlook(*plans, **more), None, CallbackList([*callbacks]))


LOOP = "library (Stable-Baselines3's own loop)"
AUTO = "--engine auto: the same networks and updates compiled"
UNKNOWN = EnginePlan(is_compiled=True, in_python="no model")
SEARCHED, RETESTED = outlook(COMPILED), outlook(LIBRARY)
LINES = [
    (head(LIBRARY), f"{LOOP}, about 24 s of processor time; {AUTO}, about 2 s"),
    (head(COMPILED),
     "compiled, about 2 s of processor time (Stable-Baselines3's own loop: about 24 s)"),
    (head(SHORT, SHORT), f"{LOOP}, about 24 s of processor time: {TOO_SHORT}"),
    (head(BRIDGED, BRIDGED, callbacks=[Mine()]),
     ("compiled but for the environment, about 3 s of processor time: Mine must be asked after "
      "each step (Stable-Baselines3's own loop: about 24 s); made a BlockCallback, it would be "
      "asked only when it acts (docs/training.md#from-python), and training take about 2 s")),
    (head(LIBRARY, UNKNOWN, work=None), f"{LOOP}; {AUTO} but for the environment (no model)"),
    (lambda: study_line([(name, RETESTED, 10) for name in ("ppo", "dqn")] + [("x", SEARCHED, 4)]),
     (f"ppo, dqn: {LOOP}, about 8 min of processor time in 20 runs; with --engine auto compiled, "
      "about 30 s; x: compiled, about 6 s of processor time in 4 runs")),
    (lambda: search_line("ppo", SEARCHED, RETESTED),
     (f"search: compiled, about 2 s of processor time a run; re-test: {LOOP}, about 24 s a run, "
      "in which train runs ppo; --engine auto re-tests compiled, if you train with it")),
    (lambda: search_line("ppo", SEARCHED, SEARCHED),
     "search and re-test: compiled, about 2 s of processor time a run"),
]  # fmt: skip


def test_the_line_about_engines(pace, monkeypatch):
    for line, expected in LINES:
        assert line() == expected
    # Compiling is told where it is still to be done.
    monkeypatch.setattr(engine_setting, "is_compiled_before", lambda name: False)
    start = "compiled, about 2 s of processor time and once about 9 s of compiling ("
    assert head(COMPILED)().startswith(start)


# --- how far a study is: in a terminal, and where the output goes elsewhere ----------------------


@pytest.fixture
def clock(monkeypatch):
    """A clock that stands until it is told to go on."""
    fake = SimpleNamespace(now=1000.0)
    for place in (compare, tune, terminal, signs_of_life):
        monkeypatch.setattr(place, "time", SimpleNamespace(monotonic=lambda: fake.now))
    still = SimpleNamespace(start=lambda: None, stop=lambda: None)
    monkeypatch.setattr(terminal, "Heartbeat", lambda *_: still)  # nothing beats by itself
    return fake


def planned_runs():
    agents = (AgentSpec("[b]one[/b]", "qlearning"), AgentSpec("two", "sarsa"))
    places = (EnvironmentSpec("lake", "FrozenLake-v1", {"n_timesteps": 10}),)
    return plan(StudySpec("s", "S", agents, places, n_seeds=4), Path("nowhere"))


def progress_of(runs, done=(), **options):
    file = io.StringIO()
    console = TextConsole(file=file, width=100, **{"force_terminal": False, **options})
    return file, StudyProgress(console, runs, done)


def test_where_there_is_no_terminal_a_line_now_and_then(clock):
    """After more than ten seconds, from the last line on; and at once for the last run."""
    runs = planned_runs()
    file, progress = progress_of(runs, runs[:2])
    counts = zip(runs[2:], (5, 5, 0.5, 9.9, 70, 0), (0, 0, 1, 1, 2, 3), strict=True)
    with progress:
        for run, seconds, n_lines in counts:
            clock.now += seconds
            progress.note(run, None)
            assert file.getvalue().count("\n") == n_lines
    assert file.getvalue().splitlines() == [
        "3 of 6 runs in 10 s, about 13 s left by the clock",
        "5 of 6 runs in 1 min 30 s, about 7 s left by the clock",
        "6 of 6 runs in 1 min 30 s",
    ]


def test_failures_are_told_at_once_and_of_a_cluster_how_many_workers_there_are(clock):
    runs = planned_runs()
    file, progress = progress_of(runs)
    cluster = SimpleNamespace(words="3 workers", n_workers=3)
    with suppress(KeyboardInterrupt), progress:
        with progress.watching(lambda: nullcontext(cluster))() as launcher:
            assert launcher is cluster
            progress.note(runs[2], RunFailure(runs[2], "too [hot]", Path("log.txt")))
            clock.now += 11
            progress.look()
        clock.now += 11
        progress.look()
        raise KeyboardInterrupt
    last = "1 of 8 runs in 22 s, about 1 min 6 s left by the clock, 1 failed"
    assert file.getvalue().splitlines() == [
        "failed: [b]one[/b] on lake, seed 1: too [hot]",
        "1 of 8 runs in 11 s, about 11 s left by the clock, 3 workers, 1 failed",
        last,
        f"{last}; the same command continues",
    ]
    # So does the line of a search.
    with TuningProgress(TextConsole(file=file), 10, dict, is_cost=False) as search:
        search.run_ended()
        search.trial_ended(4, 0.5, "")
        clock.now += 2
        figures = "1 of 10 trials, 1 run in 2 s; best 0.5 (trial 4); about 18 s left by the clock"
        assert search.figures() == figures
