"""What the columns of the page's ranking say, what they are sorted by, and which are left out."""

import math

import pytest

from report.page import result_sections
from report.page.frame import Report
from report.ranking import COLUMNS, Row
from report.series import StudySeries
from tests.report import made_up
from verdicts import Estimate, ThresholdSummary


def ranked(agents, metric="final", **changes):
    """Headings of the page's table and its rows, of agents on an environment."""
    place = made_up.environment(agents, **changes)
    found = made_up.analysis([place], [agent.agent for agent in agents], metric=metric)
    (table,) = result_sections.ranking(Report(StudySeries(found, {}, ()), "")).context["tables"]
    return table["headings"], table["rows"]


RANKING = """
Mean       | over seeds          | descending | 90    89.9 to 90.2 | 40    39.9 to 40.2
IQM        | middle half         | descending | 92    91.9 to 92.2 | 42    41.9 to 42.2
Median     | over seeds          | descending | 91    90.9 to 91.2 | 41    40.9 to 41.2
Score      | 1 is optimal        | descending | 0.9   0.8 to 1.1   | 0.4   0.3 to 0.6
Gap        | to the optimum      | ascending  | 7     6.8 to 7.1   | 57    56.8 to 57.1
Success    | in the end          | descending | 50.0% 25% to 62%   | 50.0% 25% to 62%
Stays from | step, at 96         | ascending  | 100   75% of runs  | 50    75% of runs
Episodes   | to stay at 96       | ascending  | 98    75% of runs  | 48    75% of runs
CPU time   | seconds of training | ascending  | 99    98.9 to 99.2 | 49    48.9 to 49.2
Runs       | finished            | descending | 4                  | 4     1 missing
"""


def test_figures_of_each_agent_the_best_first():
    agents = [made_up.agent("first", 90.0), made_up.agent("second", 40.0, n_missing=1)]
    headings, rows = ranked(agents)
    assert [row.agent for row, _ in rows] == ["first", "second"]
    expected = [[" ".join(x.split()) for x in row.split("|")] for row in RANKING.split("\n")[1:-1]]
    assert [
        [*each.values(), *(f"{cells[n].text} {cells[n].note}".strip() for _, cells in rows)]
        for n, each in enumerate(headings)
    ] == expected
    # They are sorted by their figures.
    cells = rows[0][1]
    assert [cell.value for cell in cells] == pytest.approx(
        [90, 92, 91, 0.9, 7, 0.5, 100, 98, 99, 4]
    )
    assert [cell.bar for cell in cells] == [None] * 3 + [(0.8, 0.9, 1.0)] + [None] * 6
    assert cells[6].aside == (
        "75% of runs are there at some evaluation, the median run first at step 97"
    )
    # The lowest regret is the best.
    orders = [heading["order"] for heading in ranked(agents, metric="regret")[0]]
    assert orders == ["ascending"] * 3 + ["descending", *[row[2] for row in expected[4:]]]


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
    headings, ((_, slow), (_, absent)) = ranked(agents)
    titles = [heading["title"] for heading in headings]
    stays = slow[titles.index("Stays from")]
    assert (stays.text, stays.value, stays.note) == ("never", math.inf, "25% of runs")
    for title in ("Mean", "Score", "Gap", "Success", "Stays from", "CPU time"):
        cell = absent[titles.index(title)]
        assert (cell.text, cell.value, cell.note, cell.aside) == ("-", None, "", ""), title
    few = dict.fromkeys(("score", "success_rate", "steps_to_stay", "episodes_to_stay"))
    headings, _ = ranked([made_up.agent("alone", 1.0, **few)], optimum=None, threshold=None)
    assert [heading["title"] for heading in headings] == [
        *("Mean", "IQM", "Median", "CPU time", "Runs")
    ]
