"""What is said at the end of a run, and of how far a study is."""

import io
import sys
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import gymnasium as gym
import numpy as np
import pytest
from rich.console import Console
from rl_yardstick.experiments.launching import RunFailure
from rl_yardstick.pipeline.runs import Run
from rl_yardstick.pipeline.settings.hyperparams import split
from rl_yardstick.pipeline.train_spec import TrainSpec

from rl_yardstick.commands import compare, terminal
from rl_yardstick.commands.compare import StudyProgress
from rl_yardstick.commands.terminal import TextConsole
from rl_yardstick.commands.train import next_commands, other_agent, print_outcome
from rl_yardstick.experiments.plan import plan
from rl_yardstick.experiments.study import AgentSpec, EnvironmentSpec, StudySpec
from rl_yardstick.machine_code import WorkTime
from rl_yardstick.pipeline import signs_of_life
from rl_yardstick.pipeline.callbacks import PullSummary
from rl_yardstick.pipeline.evaluation.sampled import Evaluation, OtherReturns
from rl_yardstick.pipeline.evaluation.yardstick import HiddenState, Yardstick


def run_of(final=None, pulls=None, **fields):
    usual = {"state": "finished", "n_steps": 1000, "taken": WorkTime(), "engine": "compiled"}
    usual |= {"run": Run(Path("logs/qlearning/Lake-v1_3"), "Lake-v1"), "best_return": None}
    usual |= {"evaluating": WorkTime(3.0, 0.5), "evaluation_steps": 700}
    return SimpleNamespace(**usual | {"final": final, "pulls": pulls} | fields)


def printed(outcome):
    console = Console(file=io.StringIO(), width=200)
    print_outcome(console, outcome)
    return [line.rstrip() for line in console.file.getvalue().splitlines()]


def test_a_run_in_words():
    """What is printed of whole runs is recorded in ``tests/golden``; here, what seldom happens."""
    others = OtherReturns("epsilon 0.1", 2.5, 0.9, 1.5, 1.75)
    final = replace(sampled(1.0, 3.0, yardstick=POLE), others=others)
    best = {"best_return": 20.0, "best_timesteps": 9, "best_episodes": 1}
    assert printed(run_of(final, state="interrupted", **best))[:7] == [
        "interrupted  1,000 steps in 0.0 s of processor time (1,000,000,000,000 steps/s)",
        "engine       compiled",
        "beside       return 2.500 with epsilon 0.1, as in training",
        "beside       return 1.500 of 1.750 (gap 0.250), discounted by 0.9",
        "best         score 0.00   return 20 of 500 at most (sampled, 1 episode)   at step 9",
        "tests        700 steps beside training (70% of it); 0.5 s of processor time",
        "files        logs/qlearning/Lake-v1_3",
    ]


def sampled(*returns, **fields):
    return Evaluation(np.array(returns), np.ones(len(returns)), None, **fields)


def exact(value, success, *yardstick, **more):
    successes = None if success is None else np.array([success])
    scale = Yardstick(*yardstick, **more)
    return Evaluation(np.array([value]), np.ones(1), successes, 0.0, scale)


