"""A study as tables: in Markdown, in LaTeX, on the page, and in terminals of any width."""

import io
import math
import re
from dataclasses import replace
from pathlib import Path

import pytest

from rl_yardstick.commands.terminal import TextConsole
from rl_yardstick.report import documents, words
from rl_yardstick.report.documents import MARKUPS, headline, ranking, table_as
from rl_yardstick.report.page import result_sections
from rl_yardstick.report.page.frame import Report
from rl_yardstick.report.ranking import COLUMNS, Row
from rl_yardstick.report.series import StudySeries
from rl_yardstick.report.terminal import print_analysis
from rl_yardstick.report.words import conclusion
from rl_yardstick.verdicts import Best, Estimate, ThresholdSummary
from tests.report import made_up

NAMES = ["low", "same", "open", "first"]
CHANGES = ("random starts", "rewards x 0.01")
CPU = [("first", "lake", s) for s in (30.0, 50.0, 40.4)] + [("same", "lake", 0.1249)]
CPU += [("low", "lake", 1.0), ("low", "lake", None)]  # which was not measured


def lake(**changes):
    """One with the highest mean, one tied with it, one undecided, one worse."""
    agents = [made_up.agent(name, mean) for name, mean in zip(NAMES, (30, 89, 80, 90), strict=True)]
    agents[2] = made_up.failing(replace(agents[2], spread=0.1234), 1, 4)
    best = Best(("first", "same", "open"), tied=False, so_far=False)
    return made_up.environment(**{"agents": agents[::-1], "best": best, **changes})


def of_lake(cpu=(), **changes):
    return made_up.analysis([lake(**changes)], NAMES, cpu=cpu)


LEGEND = (
    "Mean score: 1 is the optimum, 0 the best random or constant policy, and less counts as 0. "
    "±: the standard deviation of runs. Bold: the best agents, where another is worse. In "
    "brackets: processor time of the median run."
)


def test_the_headline_marks_who_is_best_and_counts_failures_and_cost():
    table, legend = table_as("md", headline(of_lake(cpu=CPU))).split("\n\n")
    assert table.splitlines() == [
        "|  | lake |",
        "| --- | --- |",
        "| `low` | 0.3 |",
        "| `same` | **0.89** (0.12 s) |",
        "| `open` | **0.8** ± 0.12, 1 of 4 failed |",
        "| `first` | **0.9** (40 s) |",
    ]
    assert legend == LEGEND
    assert words.processor_seconds(of_lake(cpu=CPU).results) == {
        ("first", "lake"): 40.4,
        ("same", "lake"): 0.1249,
    }


def test_agents_that_were_trained_on_a_changed_environment_have_a_mark_and_a_footnote():
    names = ["plain", "changed", "too"]
    agents = [made_up.agent(n, 90, changes=() if n == "plain" else CHANGES) for n in names]
    one, other = made_up.environment(agents), made_up.environment(agents[:1], "other")
    found = made_up.analysis([one, other], names)
    what = "(random starts, rewards x 0.01)."
    told = f"†: trained on a changed environment: changed and too on lake {what}"
    text, latex = (table_as(markup, headline(found)) for markup in MARKUPS)
    assert re.findall(r"^\| (`\w+`(?: †)?) \|", text, re.M) == ["`plain`", "`changed` †", "`too` †"]
    assert text.endswith(told)
    assert r"\texttt{changed} $\dagger$ &" in latex
    assert told.replace("†", r"$\dagger$") in latex
    assert "| `too` † |" in table_as("md", ranking(found.results, one))
    note = f"†: trained on a changed environment: changed and too {what}"
    assert conclusion(found.study, one).notes[-1:] == (note,)
    assert not any("†" in said for said in conclusion(found.study, other).everything)


@pytest.mark.parametrize(
    ("form", "text", "safe"),
    [
        ("latex_text", r"\input{x} $a^b$", r"\textbackslash{}input\{x\} \$a\textasciicircum{}b\$"),
        ("latex_text", "--seeds a---b ,,x ''", r"-{}-seeds a-{}-{}-b ,{},x '{}'"),
        ("latex_text", "-1,000 [-2, 3] Lake-v1 -∞", r"$-$1,000 [$-$2, 3] Lake-v1 $-$$\infty$"),
        ("latex_text", "ε = 0.1 ± 2 λ ά Ω", r"$\varepsilon$ = 0.1 $\pm$ 2 $\lambda$ ά Ω"),
        ("markdown_text", "a|b <b>*x*</b> [x](y) `c`", r"a\|b \<b\>\*x\*\</b\> [x\](y) \`c\`"),
        ("name_of", "a`b|", r"a\`b\|"),
    ],
)
def test_nothing_of_a_text_is_markup(form, text, safe):
    assert getattr(documents, form)(text) == safe


def test_whatever_labels_say_every_group_and_environment_of_latex_is_closed():
    names = [r"\end{table}", "a_b & 50%", "[1]", "*$x^2$", "中"]
    agents = [made_up.agent(name, 90 - 10 * n) for n, name in enumerate(names)]
    pairs = (made_up.pair(names[0], names[1], "tied"),)
    found = made_up.analysis([made_up.environment(agents, "lake #1", pairs=pairs)], names)
    text = documents.verdicts_as("tex", found, "python compare.py 'a_b & 50%' --x")
    plain = re.sub(r"\\[{}$&#%_]", "", text)
    assert plain.count("{") == plain.count("}")
    assert plain.count("$") % 2 == 0
    begun, ended = (re.findall(rf"\\{which}\{{(\w+)\}}", plain) for which in ("begin", "end"))
    assert sorted(begun) == sorted(ended)
    assert begun.count("table") == 2  # the headline, and one environment
    for rows in re.findall(r"\\midrule\n(.*?)\\bottomrule", plain, re.DOTALL):
        # What no agent has is left out: the processor time.
        assert {line.count("&") for line in rows.splitlines()} <= {1, 5}
        assert all(line.endswith(r"\\") for line in rows.splitlines())
    # A comment stands at the top alone, and says what the text needs.
    needs, *lines = text.splitlines()
    assert needs == r"% Taken in by \input; above it: \usepackage{booktabs,graphicx}"
    assert "%" not in re.sub(r"\\%|\{%$", "", "\n".join(lines), flags=re.MULTILINE)


