"""``enjoy.py --render ansi`` on a terminal: one picture in its place, with figures beside it."""

import io
import time
from types import SimpleNamespace

import numpy as np
import pytest

import train
from commands import enjoy
from commands.enjoy import LiveShow, build_parser, check_playing, figures_table, play
from commands.terminal import TextConsole
from pipeline.action_figures import ActionFigures
from pipeline.errors import UserError
from pipeline.models.model_choice import ModelRequest, choose_model
from pipeline.models.model_loading import load_to_play

REPLACED = "\x1b[1A\x1b[2K"  # up a line, and it is empty


@pytest.fixture
def on_ice(monkeypatch, tmp_path):
    """Trains an agent for so many steps on ice that is not slippery."""

    def trained(n_steps):
        monkeypatch.chdir(tmp_path)
        words = ["--algo", "qlearning", "--env", "FrozenLake-v1", "-n", str(n_steps)]
        words += ["--env-kwargs", "is_slippery:False", "--seed", "0", "--verbose", "0"]
        monkeypatch.setattr("sys.argv", ["train.py", *words])
        assert train.main() == 0
        return choose_model(ModelRequest(algo="qlearning", env_id="FrozenLake-v1"))

    return trained


@pytest.fixture
def lake(on_ice):
    """An agent that walks straight to the goal."""
    return on_ice(3000)


@pytest.fixture
def pauses(monkeypatch):
    """How long it would have waited between pictures."""
    waited = []
    clock = SimpleNamespace(sleep=waited.append, monotonic=time.monotonic)
    monkeypatch.setattr(enjoy, "time", clock)
    return waited


def letters(*words):
    return build_parser().parse_args(["--render", "ansi", *map(str, words)])


def played(chosen, *words, width=100):
    console = TextConsole(file=io.StringIO(), force_terminal=True, width=width, height=40)
    play(console, chosen, letters(*words))
    return console.file.getvalue()


def test_pictures_replace_each_other_at_their_pace(lake, pauses, monkeypatch):
    monkeypatch.setenv("TERM", "xterm")
    shown = played(lake, "--n-episodes", 2, "--fps", 5)
    # Six steps to the goal: seven pictures an episode.
    assert pauses == [0.2] * 14
    assert shown.count("step 0") == 2
    assert shown.count(REPLACED) > 0
    assert "episode 1: return 1.00, 6 steps" in shown
    assert "return 1.00 ± 0.00 over 2 episodes" in without_style(shown)
    # The last picture is the goal, with no step to come.
    last = shown.rindex("episode 2, step 6")
    assert "value" not in shown[last:]


def test_what_the_table_holds_stands_beside_the_map(lake, pauses, monkeypatch):
    monkeypatch.setenv("TERM", "xterm")
    shown = played(lake, "--n-episodes", 1)
    first = shown[: shown.index("step 1")]
    for name in ("left", "down", "right", "up"):
        assert name in first
    model = load_to_play("qlearning", lake.file, None, "cpu", ())
    for number in model.policy.q_table[0]:
        assert f"{number:.4g}" in first
    assert any("SFFF" in line and "left" in line for line in without_style(first).splitlines())
    # Where there is no room beside the map, they stand below it.
    narrow = without_style(played(lake, "--n-episodes", 1, width=30))
    assert any(line.strip() == "SFFF" for line in narrow.splitlines())


def without_style(text):
    from rich.text import Text

    return Text.from_ansi(text).plain


def test_elsewhere_pictures_stand_one_below_the_other(lake, pauses):
    console = TextConsole(file=io.StringIO())
    play(console, lake, letters("--n-episodes", 1))
    shown = console.file.getvalue()
    assert without_style(shown).count("SFFF") == 7
    assert pauses == []
    assert REPLACED not in shown
    assert "value" not in shown


def test_a_playing_that_is_broken_off_shows_where_it_was(lake, pauses, monkeypatch):
    monkeypatch.setenv("TERM", "xterm")
    assert "episode 1, step 3" in played(lake, "-n", 3)


def test_bars_lie_between_the_lowest_and_the_highest():
    table = figures_table(ActionFigures("value", np.array([-1.0, 0.0, 3.0])), 2, ("a", "b"))
    console = TextConsole(file=io.StringIO(), width=60)
    console.print(table)
    rows = [line.split() for line in console.file.getvalue().splitlines()]
    assert rows[1:] == [["a", "-1"], ["b", "0", "###"], [">", "2", "3", "#" * 12]]


