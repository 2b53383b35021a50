"""What is said of a study is true of its runs: each figure, bold, matrix and sentence."""

import math
import re
from pathlib import Path

import numpy as np
import pandas as pd
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy import stats

from experiments.analysis import analyse
from experiments.plan import plan
from experiments.results import CURVE_COLUMNS, RUN_COLUMNS, StudyResults
from experiments.study import AgentSpec, EnvironmentSpec, StudySpec
from report.conclusions import conclusion, overall_sentences, pairs_both_ways
from report.documents import headline, standings, verdicts_as
from report.terminal import sign


def study_of(runs, optimum=1.0, baseline=0.0, metric="final"):
    """The analysis of made-up final figures, by environment and agent, shape (n_seeds,)."""
    places, agents = list(runs), list(next(iter(runs.values())))
    n_seeds = max(len(each) for by_agent in runs.values() for each in by_agent.values())
    algos = {agent: agent if agent in ("optimal", "random") else "qlearning" for agent in agents}
    study = StudySpec(
        "made-up",
        "A study that nobody has run",
        tuple(
            AgentSpec(agent, algos[agent], {"n_timesteps": 100}, tuned=False) for agent in agents
        ),
        tuple(EnvironmentSpec(place, "FrozenLake-v1") for place in places),
        n_seeds=n_seeds,
        metric=metric,
    )
    known = {"optimum": optimum, "baseline": baseline, "threshold": optimum}
    rows = [
        dict.fromkeys(RUN_COLUMNS, math.nan)
        | {"agent": agent, "environment": place, "seed": seed, "exact": True}
        | {"algo": algos[agent], "env_id": "FrozenLake-v1", "cpu_seconds": 1.0, metric: value}
        | (
            known | {"score": (value - baseline) / (optimum - baseline)}
            if metric == "final"
            else {}
        )
        for place in places
        for agent in agents
        for seed, value in enumerate(runs[place][agent])
    ]
    table = pd.DataFrame(rows, columns=list(RUN_COLUMNS))
    curves = pd.DataFrame(columns=list(CURVE_COLUMNS))
    return analyse(StudyResults(study, None, table, curves, tuple(plan(study, Path("made-up")))))


def said(analysis):
    """All sentences on the first environment."""
    return " ".join(conclusion(analysis.study, analysis.environments[0]).everything)


def normal_scores(n, mean, deviation):
    z = stats.norm.ppf((np.arange(n) + 0.5) / n)
    return mean + deviation * z / z.std(ddof=1)


SENTENCES = {
    "a planner, and random moves": (
        {"optimal": [1.0] * 5, "A": [1, 1, 1, 1, 0.9], "B": [1, 1, 1, 1, 0.9], "random": [0.0] * 5},
        {},
        [
            "optimal is best on average: return of the final policy 1, the optimum.",
            "optimal is better on average than A (by",
            "A is better on average than random",
            "A is undecided on average against B",
        ],
    ),
    "mostly at the optimum": (
        {"qlearning": [-13.0] * 10, "dqn": [-13.0] * 10, "ppo": [-15.0] * 6 + [-13.0] * 4},
        {"optimum": -13.0, "baseline": -1000.0},
        ["As far as was seen", "equal within 0.02", "ppo (score 0.9987"],
    ),
    "no way between baseline and optimum": (
        {"A": [353.0] * 5, "B": [353.5] * 5},
        {"optimum": 354.0, "baseline": 353.0},
        ["353"],
    ),
}


@pytest.mark.parametrize("case", SENTENCES)
def test_sentences_on_cases(case):
    runs, known, expected = SENTENCES[case]
    text = said(study_of({"world": runs}, **known))
    assert [words for words in expected if words not in text] == [], text
    if case == "no way between baseline and optimum":
        assert "score" not in text


RUNS = st.lists(st.sampled_from([0.0, 0.3, 0.5, 0.9, 0.95, 0.99, 1.0]), min_size=5, max_size=5)


@settings(deadline=None, max_examples=25)
@given(st.lists(RUNS.map(lambda runs: runs * 2), min_size=2, max_size=4))
def test_what_is_said_is_true_of_the_runs(runs):
    analysis = study_of({"world": dict(zip("ABCD", runs, strict=False))})
    (environment,), text = analysis.environments, said(analysis)
    means = {name: float(np.mean(each)) for name, each in zip("ABCD", runs, strict=False)}
    for name, figure in re.findall(r"([A-D]) \(score ([\d.]+)", text):
        assert means[name] - 1.1e-4 <= float(figure) <= means[name] + 1e-9
        assert float(figure) < 1 or means[name] == 1
    pairs = pairs_both_ways(environment)
    for first, told in re.findall(r"([A-D]) is better on average than (.*?)\.(?= |$)", text):
        for second in re.findall(r"([A-D]) \(by", told):
            assert sign(pairs[first, second]) == ">"
            assert means[first] > means[second]
    spreads = {agent.agent: agent.spread for agent in environment.agents}
    assert spreads == pytest.approx({name: np.std(runs[k], ddof=1) for k, name in enumerate(means)})
    places = standings(analysis.study, environment)
    bold = {row.label for row in headline(analysis).rows if any(c.is_bold for c in row.cells)}
    assert bold == {name for name, place in places.items() if place == "best"}
    if "has learnt" in text:
        assert bold == set()
        return
    assert bold == (set(means) if environment.is_same else set(environment.best))
    is_told = ("is best on average" in text, "are best on average" in text)
    if not environment.is_same:
        n_best = len(environment.best)
        assert is_told == (n_best == 1, n_best > 1 or (is_told[1] and "As far as was" in text))
    table = verdicts_as("md", analysis, "").partition("## ")[0]
    assert set(re.findall(r"\| `([A-D])` \| \*\*", table)) == bold
    in_tex = verdicts_as("tex", analysis, "").partition(r"\subsection")[0]
    assert set(re.findall(r"\\texttt\{([A-D])\} & \\textbf", in_tex)) == bold


def test_over_environments_a_seed_counts_by_its_mean():
    worlds = {
        place: {"A": normal_scores(10, mean, 0.02), "B": normal_scores(10, mean - 0.5, 0.02)}
        for place, mean in (("one", 0.95), ("two", 0.75))
    }
    (sentence,) = overall_sentences(study_of(worlds))
    assert sentence.startswith("Over both environments, A (score 0.85")
    assert sentence.endswith("is best on average.")
