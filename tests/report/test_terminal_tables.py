"""What a study says in the terminal, line by line: into a pipe and on screens of two widths."""

import io
import re

import numpy as np
import pandas as pd
import pytest
from rich.console import Console

from experiments.bandits import pull_statistics
from report.conclusions import conclusion
from report.terminal import print_analysis, print_episodes_table
from verdicts import FailureCount, PairComparison, ThresholdSummary

ESCAPES = re.compile(r"\x1b\[[0-9;]*m")


def lines_of(write, width=120, **options):
    """What is printed, and the same without colours, as lines without trailing blanks."""
    file = io.StringIO()
    write(Console(markup=False, file=file, width=width, **options))
    raw = file.getvalue()
    return raw, [line.rstrip() for line in ESCAPES.sub("", raw).splitlines()]


def cells(lines):
    """The table cell by cell, those of a row that goes over several lines joined."""
    rows, before = [], ""
    for line in lines:
        if line.startswith(("┃", "│")):
            parts = [part.strip() for part in re.split("[┃│]", line)[1:-1]]
            if (line[0] == "┃" and before.startswith("┃")) or (line[0] == "│" and not parts[0]):
                rows[-1] = [f"{a} {b}".strip() for a, b in zip(rows[-1], parts, strict=True)]
            else:
                rows.append(parts)
        before = line
    return rows


@pytest.fixture
def analysis(made_up):
    """Two agents, of which the worse is the faster; runs of theirs and of a third are missing."""
    agents = (made_up.agent("first", 90.0), made_up.agent("second", 40.0))
    pair = PairComparison(
        first="first",
        second="second",
        difference=made_up.estimate(50.0, 45.0, 55.0),
        p_value=0.001,
        adjusted_p_value=0.001,
        probability_of_improvement=made_up.estimate(1.0, 0.9, 1.0),
        verdict="better",
        seeds_needed=None,
    )
    missing = {"first": 0, "second": 1, "third": 4}
    place = made_up.environment(agents, pairs=(pair,), missing=missing)
    return made_up.analysis([place], ["first", "second", "third"])


HEADINGS = ["agent", "mean", "IQM", "score", "training", "stays from", "solved", "CPU time"]
ROWS = [
    [
        "first",
        "90 [89.9, 90.2]",
        "92 [91.9, 92.2]",
        "0.9 [0.8, 1.1]",
        "95 [94.9, 95.2]",
        "100",
        "75%",
        "99 s",
    ],
    [
        "second",
        "40 [39.9, 40.2]",
        "42 [41.9, 42.2]",
        "0.4 [0.3, 0.6]",
        "45 [44.9, 45.2]",
        "50",
        "75%",
        "49 s",
    ],
]
TABLE = """\
┏━━━━━━━━┳━━━━━━━━━━━━━━━━━┳━━━━━━━━━━━━━━━━━┳━━━━━━━━━━━━━━━━┳━━━━━━━━━━━━━━━━━┳━━━━━━━━━━━━┳━━━━━━━━┳━━━━━━━━━━┓
┃ agent  ┃            mean ┃             IQM ┃          score ┃        training ┃ stays from ┃ solved ┃ CPU time ┃
┡━━━━━━━━╇━━━━━━━━━━━━━━━━━╇━━━━━━━━━━━━━━━━━╇━━━━━━━━━━━━━━━━╇━━━━━━━━━━━━━━━━━╇━━━━━━━━━━━━╇━━━━━━━━╇━━━━━━━━━━┩
│ first  │ 90 [89.9, 90.2] │ 92 [91.9, 92.2] │ 0.9 [0.8, 1.1] │ 95 [94.9, 95.2] │        100 │    75% │     99 s │
│ second │ 40 [39.9, 40.2] │ 42 [41.9, 42.2] │ 0.4 [0.3, 0.6] │ 45 [44.9, 45.2] │         50 │    75% │     49 s │
└────────┴─────────────────┴─────────────────┴────────────────┴─────────────────┴────────────┴────────┴──────────┘
"""  # noqa: E501  # as wide as it is printed
CAPTION = (
    "mean, IQM: return of the final policy, with 95 % intervals over 4 seeds; training: return of "
    "the last 100 training episodes; stays from: step from which on the median run stays at a "
    "return of 96"
)
NARROW_CAPTION = (
    "mean: return of the final policy, with 95 % intervals over 4 seeds; stays from: step from "
    "which on the median run stays at a return of 96; a wider terminal shows training and IQM too"
)
SENTENCES = [
    ("first is best: return of the final policy 90 [89.9, 90.2], score 0.9; the optimum is 100."),
    "first is better than second (by 50 [45, 55]).",
    (
        "second reaches a score of 0.95 and keeps it to the end in 3 of 4 runs, the "
        "median one from step 50 on; first in 3 of 4 runs, the median one from step 100 on."
    ),
    "1 of 4 runs of second is missing.",
    "No run of third has finished.",
]


