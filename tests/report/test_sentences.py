"""What a study says in words: each sentence worked by hand, and all of them true of the runs."""

import math
import re
from pathlib import Path

import numpy as np
import pandas as pd
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from experiments.analysis import analyse
from experiments.looks import Design, Look, Looks, Question, Standing
from experiments.plan import plan
from experiments.results import CURVE_COLUMNS, RUN_COLUMNS, StudyResults
from experiments.study import AgentSpec, EnvironmentSpec, StudySpec
from report.conclusions import conclusion, pairs_both_ways
from report.documents import headline, standings, verdicts_as
from report.terminal import sign
from report.words import (
    look_sentences,
)
from tests.report import made_up
from verdicts import FailureCount, SpeedComparison, Summary, ThresholdSummary

NAN, INF = math.nan, math.inf


# --- how often a study was looked at --------------------------------------------------------------

QUESTION = Question("final", None, None, 1000, False)


def look(level, planned=False, **seeds):
    return Look("2026-11-22 10:00:00", QUESTION, seeds, {}, {}, level, planned)


def test_each_look_has_a_line():
    assert look_sentences(Looks()) == []
    once = look_sentences(Looks((look(0.045, a=1, b=1),)))
    assert once[1] == "2026-11-22: seed 1000; claims at 4.5 %."
    taken = (look(0.045, a=5, b=5), look(0.0025, a=10, b=5, c=10))
    assert look_sentences(Looks(taken)) == [
        "These runs have been looked at twice.",
        "2026-11-22: seeds 1000 to 1004; claims at 4.5 %.",
        "2026-11-22: b, seeds 1000 to 1004; a and c, seeds 1000 to 1009; claims at 0.25 %.",
    ]
    planned = tuple(look(0.015, planned=True, a=size) for size in (5, 8, 12))
    _, settled, *each = look_sentences(Looks(planned, Design(QUESTION, (5, 8, 12), {}, 0)))
    assert settled == "Fixed before the first of them: looks at 5, 8 and 12 seeds."
    assert len(each) == 3


# --- who is best ----------------------------------------------------------------------------------

SIGNS = {">": "better", "<": "worse", "=": "equivalent", "?": "undecided"}
MEANS = {"a": 100.0, "b": 90.0, "c": 80.0}
A, B = "score 1 [0.9, 1.2]", "score 0.9 [0.8, 1.1]"
FIGURE = f"return of the final policy 100, {A}; the optimum is 200"


def place_of(signs, means=MEANS, medians=None, **changes):
    """Agents with such means; by two names the verdict on the first of them."""
    agents = []
    for name, mean in means.items():
        figures = [made_up.estimate(value) for value in (mean, (medians or means)[name], mean)]
        one = made_up.agent(name, mean, metric=Summary(*figures), steps_to_stay=None)
        agents.append(one)
    pairs = tuple(made_up.pair(*names, SIGNS[sign]) for names, sign in signs.items())
    return made_up.environment(agents, **{"pairs": pairs, "optimum": 200.0, "fewest": 4, **changes})


def said(place, metric="final"):
    names = [agent.agent for agent in place.agents]
    return conclusion(made_up.study(names, metric=metric), place)


@pytest.mark.parametrize(
    ("signs", "lead"),  # of a on b, a on c, b on c
    [
        (">>?", f"a is best on average: {FIGURE}."),
        ("=>>", (f"a and b are best on average, and equal within 1.6: a ({A}) and b ({B}); the "
                 "optimum is 200.")),
        ("?>>", f"Undecided on average: best is a ({A}) or b ({B}); the optimum is 200."),
        ("<?>", (f"b is best on average: return of the final policy 90, {B}; the optimum is "
                 "200.")),
    ],
)  # fmt: skip
def test_who_is_best(signs, lead):
    assert said(place_of(dict(zip(("ab", "ac", "bc"), signs, strict=True)))).lead == lead


CONDITION = (
    "as long as fewer than 1 % of further runs lie outside of those that were seen; after 4 runs, "
    "up to 53% of further ones may be different"
)