def tables_of(agents, **changes):
    """What the page shows of agents on an environment."""
    place = made_up.environment(agents, **changes)
    found = made_up.analysis([place], [agent.agent for agent in agents])
    (table,) = result_sections.ranking(Report(StudySeries(found, {}, ()), "")).context["tables"]
    return table


RANKING = Path(__file__).with_name("ranking.txt").read_text(encoding="utf-8")


def test_figures_of_each_agent_the_best_first():
    agents = [
        made_up.agent("first", 90.0),
        made_up.failing(made_up.agent("second", 40.0, n_missing=1), 2, 4),
    ]
    table = tables_of(agents)
    assert [row.agent for row, _ in table["rows"]] == ["first", "second"]
    cells = [cells for _, cells in table["rows"]]
    shown = [
        [column.page, column.help.format(**table["words"]), order]
        + [f"{row[n].text} {row[n].note}".strip() for row in cells]
        for n, (column, order) in enumerate(zip(table["columns"], table["orders"], strict=True))
    ]
    expected = [[" ".join(x.split()) for x in row.split("|")] for row in RANKING.splitlines()]
    assert shown == expected
    # They are sorted by their figures.
    values = [cell.value for cell in cells[0]]
    assert values == pytest.approx([90, 92, 91, 0.9, 0, 7, 0.5, 100, 98, 99, 4])


def test_a_bracket_a_curve_that_falls_again_and_agents_without_figures():
    one = made_up.agent("first", 90.0, final=made_up.estimate(93.0, 92.0, 95.0))
    (gap,) = [column for column in COLUMNS if column.page == "Gap"]
    cell = gap.cell(Row(one, made_up.environment([one], optimum_at_least=97.0)))
    assert (cell.text, cell.note) == ("7", "2 to 8")  # from one end of the bracket to the other
    never = ThresholdSummary(Estimate(math.inf, 10, math.inf, 4), Estimate(0.25, 0, 0.5, 4))
    nothing = ThresholdSummary(made_up.NOTHING, made_up.NOTHING)
    without = dict.fromkeys(("final", "success_rate", "seconds"), made_up.NOTHING)
    without |= {"steps_to_threshold": nothing, "steps_to_stay": nothing, "score": None}
    agents = [
        made_up.agent("slow", 1.0, steps_to_stay=never),
        made_up.agent("without", math.nan, **without),
    ]
    table = tables_of(agents)
    titles = [column.page for column in table["columns"]]
    (_, slow), (_, absent) = table["rows"]
    stays = slow[titles.index("Stays from")]
    assert (stays.text, stays.value, stays.note) == ("never", math.inf, "25% of runs")
    for title in ("Mean", "Score", "Gap", "Stays from", "CPU time"):
        cell = absent[titles.index(title)]
        assert (cell.text, cell.value, cell.note, cell.aside) == ("-", None, "", ""), title


LONG_NAMES = ["double_expected_sarsa_with_a_long_name", "an agent of many short words here", "x"]
LARGE = -12_345_678.0


def agents_table(console):
    far = [made_up.estimate(LARGE, LARGE - 7654, LARGE + 1234) for _ in range(2)]
    figures = dict(zip(("metric", "final"), far, strict=False))
    figures["metric"] = replace(made_up.agent("x", 1.0).metric, mean=far[0], median=far[1])
    agents = [made_up.agent(name, 1000.0 * n, **figures) for n, name in enumerate(LONG_NAMES)]
    place = made_up.environment(agents, optimum=123_456.0)
    print_analysis(console, made_up.analysis([place], LONG_NAMES))


def printed(table, width, is_terminal):
    file = io.StringIO()
    table(TextConsole(file=file, width=width, force_terminal=is_terminal, color_system=None))
    return file.getvalue()


def numbers(text):
    return re.findall(r"[-+]?\d[\d,.]*", text.replace("\N{MINUS SIGN}", "-"))


def test_no_digit_is_cut_and_no_column_missed_at_any_width():
    whole = printed(agents_table, 400, False)
    headings = {part.strip() for part in re.split("[┃│\n]", whole) if part.strip()}
    headings = headings & {"IQM", "mean"}
    for width in (40, 60, 72, 80):
        for is_terminal in (False, True):
            shown = printed(agents_table, width, is_terminal)
            assert set(numbers(shown)) <= set(numbers(whole)), (width, is_terminal)
            assert all(re.search(rf"\b{each}\b", shown) for each in headings)
            rows = [line for line in shown.splitlines() if line[:1] in "┃│┏└"]
            if width >= 60:
                assert rows
                assert max(map(len, rows)) <= width
            assert "…" not in shown
    lines = printed(lambda console: print_analysis(console, of_lake()), 120, False).splitlines()
    shown = [[cell.find(".") for cell in line.split("│")] for line in lines if line[:1] == "│"]
    assert shown == shown[:1] * 4