def below(lines):
    """Caption and sentences, whose lines are broken at the width, as one line."""
    end = max(place for place, line in enumerate(lines) if line.startswith("└"))
    return " ".join(" ".join(lines[end + 1 :]).split())


@pytest.mark.parametrize("width", [80, 120])
@pytest.mark.parametrize("is_terminal", [False, True])
def test_a_title_a_table_a_caption_and_sentences(analysis, width, is_terminal):
    _, lines = lines_of(
        lambda console: print_analysis(console, analysis), width, force_terminal=is_terminal
    )
    assert lines[:2] == ["", "lake: optimum 100, best random or constant policy 20"]
    origin = "Seeds 0 to 3: nothing was tuned on these."
    if width == 120:
        assert cells(lines) == [HEADINGS, *ROWS]
        assert below(lines) == " ".join([CAPTION, *SENTENCES, origin])
    else:
        kept = [place for place, name in enumerate(HEADINGS) if name not in {"training", "IQM"}]
        assert cells(lines) == [[row[place] for place in kept] for row in [HEADINGS, *ROWS]]
        assert below(lines) == " ".join([NARROW_CAPTION, *SENTENCES, origin])
    assert max(map(len, lines)) <= width
    assert not any("…" in line for line in lines)


@pytest.mark.parametrize("width", [60, 80, 120, 200])
def test_no_figure_is_cut_and_no_border_lost(made_up, width):
    agents = [
        made_up.agent(name, -27_427.0)
        for name in ("a name that is longer than twenty letters", "second")
    ]
    analysis = made_up.analysis([made_up.environment(agents)], [a.agent for a in agents])
    _, lines = lines_of(lambda console: print_analysis(console, analysis), width)
    assert max(map(len, lines)) <= width
    assert not any("…" in line for line in lines)
    (top,) = [line for line in lines if line.startswith("┏")]
    (bottom,) = [line for line in lines if line.startswith("└")]
    assert top.endswith("┓")
    assert len(top) == len(bottom)
    headings, *rows = cells(lines)
    assert rows[-1][:2] == ["second", "-27,427 [-27,427, -27,427]"]
    assert ("training" in headings) is (width == 200)
    # One line for each row, but for the long name's.
    assert sum(line.startswith("│") for line in lines) == 4


def test_a_pipe_gets_no_colours_and_a_terminal_the_same_words(analysis):
    pipe, plain = lines_of(lambda console: print_analysis(console, analysis))
    screen, coloured = lines_of(
        lambda console: print_analysis(console, analysis), force_terminal=True
    )
    assert not ESCAPES.search(pipe)
    assert ESCAPES.search(screen)
    assert plain == coloured


def test_figures_stand_on_the_right_and_names_on_the_left(analysis):
    _, lines = lines_of(lambda console: print_analysis(console, analysis))
    assert lines[2:8] == TABLE.splitlines()


def test_a_sentence_for_each_verdict_begins_a_line(analysis):
    _, lines = lines_of(lambda console: print_analysis(console, analysis))
    said = conclusion(analysis.study, analysis.environments[0])
    assert list(said.everything) == SENTENCES
    for sentence in SENTENCES:
        assert any(sentence.startswith(line.strip()) for line in lines if line.strip())


