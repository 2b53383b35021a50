"""What the columns of the ranking say, and which of them the page shows."""

import math

import pytest

from report.page import result_sections
from report.page.frame import Report
from report.ranking import BANDIT_COLUMNS, COLUMNS, Row, bar, filled
from report.series import StudySeries
from verdicts import Estimate, ThresholdSummary


@pytest.fixture
def ranking(made_up):
    """Headings of the page's table and its rows, of agents on an environment."""

    def make(agents, metric="final", **changes):
        place = made_up.environment(agents, **changes)
        labels = [agent.agent for agent in agents]
        analysis = made_up.analysis([place], labels, metric=metric)
        section = result_sections.ranking(Report(StudySeries(analysis, {}, ()), ""))
        (table,) = section.context["tables"]
        return table["headings"], table["rows"]

    return make


def test_headings_in_their_order(ranking, made_up):
    headings, _ = ranking([made_up.agent("first", 90.0)])
    assert [(heading["title"], heading["help"], heading["order"]) for heading in headings] == [
        ("Mean", "over seeds", "descending"),
        ("IQM", "middle half", "descending"),
        ("Median", "over seeds", "descending"),
        ("Score", "1 is optimal", "descending"),
        ("Gap", "to the optimum", "ascending"),
        ("Success", "in the end", "descending"),
        ("Stays from", "step, at 96", "ascending"),
        ("Episodes", "to stay at 96", "ascending"),
        ("CPU time", "seconds of training", "ascending"),
        ("Runs", "finished", "descending"),
    ]


def test_figures_of_each_agent_the_best_first(ranking, made_up):
    _, rows = ranking([made_up.agent("first", 90.0), made_up.agent("second", 40.0, n_missing=1)])
    assert [row.agent for row, _ in rows] == ["first", "second"]
    assert [[(cell.text, cell.note) for cell in cells] for _, cells in rows] == [
        [
            ("90", "89.9 to 90.2"),
            ("92", "91.9 to 92.2"),
            ("91", "90.9 to 91.2"),
            ("0.9", "0.8 to 1.1"),
            ("7", "6.8 to 7.1"),
            ("50.0%", "25% to 62%"),
            ("100", "75% of runs"),
            ("98", "75% of runs"),
            ("99", "98.9 to 99.2"),
            ("4", ""),
        ],
        [
            ("40", "39.9 to 40.2"),
            ("42", "41.9 to 42.2"),
            ("41", "40.9 to 41.2"),
            ("0.4", "0.3 to 0.6"),
            ("57", "56.8 to 57.1"),
            ("50.0%", "25% to 62%"),
            ("50", "75% of runs"),
            ("48", "75% of runs"),
            ("49", "48.9 to 49.2"),
            ("4", "1 missing"),
        ],
    ]


def test_cells_are_sorted_by_their_figures(ranking, made_up):
    _, ((_, cells),) = ranking([made_up.agent("first", 90.0)])
    values = [90, 92, 91, 0.9, 7, 0.5, 100, 98, 99, 4]
    assert [cell.value for cell in cells] == pytest.approx(values)
    assert [cell.bar for cell in cells] == [None] * 3 + [(0.8, 0.9, 1.0)] + [None] * 6


def test_the_lowest_regret_is_the_best(ranking, made_up):
    headings, _ = ranking([made_up.agent("first", 90.0)], metric="regret")
    orders = {heading["title"]: heading["order"] for heading in headings}
    assert {orders[title] for title in ("Mean", "IQM", "Median")} == {"ascending"}
    assert (orders["Score"], orders["Gap"]) == ("descending", "ascending")


def test_the_gap_to_a_bracket_goes_from_one_end_to_the_other(made_up):
    agent = made_up.agent("first", 90.0, final=made_up.estimate(93.0, 92.0, 95.0))
    (gap,) = [column for column in COLUMNS if column.page == "Gap"]
    place = made_up.environment([agent], optimum=100.0, optimum_at_least=97.0)
    cell = gap.cell(Row(agent, place))
    assert (cell.text, cell.note) == ("7", "2 to 8")


def test_what_applies_to_no_agent_has_no_column(ranking, made_up):
    agent = made_up.agent(
        "alone",
        1.0,
        score=None,
        success_rate=None,
        steps_to_stay=None,
        episodes_to_stay=None,
    )
    headings, _ = ranking([agent], optimum=None, baseline=None, threshold=None)
    titles = [heading["title"] for heading in headings]
    assert titles == ["Mean", "IQM", "Median", "CPU time", "Runs"]


def test_an_agent_without_a_figure_comes_last_and_has_a_dash(ranking, made_up):
    nothing = made_up.nothing
    without = made_up.agent(
        "without",
        math.nan,
        score=None,
        final=nothing,
        success_rate=nothing,
        steps_to_threshold=ThresholdSummary(nothing, nothing),
        steps_to_stay=ThresholdSummary(nothing, nothing),
        seconds=nothing,
    )
    headings, (_, (_, cells)) = ranking([made_up.agent("with", 2.0), without])
    found = {h["title"]: cell for h, cell in zip(headings, cells, strict=True)}
    for title in ("Mean", "Score", "Gap", "Success", "Stays from", "CPU time"):
        assert (found[title].text, found[title].value, found[title].note) == ("-", None, ""), title
    assert found["Stays from"].aside == ""


def test_a_run_that_does_not_stay_says_so_and_its_crossing_only_aside(ranking, made_up):
    never = ThresholdSummary(Estimate(math.inf, 10, math.inf, 4), Estimate(0.25, 0, 0.5, 4))
    headings, ((_, cells),) = ranking([made_up.agent("slow", 1.0, steps_to_stay=never)])
    (place,) = [i for i, heading in enumerate(headings) if heading["title"] == "Stays from"]
    assert (cells[place].text, cells[place].value) == ("never", math.inf)
    assert cells[place].note == "25% of runs"
    assert cells[place].aside == (
        "75% of runs are there at some evaluation, the median run first at step 8"
    )


def test_no_two_columns_have_one_name(made_up):
    for columns in (COLUMNS, BANDIT_COLUMNS):
        for names in ([c.page for c in columns], [c.terminal for c in columns]):
            named = [name for name in names if name]
            assert len(named) == len(set(named))
    row = Row(made_up.agent("first", 1.0), made_up.environment())
    assert len(filled(COLUMNS, [row])) == len(COLUMNS)


def test_a_bar_stays_between_the_blind_policy_and_the_optimum():
    assert bar(Estimate(-3.0, -4.0, 0.25, 4)) == (0, 0, 0.25)
    assert bar(Estimate(0.5, math.nan, math.nan, 1)) == (0.5, 0.5, 0.5)
    assert bar(Estimate(math.nan, math.nan, math.nan, 0)) == (0, 0, 0)
