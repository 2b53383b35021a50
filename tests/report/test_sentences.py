"""What a study says in words: worked by hand, true of the runs, one word wherever it is shown."""

import io
import json
import math
import re
from dataclasses import replace
from pathlib import Path

import numpy as np
import pandas as pd
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from rich.console import Console

from rl_yardstick.experiments.analysis import analyse
from rl_yardstick.experiments.plan import plan
from rl_yardstick.experiments.results import CURVE_COLUMNS, RUN_COLUMNS, StudyResults
from rl_yardstick.experiments.study import AgentSpec, EnvironmentSpec, StudySpec
from rl_yardstick.report.documents import headline, verdicts_as, write_verdicts
from rl_yardstick.report.page import render, result_sections
from rl_yardstick.report.page.frame import Report
from rl_yardstick.report.series import EnvironmentSeries, StudySeries, agent_marks
from rl_yardstick.report.terminal import print_analysis
from rl_yardstick.report.words import answer, conclusion, pairs_both_ways
from rl_yardstick.verdicts import Best, judge
from tests.report import made_up
from tests.report.test_page import Page

NAN = math.nan
MEANS = {"a": 100.0, "b": 90.0, "c": 80.0}
TWO = {"a": 100.0, "b": 90.0}


def place_of(words, means=MEANS, **changes):
    """Agents with such means; by two names the word on the first of them."""
    agents = [made_up.agent(name, mean, steps_to_stay=None) for name, mean in means.items()]
    pairs = tuple(made_up.pair(*names, word) for names, word in words.items())
    known = {"pairs": pairs, "optimum": 200.0, "best": Best(("a", "b"), True, True), **changes}
    return made_up.environment(agents, **known)


def said(place, metric="final"):
    names = [agent.agent for agent in place.agents]
    return conclusion(made_up.study(names, metric=metric), place)


@pytest.mark.parametrize(
    ("means", "changes", "lead"),
    [
        (MEANS, {}, "Best: a, b (tied so far); the optimum is 200."),
        (MEANS, {"best": Best(("a",), False, False)}, "Best: a; the optimum is 200."),
        (MEANS, {"best": Best(("a", "c"), False, True), "optimum": None},
         "Best: a, c (undecided)."),
        ({"a": NAN}, {}, "No run has a figure for the return of the final policy."),
        ({"a": 21.0, "b": 21.0}, {}, ("None of the agents has learnt: no median is above the best "
         "random or constant policy's 20; the best mean return of the final policy is 21; the "
         "optimum is 200.")),
        ({"a": 150.0}, {}, ("a: return of the final policy 150, score 1.5; the optimum is "
         "200.")),
    ],
    ids=["tied", "one", "undecided", "no figure", "none learnt", "alone"],
)  # fmt: skip
def test_who_is_best(means, changes, lead):
    assert said(place_of({}, means, **changes)).lead == lead


OPEN = (made_up.pair(*"ab", "undecided", seeds_needed=793), made_up.pair(*"ac", "undecided"))
TWICE_OPEN = (
    made_up.pair(*"ab", "tied"),
    *(made_up.pair(*two, "undecided", seeds_needed=n) for two, n in (("ac", 23), ("bc", 40))),
)
FEW = (made_up.pair(*"ab", "tied", so_far=True), made_up.pair(*"ac", "better", so_far=True))


@pytest.mark.parametrize(
    ("words", "changes", "sentences"),
    [
        # Ranks go by the mean: the first of a pair may be the worse one.
        ({"ab": "worse", "ac": "better", "bc": "better"}, {}, [
            "a is better than c (by 0.05 to 0.15 of the score).",
            ("b is better than a (by -0.15 to -0.05 of the score) and c (by 0.05 to 0.15 of the "
            "score)."),
        ]),
        ({}, {"pairs": OPEN}, [
            ("a is undecided against b (difference 0.05 to 0.15 of the score; about 793 seeds "
            "would decide) and c (difference 0.05 to 0.15 of the score).")
        ]),
        ({}, {"pairs": FEW, "looks": (4, 8), "is_score": False, "margin": 2.0}, [
            "a is better so far than c (by 0.05 to 0.15; with 4 seeds).",
            "a is tied so far with b (within 2; with 4 seeds).",
        ]),
    ],
)  # fmt: skip
def test_pairs_with_one_word_stand_in_one_sentence_of_the_better_agent(words, changes, sentences):
    assert said(place_of(words, **changes)).pairs == tuple(sentences)


