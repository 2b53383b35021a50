"""One study says one word about each pair, wherever it is shown."""

import io
import json
import re

import pandas as pd
import pytest
from rich.console import Console

from rl_yardstick.report.documents import write_verdicts
from rl_yardstick.report.page import render, result_sections
from rl_yardstick.report.page.frame import Report
from rl_yardstick.report.series import EnvironmentSeries, StudySeries, agent_marks, run_series
from rl_yardstick.report.terminal import print_analysis
from rl_yardstick.verdicts import judge
from tests.report.test_page import Page
from tests.report.test_sentences import study_of

RUNS = {
    "best": [1.0] * 12,
    "same": [1.0] * 12,
    "noisy": [1.0, 0.4, 1.0, 0.7] * 3,
    "bad": [0.2, 0.3, 0.25, 0.2] * 3,
}


@pytest.fixture(scope="module", params=[12, 4], ids=["many", "few"])
def study(request, tmp_path_factory):
    """The analysis, its words by pair, and all files."""
    runs = {name: values[: request.param] for name, values in RUNS.items()}
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


def of_table(lines, names):
    """The words in a triangle: a row and columns of agents."""
    rows = [(first, word, second) for first, cells in lines for second, word in zip(
            names[len(names) - len(cells):], cells, strict=True)]  # fmt: skip
    return both_ways(rows)


def test_python_csv_and_json_agree(study):
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


@pytest.mark.parametrize("width", [30, 200])
def test_the_terminal_agrees(study, width):
    analysis, words, best = study
    out = io.StringIO()
    print_analysis(Console(file=out, width=width), analysis)
    text = out.getvalue()
    assert f"Best: {best};" in " ".join(text.split())
    if width == 30:  # too narrow for a table of words
        assert of_sentences(text) == words
        return
    head = next(line for line in text.splitlines() if " vs " in line)
    names = re.findall(r"vs (\w+)", head)
    lines = text.splitlines()[text.splitlines().index(head) + 1 :][: len(names)]
    cells = [(line.split()[0], re.split(r"\s{2,}", line.strip())[1:]) for line in lines]
    assert of_table(cells, names) == words


def test_markdown_and_latex_agree(study):
    analysis, words, best = study
    for suffix in ("md", "tex"):
        text = (analysis.results.root / f"verdicts.{suffix}").read_text()
        assert of_sentences(text.partition("Best: ")[2]) == words
        assert f"Best: {best};" in text


def test_the_page_and_the_data_of_its_figures_agree(study):
    analysis, words, best = study
    (place,) = analysis.environments
    one = EnvironmentSeries(place, None, run_series(analysis.results, place), None, {})
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
    data = page.data("data-comparison-0")
    drawn = [(key.split(" | "), word) for key, word in data["words"].items()]
    assert both_ways((first, word, second) for (first, second), word in drawn) == words