def test_a_verdict_with_a_condition_says_so():
    place = place_of({}, TWO, pairs=(made_up.pair(*"ab", "better", is_conditional=True),))
    told = f"a is ahead on average of b (by 0.08 to 0.12 of the score), {CONDITION}."
    assert said(place).pairs == (told,)
    assert said(place).lead.startswith(f"Undecided on average: best is a ({A}) or b ({B}); ")
    assert sign(pairs_both_ways(place)["a", "b"]) == "(>)"


def test_of_those_that_are_best_it_is_said_whose_runs_failed():
    failures, told = {"a": FailureCount(0, 20, 0.2), "b": FailureCount(3, 20, 0.4)}, "3 of 20 runs"
    for relation, is_named in (("=", True), (">", False), ("<", True), ("?", True)):
        found = said(place_of({"ab": relation}, TWO, failures=failures))
        assert (told in found.lead) is is_named
        assert found.failed == f"{told} of b failed."


TWO = {"a": 100.0, "b": 90.0}


@pytest.mark.parametrize(
    ("means", "signs", "changes", "lead"),
    [
        (TWO, {"ab": "?"}, {"fewest": 7}, (f"So far: a ({A}) and b ({B}); the optimum is 200; 4 "
         "seeds decide nothing, 7 or more can.")),
        ({"a": NAN}, {}, {}, "No run has a figure for the return of the final policy."),
        ({"a": 21.0, "b": 21.0}, {}, {}, ("None of the agents has learnt: no typical run is better "
         "than the best random or constant policy's 20; the highest mean return of the final "
         "policy is 21 [20.9, 21.2], of a and b.")),
        ({"a": 200.0}, {}, {}, "a: return of the final policy 200, the optimum."),
    ],
    ids=["few seeds", "no figure", "none learnt", "optimal"],
)  # fmt: skip
def test_other_first_lines(means, signs, changes, lead):
    assert said(place_of(signs, means, **changes)).lead == lead


def test_where_mean_and_median_differ_it_is_said():
    medians = dict(zip("abc", (50.0, 95.0, 60.0), strict=True))
    lead = said(place_of({"ab": "?"}, medians=medians)).lead
    told = " By the mean a comes first (100 against 90), by the median b (95 against 50)."
    assert lead.endswith(told)
    # Of regret the lower is the better.
    means = {"a": 90.0, "b": 100.0, "c": 110.0}
    lead = said(
        place_of({"ab": "?"}, means, medians={**medians, "a": 95.0, "b": 50.0}), "regret"
    ).lead
    told = " By the mean a comes first (90 against 100), by the median b (50 against 95)."
    assert lead.endswith(told)


# --- pairs, and what else there is to say ---------------------------------------------------------


def test_pairs_with_one_verdict_stand_in_one_sentence_of_the_better_agent():
    # Ranks go by the mean: the first of a pair may be the worse one.
    assert said(place_of({"ab": "<", "ac": ">", "bc": ">"})).pairs == (
        "a is better on average than c (by 0.05 to 0.15 of the score).",
        (
            "b is better on average than a (by -0.15 to -0.05 of the score) and c (by 0.05 to 0.15 "
            "of the score)."
        ),
    )
    open_ = (made_up.pair(*"ab", "undecided", seeds_needed=793), made_up.pair(*"ac", "undecided"))
    assert said(place_of({}, pairs=open_)).pairs == (
        (
            "a is undecided on average against b (difference so far 0.08 to 0.12; about 793 seeds "
            "are needed to decide) and c (difference so far 0.08 to 0.12)."
        ),
    )


def stays(share, steps):
    return ThresholdSummary(made_up.estimate(steps), made_up.estimate(share))