@pytest.mark.parametrize(
    ("changes", "notes"),
    [
        ({}, []),
        ({"optima": {"a": 1.0, "b": 2.0}}, [("The agents do NOT PLAY THE SAME ENVIRONMENT: the "
          "optimum is 1 for a and 2 for b. Their returns cannot be compared.")]),
        ({"optimum": 101.0, "impossible": ("a",)}, [("a has MORE THAN ANY POLICY CAN REACH, "
          "101: the bracket belongs to another environment, or is wrong.")]),
        ({"missing": {"a": 1, "b": 4}}, ["1 of 4 runs of a is missing.",
                                         "No run of b has finished."]),
        ({"looks": (5, 10, 12)}, [("Agents got more seeds until they were decided: up to 3 looks, "
          "at 5, 10 and 12 seeds.")]),
    ],
)  # fmt: skip
def test_what_else_is_said(changes, notes):
    place = place_of({}, TWO, **changes)
    failing = made_up.failing(place.agents[0], 3, 20)
    for agents, first in ((place.agents, []), ((failing,), ["3 of 20 runs of a failed."])):
        told = said(replace(place, agents=(*agents, *place.agents[1:])[:2])).notes
        assert list(told) == [*first, *notes]


ANSWERS = {
    "a has the highest mean score: 1. Certain: a is better than b. Certain: a is tied with c. "
    "Failed runs: none.": [place_of({"ab": "better", "ac": "tied"})],
    "a has the highest mean score in 2 of 2 environments. So far, with few runs: a is better than "
    "c in 1. So far, with few runs: a is tied with b in 1. Not settled: c in 1. Failed runs: "
    "none.": [place_of({}, pairs=FEW), place_of({}, pairs=OPEN[1:], label="sea")],
    "a has the highest mean return of the final policy: 100. Not settled: b (789 more seeds "
    "would).": [place_of({}, pairs=OPEN[:1], is_score=False, failure_threshold=None)],
    "a has the highest mean score: 1. Certain: a is tied with b. Not settled: c (36 more seeds "
    "would). Failed runs: none.": [place_of({}, pairs=TWICE_OPEN)],
    "a and b have the highest mean score in 1 of 2 environments each. No agent has learnt on 2. "
    "Failed runs: none.": [place_of({}, dict.fromkeys("ab", x), label=f"{x}") for x in (90.0, 2)],
    "": [],
}


@pytest.mark.parametrize(("told", "places"), ANSWERS.items())
def test_the_answer_says_who_is_best_how_certain_and_what_failed(told, places):
    said = " ".join(answer(made_up.analysis(places, "abc")))
    assert said.removeprefix("With 4 seeds, ") == told


def study_of(runs, root=None):
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
    return analyse(StudyResults(study, root, table, curves, tuple(plan(study, Path("made-up")))))


RUNS = st.lists(st.sampled_from([0.0, 0.3, 0.5, 0.9, 0.95, 0.99, 1.0]), min_size=5, max_size=5)


@settings(deadline=None, max_examples=10)
@given(st.lists(RUNS.map(lambda runs: runs * 2), min_size=2, max_size=4))
def test_what_is_said_is_true_of_the_runs(runs):
    analysis = study_of(dict(zip("ABCD", runs, strict=False)))
    (environment,) = analysis.environments
    text = " ".join(conclusion(analysis.study, environment).everything)
    means = {name: float(np.mean(each)) for name, each in zip("ABCD", runs, strict=False)}
    pairs = pairs_both_ways(environment.pairs)
    for first, told in re.findall(r"([A-D]) is better than (.*?)\.(?= |$)", text):
        for second in re.findall(r"([A-D]) \(by", told):
            assert pairs[first, second].text == "better"
            assert means[first] > means[second]
    spreads = {agent.agent: agent.spread for agent in environment.agents}
    assert spreads == pytest.approx({name: np.std(runs[k], ddof=1) for k, name in enumerate(means)})
    bold = {row.label for row in headline(analysis).rows if any(c.is_bold for c in row.cells)}
    best = set(environment.best.agents)
    assert bold == (set() if "has learnt" in text or len(best) == len(runs) else best)
    assert ("has learnt" in text) == (f"Best: {environment.best};" not in text)
    table = verdicts_as("md", analysis, "").partition("## ")[0]
    assert set(re.findall(r"\| `([A-D])` \| \*\*", table)) == bold
    in_tex = verdicts_as("tex", analysis, "").partition(r"\subsection")[0]
    assert set(re.findall(r"\\texttt\{([A-D])\} & \\textbf", in_tex)) == bold


