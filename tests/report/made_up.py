"""Analyses made up by hand, so that what is drawn and printed can be worked out on paper."""

import math
from dataclasses import replace

import numpy as np
import pandas as pd

from rl_yardstick.experiments.analysis import AgentAnalysis, EnvironmentAnalysis, StudyAnalysis
from rl_yardstick.experiments.bandits import PullStatistics
from rl_yardstick.experiments.results import CURVE_COLUMNS, RUN_COLUMNS, StudyResults
from rl_yardstick.experiments.study import AgentSpec, EnvironmentSpec, StudySpec
from rl_yardstick.verdicts import AgentRuns, Best, Estimate, Pair, Study, Summary, ThresholdSummary

HOSTILE = "</script><script>document.title='taken'</script>"
NOTHING = Estimate(math.nan, math.nan, math.nan, 0)


def estimate(point, low=None, high=None, n=20):
    """With an interval from a tenth below the point to a fifth above by default."""
    low = point - 0.1 if low is None else low
    return Estimate(point, low, point + 0.2 if high is None else high, n)


def agent(label, mean, **changes):
    """An agent whose figures are the mean plus 1, 2, 3 and so on, so that none is another."""
    share, ends = estimate(0.75, 0.5, 0.9, n=4), (0.0, 1.0)
    runs = AgentRuns("lake", label, 4, 0, mean / 100, ends, mean / 100, 0, ends, 0.5)
    figures = {"agent": label, "runs": runs, "spread": 0.0, "n_runs": 4, "n_missing": 0}
    figures |= {"metric": Summary(estimate(mean), estimate(mean + 1), mean + 2)}
    figures |= {"score": estimate(mean / 100), "success_rate": estimate(0.5, 0.25, 0.625)}
    more = {"final": 3, "last_episodes": 5, "regret": 6, "seconds": 9}
    figures |= {name: estimate(mean + n) for name, n in more.items()}
    times = {"steps_to_threshold": 7, "episodes_to_stay": 8, "steps_to_stay": 10}
    figures |= {name: ThresholdSummary(estimate(mean + n), share) for name, n in times.items()}
    return AgentAnalysis(**{**figures, **changes})


def failing(one, n_failed, n):
    """An agent of whose runs so many failed."""
    return replace(one, runs=replace(one.runs, failed=n_failed, n=n))


def pair(first, second, word, difference=0.1, **changes):
    ends = (difference - 0.05, difference + 0.05)
    found = Pair("lake", first, second, word, False, difference, ends, 0.5, 0.5, 4)
    return replace(found, **changes)


def environment(agents=(), label="lake", **changes):
    known = {"env_id": "Lake-v0", "optimum": 100.0, "baseline": 20.0, "threshold": 96.0}
    known |= {"is_score": True, "margin": 0.02, "bounds": (0.0, 100.0), "exact": True}
    known |= {"pairs": (), "best": Best((), False, False), "failure_threshold": 0.4}
    return EnvironmentAnalysis(environment=label, agents=tuple(agents), **{**known, **changes})


def study(labels, metric="final", places=("lake",), n_seeds=4):
    agents = tuple(AgentSpec(label, "qlearning", tuned=False) for label in labels)
    environments = tuple(EnvironmentSpec(place, "FrozenLake-v1") for place in places)
    return StudySpec("s", "S", agents, environments, n_seeds=n_seeds, metric=metric)


def analysis(environments, labels, root=None, pulls=None, overall=None, cpu=(), **fields):
    """``cpu`` has (agent, environment, seconds) of each run."""
    asked = study(labels, places=[one.environment for one in environments], **fields)
    runs = pd.DataFrame(cpu, columns=["agent", "environment", "cpu_seconds"])
    runs = runs.reindex(columns=RUN_COLUMNS)
    curves = pd.DataFrame(columns=CURVE_COLUMNS)
    results = StudyResults(asked, root, runs, curves, (), pulls or {})
    agents = [replace(a.runs, environment=e.environment) for e in environments for a in e.agents]
    pairs = [replace(p, environment=e.environment) for e in environments for p in e.pairs]
    best = {one.environment: one.best for one in environments}
    said = Study(agents, pairs, best, dict.fromkeys(best, 0.4), 0.01, {})
    return StudyAnalysis(results, said, tuple(environments), overall)