def test_three_agents_have_their_verdicts_in_a_matrix(made_up):
    agents = [made_up.agent(name, mean) for name, mean in (("a", 90.0), ("[b]", 80.0), ("c", 70.0))]
    pairs = [
        made_up.pair("a", "[b]", "worse"),
        made_up.pair("a", "c", "undecided"),
        made_up.pair("[b]", "c", "equivalent"),
    ]
    failed = {"a": FailureCount(0, 4, 0.6), "c": FailureCount(1, 4, 0.8)}
    place = made_up.environment(agents, pairs=tuple(pairs), failures=failed)
    found = made_up.analysis([place], ["a", "[b]", "c"])
    _, lines = lines_of(lambda console: print_analysis(console, found))
    place = next(i for i, line in enumerate(lines) if line.split() == ["1", "2", "3"])
    assert [line.split() for line in lines[place + 1 : place + 4]] == [
        ["1", "a", "·", "<", "?"],
        ["2", "[b]", ">", "·", "="],
        ["3", "c", "?", "=", "·"],
    ]
    assert lines[place + 4] == (
        "> better than the agent of the column, < worse, = equivalent, ? undecided"
    )
    assert lines[place + 5] == (
        "1 of 4 runs of c failed: what is equivalent is so in the typical run."
    )
    assert not any("is undecided against" in line for line in lines)


def test_agents_that_were_trained_on_a_changed_environment_are_marked(made_up):
    agents = made_up.agent("first", 90.0), made_up.agent("second", 40.0, changes=("slip 0.1",))
    found = made_up.analysis([made_up.environment(agents)], ["first", "second"])
    _, lines = lines_of(lambda console: print_analysis(console, found), width=200)
    assert [row[0] for row in cells(lines)[1:]] == ["first", "second †"]
    assert "†: trained on a changed environment: second (slip 0.1)." in lines


def test_returns_of_a_training_variant_are_marked(made_up):
    agents = made_up.agent("first", 90.0), made_up.agent("second", 40.0, on_variant=True)
    found = made_up.analysis([made_up.environment(agents)], ["first", "second"])
    _, lines = lines_of(lambda console: print_analysis(console, found), width=200)
    _, *rows = cells(lines)
    assert [row[HEADINGS.index("training")] for row in rows] == [
        "95 [94.9, 95.2]",
        "45 [44.9, 45.2] *",
    ]
    mark = "return of the last 100 training episodes (*: on a variant of the environment);"
    assert mark in " ".join(line.strip() for line in lines)


@pytest.mark.parametrize("metric", ["final", "training", "last_episodes"])
def test_verdicts_on_training_say_which_agents_had_a_variant(made_up, metric):
    names = ["first", "second", "third"]
    agents = [made_up.agent(name, 90.0, on_variant=name != "first") for name in names]
    place = made_up.environment(agents)
    said = conclusion(made_up.study(names, metric=metric), place).notes
    sentence = (
        "second and third were trained on a variant of the environment, with returns of its own."
    )
    assert (sentence in said) is (metric != "final")
    # Once more with all on the environment itself.
    place = made_up.environment([made_up.agent(name, 90.0) for name in names])
    assert not any(
        "variant" in text for text in conclusion(made_up.study(names, metric=metric), place).notes
    )


def test_an_agent_without_a_figure_has_a_dash(made_up):
    nothing = ThresholdSummary(made_up.nothing, made_up.nothing)
    without = made_up.agent(
        "without",
        1.0,
        score=None,
        last_episodes=made_up.nothing,
        steps_to_stay=nothing,
    )
    place = made_up.environment([made_up.agent("with", 2.0), without])
    analysis = made_up.analysis([place], ["with", "without"])
    _, lines = lines_of(lambda console: print_analysis(console, analysis))
    assert cells(lines)[2] == ["without", "1 [0.9, 1.2]", "3 [2.9, 3.2]", *"----", "10 s"]


def test_what_applies_to_no_agent_has_no_column_and_no_explanation(made_up):
    agent = made_up.agent("alone", 1.0, score=None, steps_to_stay=None, episodes_to_stay=None)
    place = made_up.environment([agent], optimum=None, baseline=None, threshold=None)
    _, lines = lines_of(
        lambda console: print_analysis(console, made_up.analysis([place], ["alone"]))
    )
    assert lines[1] == "lake"
    assert cells(lines)[0] == ["agent", "mean", "IQM", "training", "CPU time"]
    assert "stays from" not in below(lines)


@pytest.mark.parametrize("name", ["[red]", "a name that is longer than twenty letters"])
def test_names_are_text_and_are_printed_whole(made_up, name):
    place = made_up.environment([made_up.agent(name, 1.0)])
    analysis = made_up.analysis([place], [name])
    _, lines = lines_of(lambda console: print_analysis(console, analysis), 80)
    shown = "".join(row[0] for row in cells(lines)[1:])
    assert shown.replace(" ", "") == name.replace(" ", "")