SCORES = {
    "best": [1.0] * 12,
    "same": [1.0] * 12,
    "noisy": [1.0, 0.4, 1.0, 0.7] * 3,
    "bad": [0.2, 0.3, 0.25, 0.2] * 3,
}


@pytest.fixture(scope="module", params=[12, 4], ids=["many", "few"])
def study(request, tmp_path_factory):
    """The analysis, its words by pair, and all files."""
    runs = {name: values[: request.param] for name, values in SCORES.items()}
    analysis = study_of(runs, tmp_path_factory.mktemp("study"))
    said = judge({"world": runs}, bounds=(0, 1))
    words = {(p.first, p.second): p.text for pair in said.pairs for p in (pair, pair.swapped())}
    write_verdicts(analysis, "compare")
    return analysis, words, str(said.best["world"])


def both_ways(rows):
    """Words by pair, from rows of first agent, word, second agent."""
    turned = {"better": "worse", "worse": "better"}
    found = {}
    for first, word, second in rows:
        kind, *rest = word.split(" ", 1)
        found[first, second] = word
        found[second, first] = " ".join([turned.get(kind, kind), *rest])
    return found


def of_sentences(text):
    """The words in sentences such as "a is better so far than b (...) and c (...)."."""
    rows = []
    ways = r"(better|tied|undecided)( so far)? (?:than|with|against) (.*?\))\."
    for first, word, few, others in re.findall(rf"(\w+) is {ways}", " ".join(text.split())):
        rows += [(first, word + few, second) for second in re.findall(r"(\w+) \(", others)]
    return both_ways(rows)


def test_python_csv_json_markdown_and_latex_agree(study):
    analysis, words, best = study
    root = analysis.results.root
    table = pd.read_csv(root / "verdicts.csv")
    rows = table[["first", "verdict", "second"]].itertuples(index=False)
    assert both_ways(rows) == words
    data = json.loads((root / "verdicts.json").read_text())
    assert both_ways((p["first"], p["verdict"], p["second"]) for p in data["pairs"]) == words
    assert data["best"]["world"]["text"] == best
    assert str(analysis.environments[0].best) == best
    for pair, (_, row) in zip(data["pairs"], table.iterrows(), strict=True):
        assert [pair["low"], pair["high"]] == pytest.approx([row["low"], row["high"]])
    for suffix in ("md", "tex"):
        text = (root / f"verdicts.{suffix}").read_text()
        assert of_sentences(text.partition("Best: ")[2]) == words
        assert f"Best: {best};" in text


@pytest.mark.parametrize("width", [30, 200])
def test_the_terminal_agrees(study, width):
    analysis, words, best = study
    out = io.StringIO()
    print_analysis(Console(file=out, width=width), analysis)
    text = out.getvalue()
    assert f"Best: {best};" in " ".join(text.split())
    if width == 30:  # too narrow for a table of words
        assert of_sentences(text.partition("Best: ")[2]) == words
        return
    head = next(line for line in text.splitlines() if " vs " in line)
    names = re.findall(r"vs (\w+)", head)
    lines = text.splitlines()[text.splitlines().index(head) + 1 :][: len(names)]
    rows = []  # a triangle: a row and columns of agents
    for line in lines:
        first, *cells = re.split(r"\s{2,}", line.strip())
        rows += [(first, *both) for both in zip(cells, names[-len(cells) :], strict=True)]
    assert both_ways(rows) == words


def test_the_page_and_the_data_of_its_figures_agree(study):
    analysis, words, best = study
    (place,) = analysis.environments
    one = EnvironmentSeries(place, None, None, {})
    report = Report(StudySeries(analysis, agent_marks(analysis.study), (one,)), "compare")
    sections = [result_sections.verdict(report), result_sections.comparison(report)]
    page = Page(render(report, sections))
    text = page.sections["verdict"]
    assert f"Best: {best};" in text
    assert of_sentences(text.partition("All pairs in words")[2]) == words
    cells = [
        (*attributes["title"].split(" against "), word.strip())
        for attributes, word in page.all("td")
        if attributes.get("class", "").startswith("verdict ")
    ]
    assert both_ways((first, word, second) for first, second, word in cells) == words
    chips = [word.strip() for a, word in page.all("span") if "chip" in a.get("class", "")]
    assert chips == [words[pair.first, pair.second] for pair in place.pairs]
