"""Figures as a reader wants them, and the table of episodes."""

import io

import pandas as pd
import pytest
from rich.console import Console

from report.documents import headline
from report.terminal import print_episodes_table
from report.words import number, optimum_words, ordinal, seeds


@pytest.mark.parametrize(
    ("value", "text"),
    [
        (None, "-"),
        (float("nan"), "-"),
        (float("inf"), "never"),
        (float("-inf"), "-∞"),
        (0.0, "0"),
        (-0.00001, "0"),
        (0.74421, "0.7442"),
        (-27427.3, "-27,427"),
        (1234.5, "1,234"),
        (12.345, "12.35"),
    ],
)
def test_a_figure_has_four_digits(value, text):
    assert number(value) == text


@pytest.mark.parametrize(
    ("n", "word"),
    [
        (1, "first"),
        (9, "ninth"),
        (10, "10th"),
        (11, "11th"),
        (13, "13th"),
        (21, "21st"),
        (22, "22nd"),
        (103, "103rd"),
        (1111, "1,111th"),
    ],
)
def test_which_of_several(n, word):
    assert ordinal(n) == word


def test_how_many_seeds():
    assert (seeds(1), seeds(2), seeds(1000)) == ("1 seed", "2 seeds", "1,000 seeds")
    assert (seeds(10, 40, 22), seeds(10, 10), seeds(0, 1)) == (
        "10 to 40 seeds",
        "10 seeds",
        "0 to 1 seed",
    )


@pytest.mark.parametrize(
    ("ends", "text"),
    [
        ((None, None), "-"),
        ((79.0, None), "79"),
        ((-134.442, -140.856), "-140.9 to -134.4 (bracketed)"),
        ((99.94951, 99.94921), "99.949 to 99.950 (bracketed)"),
    ],
)
def test_the_optimum_or_between_what_it_lies(ends, text):
    assert optimum_words(*ends) == text


def test_whose_scores_are_by_a_bracket_is_said_below_the_table(made_up):
    agents = [made_up.agent("a", 90.0)]
    places = [
        made_up.environment(agents),
        made_up.environment(agents, "hill", optimum_at_least=90.0),
    ]
    text = headline(made_up.analysis(places, ["a"])).caption
    assert "policy. On hill the optimum is bracketed: 1 is the upper end. Bold" in text
    assert "bracketed" not in headline(made_up.analysis(places[:1], ["a"])).caption


def test_episodes_stand_in_columns_that_end_on_one_line():
    rows = [("a", 20, 5.0, 1.0, 9.0), ("a", 40, 50.0, 10.0, 90.0), ("b", 20, -700.0, -800.0, 0.5)]
    names = ["agent", "episode", "average", "minimum", "maximum"]
    table = pd.DataFrame(rows, columns=names).assign(environment="Warehouse-v0")
    console = Console(file=io.StringIO(), width=80, force_terminal=False)
    print_episodes_table(console, table, 20)
    text = console.file.getvalue()
    assert " ".join(text.split("┏")[0].split()) == (
        "Warehouse-v0: return per 20 episodes (average, min, max; all seeds)"
    )
    lines = text.splitlines()
    (header,) = [line.split("┃")[1:-1] for line in lines if "┃" in line]
    first, second = [line.split("│")[1:-1] for line in lines if "│" in line]
    assert [cell.strip() for cell in header] == ["episode", "a", "b"]
    assert [cell.strip() for cell in first] == ["20", "5  1  9", "-700  -800  0.5"]
    assert [cell.strip() for cell in second] == ["40", "50  10  90", "-"]
    for line in (header, first, second):
        assert all(cell.endswith(f"{cell.strip()} ") for cell in line)