def rows_of(table, width=60):
    console = TextConsole(file=io.StringIO(), width=width)
    console.print(table)
    return console.file.getvalue().splitlines()


@pytest.mark.parametrize(("n_shown", "n_rows"), [(20, 20), (5, 5), (0, 1), (-3, 1)])
def test_of_many_actions_the_chosen_one_is_among_those_there_is_room_for(n_shown, n_rows):
    figures = ActionFigures("value", np.arange(100.0))
    rows = rows_of(figures_table(figures, 99, (), n_shown))
    assert len(rows) == 1 + n_rows
    assert rows[-1].split() == [">", "99", "99", "#" * 12]
    rows = rows_of(figures_table(figures, 0, (), n_shown))
    assert len(rows) == 1 + n_rows
    assert rows[1].split() == [">", "0", "0"]


@pytest.mark.parametrize("numbers", [[np.nan, 1.0], [np.inf, 0.0], [0.0, 0.0]])
def test_without_a_range_there_are_no_bars(numbers):
    rows = rows_of(figures_table(ActionFigures("value", np.array(numbers)), 0, ()))
    assert "#" not in "".join(rows)
    assert rows[0].split() == ["action", "value"]


def test_bars_give_way_where_it_is_narrow_and_nothing_moves_sideways():
    figures = ActionFigures("probability", np.array([1e-5, 1.0]))
    one, other = (
        rows_of(figures_table(figures, chosen, ("left", "right"), width=width), width)
        for chosen, width in ((0, 26), (1, 26))
    )
    assert {len(row) for row in (*one, *other)} == {26}
    assert one[2].split() == ["right", "1", "#" * 5]
    assert rows_of(figures_table(figures, 1, (), width=10), 30)[2].split() == [">", "1", "1"]


def test_what_an_environment_draws_moves_no_cursor(pauses, monkeypatch):
    monkeypatch.setenv("TERM", "xterm")
    console = TextConsole(file=io.StringIO(), force_terminal=True, width=60)
    frames = [["\x1b[2J\x1b]0;taken\x07[red]S\x1b[31mR\x1b[0m"]]
    taker = SimpleNamespace(take=lambda done: frames.pop() if frames else [])
    agent = SimpleNamespace(policy=None, action_space=None)
    show = LiveShow(console, agent, taker, 4)
    with show.shown():
        show.before_step(np.array([0]), np.array([0]))
    shown = console.file.getvalue()
    assert "\x1b[2J" not in shown
    assert "\x1b]0" not in shown
    assert "[red]S" in shown


def test_a_pace_is_for_letters_alone():
    for words in (["--fps", "3"], ["--fps", "3", "--render", "none"]):
        with pytest.raises(UserError, match="--fps is the pace of --render ansi: give that too"):
            check_playing(build_parser().parse_args(words))
    args = build_parser().parse_args(["--fps", "3", "--render", "ansi"])
    check_playing(args)
    for wrong in ("0", "61", "x"):
        with pytest.raises(SystemExit):
            build_parser().parse_args(["--fps", wrong])


@pytest.fixture
def wall(on_ice):
    """An agent that has learnt nothing, and walks against the wall until the time limit."""
    return on_ice(1)


def test_what_repeats_itself_is_shown_for_a_while(wall, pauses, monkeypatch):
    """The start, one step against the wall, and 20 that look like it, of 100; then it is told."""
    console = TextConsole(file=io.StringIO())
    play(console, wall, letters("--n-episodes", 2))
    shown = without_style(console.file.getvalue())
    assert shown.count("SFFF") == 2 * 22
    assert shown.count("... 79 steps left out, which repeat pictures from above") == 2
    assert shown.count("return 0.00, 100 steps") == 2
    monkeypatch.setenv("TERM", "xterm")
    shown = without_style(played(wall, "--n-episodes", 2))
    assert shown.count("step 22: it repeats itself, and is not shown any more") == 2
    assert shown.count("return 0.00, 100 steps") == 2
    assert len(pauses) == 2 * 23  # the last one after the end