# --- bandits -------------------------------------------------------------------------------------

# Arm 0 costs .3 a pull and arm 1 nothing; two runs of four pulls.
ARMS = np.array([[0, 1, 1, 0], [1, 1, 0, 1]], dtype=np.int16)
REWARDS = np.array([[1, 0, 1, 1], [0, 1, 1, 0]], dtype=np.float32)


@pytest.mark.parametrize("width", [80, 120])
def test_bandits_have_a_table_of_their_own(made_up, width):
    pulls = pull_statistics(ARMS, REWARDS, np.where(ARMS == 0, 0.3, 0.0), None, 2)
    agents = (made_up.agent("first", 1.0), made_up.agent("no pulls", 3.0))
    place = made_up.environment(agents, "coins", optimum=None)
    analysis = made_up.analysis(
        [place], ["first", "no pulls"], pulls={("first", "coins"): pulls}, metric="regret"
    )
    _, lines = lines_of(lambda console: print_analysis(console, analysis), width)
    assert lines[1] == "coins"
    # The sums of regret are .6 and .3, and the last pulls .3 and 0; the last rewards 1 and 0.
    headings = ["agent", "mean regret", "5% to 95% of runs", "simple regret", "reward", "best arm"]
    row = ["first", "7 [6.9, 7.2]", "0.315 to 0.585", "0.15", "0.5", "50.0%", "10 s"]
    table = [[*headings, "CPU time"], row]
    regret = "regret: sum over the pulls of a run, with 95 % intervals over 4 runs; "
    simple = "simple regret: of recommending the arm pulled most; "
    last = "reward, best arm: at the last pulls"
    sentence = (
        " Undecided: 4 seeds decide nothing. first has the lowest mean so far: regret of a run "
        "1 [0.9, 1.2]."
    )
    if width == 120:
        assert cells(lines) == table
        assert below(lines).startswith(regret + simple + last + sentence)
    else:
        assert cells(lines) == [[*row[:3], *row[4:]] for row in table]
        more = "; a wider terminal shows simple regret too"
        assert below(lines).startswith(regret + last + more + sentence)


# --- blocks of episodes --------------------------------------------------------------------------


def test_blocks_of_episodes_agents_side_by_side():
    table = pd.DataFrame(
        {
            "environment": ["lake", "lake", "lake", "island"],
            "agent": ["first", "first", "second", "first"],
            "episode": [1000, 2000, 1000, 1000],
            "average": [1.5, 2, 3, 4],
            "minimum": [0, 1, 2, 3],
            "maximum": [5, 6, 7, 8],
        }
    )
    _, lines = lines_of(lambda console: print_episodes_table(console, table, 1000))
    titles = " ".join(line for line in lines if not line.startswith(tuple("┏┃┡│└")))
    assert " ".join(titles.split()) == " ".join(
        f"{place}: return per 1000 episodes (average, min, max; all seeds)"
        for place in ("lake", "island")
    )
    assert cells(lines) == [
        ["episode", "first", "second"],
        ["1,000", "1.5  0  5", "3  2  7"],
        ["2,000", "2  1  6", "-"],
        ["episode", "first"],
        ["1,000", "4  3  8"],
    ]


@pytest.mark.parametrize("width", [80, 100, 200])
def test_agents_for_whom_there_is_no_room_beside_the_others_come_below(width):
    names = ["qlearning", "expected_sarsa", "dqn, engine: auto", "a name of more than 20 letters"]
    returns = {"average": -27_427.5, "minimum": -30_000.25, "maximum": -200.25}
    rows = [
        {"environment": "lake", "agent": name, "episode": 100, **returns, "maximum": place}
        for place, name in enumerate(names)
    ]
    _, lines = lines_of(
        lambda console: print_episodes_table(console, pd.DataFrame(rows), 100), width
    )
    assert max(map(len, lines)) <= width
    found = [row for row in cells(lines) if row[0] != "episode"]
    ends = [int(cell.split()[-1]) for row in found for cell in row[1:]]
    assert ends == [*range(len(names))]
    assert all(cell.startswith("-27,428  -30,000  ") for row in found for cell in row[1:])
