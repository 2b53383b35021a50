"""The study as Markdown: marks, failures and cost in one table; labels are never markup."""

import math
from dataclasses import replace

import pandas as pd
import pytest

from report.conclusions import conclusion
from report.documents import (
    duration,
    headline,
    markdown_text,
    name_of,
    processor_seconds,
    ranking,
    standings,
    table_as,
    write_verdicts,
)
from verdicts import FailureCount, PairComparison

NAMES = ["low", "same", "open", "first"]


def pair(made_up, first, second, verdict):
    some = made_up.estimate(1.0)
    return PairComparison(first, second, some, 0.5, 0.5, some, verdict, None)


@pytest.fixture
def place(made_up):
    """One that leads by its median, one equivalent to it, one undecided, one worse."""
    agents = [made_up.agent(name, mean) for name, mean in zip(NAMES, (30, 89, 80, 90), strict=True)]
    pairs = (
        pair(made_up, "first", "same", "equivalent"),
        pair(made_up, "open", "first", "undecided"),
        pair(made_up, "low", "first", "worse"),
        pair(made_up, "same", "low", "better"),
    )
    failed = {"first": FailureCount(0, 4, 0.6), "open": FailureCount(1, 4, 0.8)}
    return made_up.environment(agents, pairs=pairs, failures=failed)


def analysis_of(made_up, environment, cpu=(), root=None, **fields):
    analysis = made_up.analysis([environment], NAMES, root=root, **fields)
    rows = [
        {"agent": agent, "environment": environment.environment, "cpu_seconds": seconds}
        for agent, times in cpu
        for seconds in times
    ]
    table = pd.DataFrame(rows, columns=["agent", "environment", "cpu_seconds"])
    return replace(analysis, results=replace(analysis.results, summary=table))


CPU = (("first", (30.0, 50.0, 40.4)), ("same", (0.1249,)), ("low", (1.0, None)))


def test_the_headline_marks_who_is_best_and_counts_failures_and_cost(made_up, place):
    table, legend = table_as("md", headline(analysis_of(made_up, place, CPU))).split("\n\n")
    assert table.splitlines() == [
        "|  | lake |",
        "| --- | --- |",
        "| `low` | 0.600 |",
        "| `same` | **1.780** (0.12 s) |",
        "| `open` | 1.600 ?, 1 of 4 failed |",
        "| `first` | **1.800** (40 s) |",
    ]
    assert legend == (
        "Score of the median run: 1 is the optimum, 0 the best random or constant policy. Bold: "
        "the highest, and what is shown to be equivalent to it in the typical run. "
        "?: not told apart from it by 4 seeds. Plain: shown to be worse. In brackets: processor "
        "time of the median run."
    )


def test_agents_that_were_trained_on_a_changed_environment_have_a_mark_and_a_footnote(made_up):
    names, changes = ["plain", "changed", "too"], ("random starts", "rewards x 0.01")
    agents = [made_up.agent(n, 90, changes=() if n == "plain" else changes) for n in names]
    lake, other = made_up.environment(agents), made_up.environment(agents[:1], "other")
    analysis = made_up.analysis([lake, other], names)
    what = "(random starts, rewards x 0.01)."
    told = f"†: trained on a changed environment: changed and too on lake {what}"
    text = table_as("md", headline(analysis))
    assert [line.split(" | ")[0] for line in text.splitlines()[2:5]] == [
        "| `plain`",
        "| `changed` †",
        "| `too` †",
    ]
    assert text.endswith(told)
    latex = table_as("tex", headline(analysis))
    assert r"\texttt{changed} $\dagger$ &" in latex
    assert told.replace("†", r"$\dagger$") in latex
    assert "| `too` † |" in table_as("md", ranking(analysis.results, lake))
    note = f"†: trained on a changed environment: changed and too {what}"
    assert note in conclusion(analysis.study, lake).notes
    assert not any("†" in said for said in conclusion(analysis.study, other).everything)
    assert "†" not in table_as("md", headline(made_up.analysis([other], names)))


def test_other_metrics_show_their_own_figures_and_of_costs_the_lowest_leads(made_up, place):
    analysis = analysis_of(made_up, place, metric="regret")
    text = table_as("md", headline(analysis))
    assert "| `low` | **31** |" in text
    assert "| `open` | 81, 1 of 4 failed |" in text
    assert "Regret of a run: the median run. Bold: the lowest" in text
    assert "processor" not in text


def test_an_agent_without_a_run_has_a_dash_and_missing_runs_are_counted(made_up, place):
    some = made_up.agent("first", 90.0, n_missing=2)
    text = table_as("md", headline(analysis_of(made_up, replace(place, agents=(some,), pairs=()))))
    assert "| `low` | - |" in text
    assert "| `first` | **1.800**, 2 missing |" in text


def test_nobody_leads_where_none_has_learnt_or_there_is_no_figure(made_up, place):
    study = made_up.study(NAMES)
    assert standings(study, replace(place, baseline=95.0)) == {}
    assert standings(study, made_up.environment([made_up.agent("first", math.nan)])) == {}
    assert set(standings(study, place)) == set(NAMES)


def test_cost_is_the_median_of_runs_that_were_all_measured(made_up, place):
    found = processor_seconds(analysis_of(made_up, place, CPU).results)
    assert found == {("first", "lake"): 40.4, ("same", "lake"): 0.1249}


def test_the_ranking_of_an_environment(made_up, place):
    text = table_as("md", ranking(analysis_of(made_up, place, CPU).results, place))
    row = "| `first` | 91 [90.9, 91.2] | 90 [89.9, 90.2] | 1.8 | 0 of 4 | 100 | 40 s |"
    assert row in text.splitlines()
    assert text.splitlines()[0] == (
        "|  | median | mean | score | failed | stays from | processor time |"
    )


def test_the_file_says_the_seeds_first_and_the_verdicts_last(made_up, place, tmp_path):
    paths = write_verdicts(analysis_of(made_up, place, root=tmp_path), "python compare.py a.yml")
    assert [path.name for path in paths] == ["verdicts.md", "verdicts.tex"]
    text = paths[0].read_text(encoding="utf-8")
    parts = text.split("\n\n")
    assert parts[:3] == [
        "# S",
        "`python compare.py a.yml`",
        "Seeds 0 to 3: nothing was tuned on these.",
    ]
    assert "## lake" in parts
    assert parts[-1].startswith("- ")


@pytest.mark.parametrize(
    ("seconds", "text"),
    [(0.1249, "0.12 s"), (0.0, "0 s"), (0.0071, "0.0071 s"), (9.96, "10.0 s"), (44.6, "45 s"),
     (1234.0, "1,200 s")],
)  # fmt: skip
def test_durations(seconds, text):
    assert duration(seconds) == text


def test_nothing_of_a_text_is_markup():
    assert markdown_text("double_dqn by 2 [1, 3]") == "double_dqn by 2 [1, 3]"
    assert (
        markdown_text("a|b <b>*x*</b> [x](y) `c`")
        == "a\\|b \\<b\\>\\*x\\*\\</b\\> [x\\](y) \\`c\\`"
    )
    assert markdown_text("# one\n\ntwo _three_") == "\\# one two \\_three\\_"
    assert name_of("dqn") == "`dqn`"
    assert name_of("a`b|") == "a\\`b\\|"
