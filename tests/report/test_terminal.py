"""Tables in terminals of any width: no digit is cut, and a caption names the columns left out."""

import io
import re
from dataclasses import replace

import numpy as np
import pandas as pd
import pytest

from rl_yardstick.commands.terminal import TextConsole
from rl_yardstick.experiments.off_policy import Comparison, Judged, PolicyTerms
from rl_yardstick.report.terminal import print_analysis, print_comparison, print_episodes_table
from tests.report import made_up

NAMES = ["double_expected_sarsa_with_a_long_name", "an agent of many short words here", "x"]
LARGE = -12_345_678.0


def agents_table(console):
    far = [made_up.estimate(LARGE, LARGE - 7654, LARGE + 1234) for _ in range(4)]
    figures = dict(zip(("metric", "judged", "final", "area"), far, strict=True))
    figures["metric"] = replace(made_up.agent("x", 1.0).metric, mean=far[0], median=far[1])
    agents = [made_up.agent(name, 1000.0 * n, **figures) for n, name in enumerate(NAMES)]
    place = made_up.environment(agents, optimum=123_456.0)
    print_analysis(console, made_up.analysis([place], NAMES))


def bandit_table(console):
    agents = [made_up.agent(name, 98_765.0, regret=made_up.estimate(LARGE)) for name in NAMES]
    pulls = {(name, "lake"): made_up.pulls(LARGE) for name in NAMES}
    print_analysis(console, made_up.analysis([made_up.environment(agents)], NAMES, pulls=pulls))


def logged_table(console):
    terms = np.array([12_345.0, 23_456.0])
    rows = [
        Judged(
            f"logs/linucb/{name}", PolicyTerms(*[k * terms] * 3, 1669.0 * k, terms, terms), k > 1
        )
        for k, name in enumerate(NAMES, start=1)
    ]

    class Log:
        source, n_arms = "log.csv", 2
        __len__ = lambda _: 5000  # noqa: E731

    print_comparison(console, Comparison(Log(), tuple(rows), ()))


def episodes(console):
    columns = ["environment", "agent", "episode", "average", "minimum", "maximum"]
    rows = [("lake", name, 50_000, LARGE, 9 * LARGE, 87_654.0) for name in NAMES]
    print_episodes_table(console, pd.DataFrame(rows, columns=columns), 50)


def printed(table, width, is_terminal):
    file = io.StringIO()
    table(TextConsole(file=file, width=width, force_terminal=is_terminal, color_system=None))
    return file.getvalue()


def numbers(text):
    return re.findall(r"[-+]?\d[\d,.]*", text.replace("\N{MINUS SIGN}", "-"))


@pytest.mark.parametrize("table", [agents_table, bandit_table, logged_table, episodes])
def test_no_digit_is_cut_and_no_column_missed_at_any_width(table):
    whole = printed(table, 400, False)
    headings = {part.strip() for part in re.split("[┃│\n]", whole) if part.strip()}
    headings = headings & {"IPS", "self-normalised", "effective", "IQM", "reward", "mean"}
    for width in (40, 60, 72, 80):
        for is_terminal in (False, True):
            shown = printed(table, width, is_terminal)
            assert set(numbers(shown)) <= set(numbers(whole)), (width, is_terminal)
            assert all(re.search(rf"\b{each}\b", shown) for each in headings)
            rows = [line for line in shown.splitlines() if line[:1] in "┃│┏└"]
            if width >= 60:
                assert rows
                assert max(map(len, rows)) <= width
            assert "…" not in shown