def pulls(start, n=(1, 10, 100), n_runs=4):
    """What a bandit's agent did: figures that begin with ``start``, each ten above the last."""
    rise, nothing = start + np.arange(float(len(n))), np.empty(0)
    unknown = ("shares", "estimates", "estimates_std", "true_means", "posteriors")
    return PullStatistics(
        pulls=np.array(n),
        reward=rise,
        optimal=rise / 100,
        regret=rise + 10,
        cumulative_regret=rise + 20,
        cumulative_regret_sem=np.arange(float(len(n))),
        cumulative_regret_quantiles=np.array([rise + 20 + d for d in (-9, -3, -1, 3, 12)]),
        simple_regret=rise + 30,
        total_reward=np.zeros(n_runs),
        total_regret=np.zeros(n_runs),
        moments=np.empty(0, dtype=np.int64),
        **dict.fromkeys(unknown, nothing),
    )


def trial(number, value, figures, state="complete", failure=None, **params):
    """A trial of a tuning, as its record has it."""
    at = f"2026-01-01T00:{{:02d}}:{number % 60:02d}"
    told = {"number": number, "state": state, "value": value, "failure": failure}
    told |= {"params": {"rate": 0.1, "kind": "a", "steps": 3} | params, "figures": figures}
    more = {"tau": 1.0} if number == 2 else {}
    told["settings"] = {"learning_rate": number, "gamma": 0.9, **more}
    return told | {"seconds": 2.0 * len(figures), "began": at.format(0), "ended": at.format(1)}


def tuning():
    """What a tuning wrote down."""
    from optuna.distributions import CategoricalDistribution, FloatDistribution, IntDistribution
    from optuna.distributions import distribution_to_json as as_json

    space = {"rate": as_json(FloatDistribution(0.01, 1.0, log=True))}
    space["kind"] = as_json(CategoricalDistribution(["a", None, True]))
    space["steps"] = as_json(IntDistribution(1, 5))
    interval = {"point": 0.5, "low": 0.4, "high": 0.6, "n": 4, "n_missing": 0}
    shipped = {"label": "shipped", "number": 0, "held_out": 0.5, "in_search": 0.6, "verdict": ""}
    shipped |= {"n_runs": 4, "n_failed": 1, "interval": interval}
    winner = {**shipped, "label": "trial 2", "number": 2, "held_out": 0.7}
    winner |= {"verdict": "better so far", "gain": [0.2, 0.1, 0.3]}
    retest = {"settings": [shipped, winner], "winner": "trial 2", "winner_file": "winner.yml"}
    record = {"name": "t", "command": "python tune.py <script>", "widened": ["rate"]}
    record |= {"figure": "score", "objective": "mean", "lower_is_better": False, "n_trials": 10}
    record |= {"n_at_optimum": 0, "seeds": [1, 0], "held_out_seeds": [1000, 1001]}
    record |= {"retest": {**retest, "reason": "", "optimism": 0.1}}
    asked = {"algo": "dqn", "env": "Toy-v0", "sampler": "tpe", "pruner": "auto"}
    return record | {
        "asked": {**asked, "search_space": space},
        "trials": [
            trial(0, 0.6, {"1": 0.6, "0": 0.6}),
            trial(1, -30.0, {"1": -30.0}, "pruned", rate=1.0),
            trial(2, 0.8, {"1": 0.8, "0": 0.8}, kind=None),
            trial(3, 0.7, {"1": 0.7, "0": 0.7}, steps=5),
            trial(4, None, {}, "pruned", failure="it broke"),
            trial(5, None, {}, "running"),
            trial(6, 0.75, {"1": 0.75}, "pruned", kind=True),
        ],
    }
