"""How long a study may still take, held against simulated times."""

import heapq
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from agents import ALGORITHMS
from agents.algorithm_entries import AlgorithmEntry
from experiments.launching import TimeLeft, expected_seconds
from experiments.plan import plan
from experiments.study import AgentSpec, EnvironmentSpec, StudySpec

# What a run takes by agent, in seconds; environments change it twofold.
TAKES = {"qlearning": 0.5, "sarsa": 0.6, "dqn": 40.0, "double_dqn": 90.0, "ppo": 25.0}
ENVIRONMENTS = {"FrozenLake-v1": 0.7, "FrozenLake8x8-v1": 1.0, "Taxi-v4": 1.4, "CliffWalking-v1": 1}


def runs_of(n_seeds):
    return plan(
        StudySpec(
            "s",
            "S",
            tuple(AgentSpec(algo, algo) for algo in TAKES),
            tuple(EnvironmentSpec(name, name, {"n_timesteps": 9}) for name in ENVIRONMENTS),
            n_seeds=n_seeds,
        ),
        Path("nowhere"),
    )


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


@pytest.mark.parametrize("n_seeds", [3, 10])
@pytest.mark.parametrize("n_workers", [1, 2, 8])
@pytest.mark.parametrize("off", [0.6, 1.0, 1.7, 4.0])
@pytest.mark.parametrize("seed", [0, 1, 2])
def test_after_a_tenth_of_the_runs_it_is_right_within_a_factor_of_two(
    n_seeds, n_workers, off, seed
):
    """Also where all take more or less than was expected, as on a busy machine."""
    runs, rng = runs_of(n_seeds), np.random.default_rng(seed)
    usual = [TAKES[run.agent] * ENVIRONMENTS[run.environment] for run in runs]
    takes = [time * rng.uniform(0.8, 1.25) for time in usual]
    expected = {
        (run.agent, run.environment): time / off * rng.uniform(0.8, 1.25)
        for run, time in zip(runs, usual, strict=True)
    }
    found = played(runs, takes, n_workers, expected, (0.1, 0.25, 0.5))
    assert all(0.5 < ratio < 2 for ratio in found.values()), found


def test_equal_runs_of_which_nothing_is_known():
    runs = [run for run in runs_of(10) if run.agent == "qlearning"]
    found = played(runs, [3.0] * len(runs), 2, {}, (0.1, 0.5))
    assert found == pytest.approx({0.1: 1, 0.5: 1}, rel=0.1)


def test_a_run_may_take_the_whole_time_that_is_left():
    slow, *fast = [run for run in runs_of(3) if run.environment == "Taxi-v4"][:4]
    expected = {(run.agent, run.environment): 1.0 for run in fast}
    left = TimeLeft([slow, *fast], {**expected, (slow.agent, slow.environment): 100.0})
    left.start(0.0, 8)
    for run in fast:
        left.end(run, 1.0)
    assert left.seconds(10.0, 8) == pytest.approx(90)
    # Nobody knows how long, once it has taken longer.
    assert 0 < left.seconds(1000.0, 8) <= 250


def test_runs_may_end_in_another_order():
    first, *_, last = runs_of(3)
    left = TimeLeft([first, last], {})
    left.start(0.0, 1)
    left.end(last, 5.0)
    left.start(5.0, 1)
    left.end(last, 6.0)  # told twice
    left.end(first, 7.0)
    assert left.seconds(7.0, 1) == 0


def test_expectations_go_by_agent_and_budget():
    table, network = runs_of(1)[0].spec, runs_of(1)[2].spec
    assert (table.algo, network.algo) == ("qlearning", "dqn")
    assert expected_seconds(table) < expected_seconds(network) < expected_seconds(network, 60.0)


def test_nothing_is_said_while_an_agent_of_the_users_has_not_ended_a_run(monkeypatch):
    """Nobody knows whether it is compiled."""
    monkeypatch.setitem(ALGORITHMS, "own", AlgorithmEntry("own:Own", "own"))
    runs = [replace(run, spec=replace(run.spec, algo="own")) for run in runs_of(3)[:12]]
    left = TimeLeft(runs, {})
    left.start(0.0, 1)
    assert left.seconds(1.0, 1) is None
    for n, run in enumerate(runs[: len(ENVIRONMENTS) * len(TAKES)], start=1):
        left.end(run, 2.0 * n)
        left.start(2.0 * n, 1)
    assert left.seconds(24.0, 1) == pytest.approx(0.0)