POLE = Yardstick(optimum=500.0, baseline=20.0, at_least=480.0)
OF_POLE = ["score 0   return 20   best random or constant policy", "optimum   480 to 500"]
WAREHOUSE = "score 0   return -1000   best random or constant policy"
HIDES = HiddenState(95.8, (93.8, 93.8), with_memory=False)
PULLS = {"n_pulls": 1000, "n_matched": 1000, "reward": 0.5, "optimal": 0.85}
# The final evaluation, the pulls, and how the output ends.
ENDS = {
    "exact": (
        exact(0.740206, 0.740206, 0.744190, 0.0495),
        None,
        "score 0.99   return 0.7402 of 0.7442 (gap 0.0040)   success 74 %",
        "score 0   return 0.0495   best random or constant policy",
    ),
    "optimal": (
        exact(79 - 1e-14, 1.0, 79.0, -1000.0),
        None,
        "score 1   return 79 of 79   success 100 %",
        WAREHOUSE,
    ),
    "nearly optimal": (
        exact(79 - 1e-9, 1 - 1e-4, 79.0, -1000.0),
        None,
        "score 0.99   return 79 of 79 (gap 1e-09)   success 99.9 %",
        WAREHOUSE,
    ),
    "episodes do not end": (
        exact(-1000.0, 0.0, 79.0, -1000.0),
        None,
        "score 0.00   return -1000 of 79 (gap 1079)   success 0 %",
        WAREHOUSE,
    ),
    "sampled": (
        sampled(78.5, 79.0, yardstick=Yardstick(79.0, -1000.0)),
        None,
        "score 0.99   return 78.75 of 79 (gap 0.25; sampled, 2 episodes)",
        WAREHOUSE,
    ),
    "far": (
        exact(-1000.0, None, -11.66, -12.0),
        None,
        "score -2905.89   return -1000 of -11.66 (gap 988.34)",
        "score 0   return -12   best random or constant policy",
    ),
    "bracketed": (
        sampled(260.0, yardstick=POLE),
        None,
        "score 0.50 to 0.52   return 260 of 500 at most (sampled, 1 episode)",
        *OF_POLE,
    ),
    "bracketed without a proof": (
        sampled(500.0, yardstick=replace(POLE, at_least=500.0, is_proven=False)),
        None,
        "score 1   return 500 of 500 at most (not proven; sampled, 1 episode)",
        OF_POLE[0],
        "optimum   500 (the upper end is not proven)",
    ),
    "no optimum": (sampled(*[487.25] * 100), None, "return 487.2 (sampled, 100 episodes)"),
    "no scale": (
        exact(749.5, None, 750.0, 750.0),
        None,
        "return 749.5 of 750 (gap 0.5)",
        "no score   return 750   best random or constant policy",
    ),
    "hidden state": (
        exact(-80.0, 1 / 15, 93.8, -40.0, 35.0, hidden=HIDES),
        None,
        "score -0.54 to -0.30   return -80 of 93.80 at most   success 6.7 %",
        "score 0   return -40   best random or constant policy",
        "optimum   35 to 93.80 without memory, 93.80 with memory, 95.80 by the state",
    ),
    "bandit": (
        exact(159.0, None, 159.0, 117.0),
        PullSummary(regret=127.984, **PULLS),
        "regret 127.98 over 1,000 pulls   best arm in 85 % of the last 100",
        "score 1   return 159 of 159",
        "score 0   return 117   best random or constant policy",
    ),
    "bandit from a log": (
        None,
        PullSummary(regret=None, **PULLS),
        "regret not known   reward 0.5000 a pull over the 1,000 of 1,000 that are in the log",
    ),
}


@pytest.mark.parametrize("case", ENDS)
def test_how_a_run_ends(case):
    final, pulls, *lines = ENDS[case]
    assert printed(run_of(final, pulls))[-len(lines) - 1 :] == ["", *lines]


def test_what_to_type_next(monkeypatch):
    monkeypatch.setattr(sys, "argv", ["train.py"])
    run = run_of().run
    settings = {"env_kwargs": {"size": 5}, "engine": "auto", "n_episodes": 30}
    spec = TrainSpec("qlearning", "Lake-v1", split(settings), {}, 7, log_folder=Path("else where"))
    chosen = "--algo qlearning --env Lake-v1 -f 'else where'"
    compared = "compare.py --env Lake-v1 --algos qlearning"
    assert next_commands(spec, run, "sarsa", has_model=True) == [
        ("watch", f"python enjoy.py {chosen}"),
        ("explain", f"python -m rl_yardstick explain {chosen}"),
        ("compare", f"python {compared} sarsa --env-kwargs size:5 --seeds 10 --engine auto"),
    ]
    own = replace(spec, algo="cautious", hyperparams=split({"n_episodes": 30}))
    assert next_commands(own, run, None, has_model=False)[1:] == [
        ("compare", "python compare.py --env Lake-v1 --algos cautious --n-episodes 30 --seeds 10")
    ]


@pytest.mark.parametrize(
    ("algo", "env_id", "is_bandit", "other"),
    [
        ("qlearning", "FrozenLake-v1", False, "sarsa"),
        ("ppo", "Pendulum-v1", False, "sac"),
        ("thompson", "BernoulliBandit-v0", True, "epsilon_greedy"),
    ],
)
def test_the_other_agent_fits(algo, env_id, is_bandit, other):
    spec = TrainSpec(algo, env_id, split({}), {}, seed=0)
    assert other_agent(spec, gym.make(env_id), is_bandit=is_bandit) == other


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