def test_how_soon_agents_arrive():
    agents = [
        made_up.agent("slow", 90.0, steps_to_stay=stays(0.75, 3000.0)),
        made_up.agent("quick", 80.0, steps_to_stay=stays(1.0, 1000.0)),
        made_up.agent("late", 70.0, steps_to_stay=stays(0.25, INF)),
        made_up.agent("never", 60.0, steps_to_stay=stays(0.0, INF)),
    ]
    ratio = made_up.estimate(1 / 3, 0.25, 0.5)
    speeds = (SpeedComparison("slow", "quick", ratio, 0.01, "quick"),)
    notes = said(made_up.environment(agents, speeds=speeds)).notes
    assert notes == (
        (
            "quick reaches a score of 0.95 and keeps it to the end in 4 of 4 runs, the median one "
            "from step 1,000 on; slow in 3 of 4 runs, the median one from step 3,000 on; late in "
            "1 of 4 runs; never in none."
        ),
        "quick arrives in fewer steps: slow needs 2 to 4 times as many.",
    )


FEW = {"a": FailureCount(6, 10, 0.9), "b": FailureCount(0, 10, 0.3)}
GROWN = Standing(2, 0.015, 0.015, Design(QUESTION, (5, 8, 12), {}, 0))


@pytest.mark.parametrize(
    ("changes", "notes"),
    [
        ({"optima": {"a": 1.0, "b": 2.0}}, [("The agents do NOT PLAY THE SAME ENVIRONMENT: the "
          "optimum is 1 for a and 2 for b. Their returns cannot be compared.")]),
        ({"failures": FEW, "unreliable": (("a", "b"),)},
         ["a fails more often than b (6 of 10 runs against 0 of 10)."]),
        ({"optimum": 101.0, "impossible": ("a",)}, [("a has MORE THAN ANY POLICY CAN REACH, "
          "101: the bracket belongs to another environment, or is wrong.")]),
        ({"missing": {"a": 1, "b": 4}}, ["1 of 4 runs of a is missing.",
                                         "No run of b has finished."]),
        ({"look": Standing(3, 0.0025)},
         ["This is the third look at this study: claims at 0.25 %."]),
        ({"look": GROWN}, [("Agents got more seeds until they were decided, at up to 3 looks that "
          "were fixed beforehand: claims at 1.5 % each.")]),
    ],
)  # fmt: skip
def test_what_else_is_said(changes, notes):
    assert list(said(place_of({"ab": "?"}, TWO, **changes)).notes) == notes


# === what is said is true of the runs =============================================================


def study_of(runs):
    """The analysis of made-up final scores, by agent."""
    agents, n_seeds = list(runs), len(next(iter(runs.values())))
    specs = (AgentSpec(a, "qlearning", {"n_timesteps": 100}, tuned=False) for a in agents)
    places = (EnvironmentSpec("world", "FrozenLake-v1"),)
    study = StudySpec("made-up", "A study that nobody has run", tuple(specs), places, n_seeds)
    known = {"environment": "world", "env_id": "FrozenLake-v1", "algo": "qlearning", "exact": True}
    known |= {"optimum": 1.0, "baseline": 0.0, "threshold": 1.0, "cpu_seconds": 1.0}
    rows = [
        known | {"agent": agent, "seed": seed, "final": value, "score": value}
        for agent in agents
        for seed, value in enumerate(runs[agent])
    ]
    table = pd.DataFrame(rows, columns=list(RUN_COLUMNS))
    curves = pd.DataFrame(columns=list(CURVE_COLUMNS))
    return analyse(StudyResults(study, None, table, curves, tuple(plan(study, Path("made-up")))))


def sentences_on(analysis):
    """All sentences on the first environment."""
    return " ".join(conclusion(analysis.study, analysis.environments[0]).everything)


RUNS = st.lists(st.sampled_from([0.0, 0.3, 0.5, 0.9, 0.95, 0.99, 1.0]), min_size=5, max_size=5)


@settings(deadline=None, max_examples=10)
@given(st.lists(RUNS.map(lambda runs: runs * 2), min_size=2, max_size=4))
def test_what_is_said_is_true_of_the_runs(runs):
    analysis = study_of(dict(zip("ABCD", runs, strict=False)))
    (environment,), text = analysis.environments, sentences_on(analysis)
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
