"""What terminals, pipes and machines do not take of a command: signs, orders, output, memory."""

import errno
import io
import json
import os
import re
import sys
from pathlib import Path

import pytest
from rich.table import Table

from rl_yardstick.commands import compare, enjoy, train
from rl_yardstick.commands.cli import go_on_unread, run_command
from rl_yardstick.commands.terminal import TextConsole, print_rows
from rl_yardstick.pipeline.errors import UserError, visible

# --- readers that leave, and devices that are full --------------------------------------------


class Refusing(io.StringIO):
    """A stream that takes some texts, and then raises an error for good."""

    def __init__(self, number, n_texts):
        super().__init__()
        self.number, self.n_texts, self.refusals = number, n_texts, 0

    def write(self, text):
        if not self.n_texts:
            self.refusals += 1
            raise OSError(self.number, os.strerror(self.number))
        self.n_texts -= 1
        return super().write(text)


@pytest.fixture
def run(monkeypatch):
    """Run a command whose output stops being taken; exit code, output, errors."""

    def do(main, number, n_texts=2, argv=("/there/train.py",)):
        out, err = Refusing(number, n_texts), io.StringIO()
        monkeypatch.setattr(sys, "argv", list(argv))
        monkeypatch.setattr(sys, "stdout", out)
        monkeypatch.setattr(sys, "stderr", err)
        with pytest.raises(SystemExit) as stop:
            run_command(main)
        assert (sys.stdout, sys.stderr) == (out, err)
        assert out.refusals <= 1  # it is not tried again and again
        return stop.value.code, out.getvalue(), err.getvalue()

    return do


FULL = os.strerror(errno.ENOSPC)
ENDS = [  # whether work goes on unread, its code, the error; exit code, what is said
    (False, 1, errno.EPIPE, 0, ""),  # the output is the work, which ends with its reader
    (True, 1, errno.EPIPE, 1, ""),  # the exit code is that of the work
    (False, 1, errno.ENOSPC, 2, f"train.py: error: {FULL}\n"),
    (True, 0, errno.ENOSPC, 2, f"train.py: what it prints is lost: {FULL}\n"),
]


@pytest.mark.parametrize(("goes_on", "ends", "number", "code", "said"), ENDS)
def test_how_a_command_ends_whose_output_is_not_taken(run, goes_on, ends, number, code, said):
    work = []

    def main():
        if goes_on:
            go_on_unread()
        for line in range(9):
            sys.stdout.write(f"{line}\n")
        work.append("done")
        return ends

    assert run(main, number) == (code, "0\n1\n", said)
    assert work == ["done"] * goes_on


LAKE = ["--algo", "qlearning", "--env", "FrozenLake-v1"]


def test_where_the_work_is_what_counts_it_goes_on_unread(run, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)

    def left(main, *words):
        return run(main, errno.EPIPE, 1, ["x.py", *map(str, words)])

    line = "qlearning on FrozenLake-v1, seed 0, 500 steps\n"
    assert left(train.main, *LAKE, "--seed", "0", "-n", "500") == (0, line, "")
    folder = tmp_path / "logs" / "qlearning" / "FrozenLake-v1_1"
    assert json.loads((folder / "run.json").read_text())["state"] == "finished"
    words = ["--algos", "qlearning", *LAKE[2:], "--seeds", 1, "-n", 500, "--name", "s"]
    assert left(compare.main, *words, "--no-report")[::2] == (0, "")
    assert (tmp_path / "logs" / "studies" / "s" / "summary.csv").read_text().count("\n") == 2
    # To play is for who watches, unless a film is wanted.
    for_ever = ["--n-episodes", 10**9, "--render", "none"]
    assert left(enjoy.main, folder, *for_ever)[::2] == (0, "")
    film = ["--n-episodes", "1", "--record", "film.gif"]
    assert left(enjoy.main, folder, *film)[::2] == (0, "")
    assert (tmp_path / "film.gif").stat().st_size > 0


# --- a machine that has no more memory, threads or processes ----------------------------------


@pytest.mark.parametrize(
    ("error", "line"),
    [
        (MemoryError("Unable to allocate 4 GiB"), "no more memory: Unable to allocate 4 GiB"),
        (RuntimeError("can't start new thread"), "no more threads or processes: "),
        (RuntimeError("a bug"), None),
    ],
)
def test_what_runs_out_is_named_and_a_bug_is_not_hidden(error, line, capsys):
    def main():
        raise error

    with pytest.raises(type(error) if line is None else SystemExit) as stop:
        run_command(main)
    if line is not None:
        said = capsys.readouterr().err
        assert (stop.value.code, said.count("\n")) == (2, 1)
        assert line in said


# --- what a terminal would obey is shown, wherever a text of a file or a name is printed ---------


TITLE, CLEAR = "\x1b]0;x\x07", "\x1b[2J"
HOSTILE = TITLE + CLEAR


SHOWN = {
    HOSTILE: r"\x1b]0;x\x07\x1b[2J",
    "\x9b2J": r"\x9b2J",
    "a\u202eb\u2066\udce9": r"a\u202eb\u2066\udce9",
    "ä 漢字 😀\ttab\nline": "ä 漢字 😀\ttab\nline",
}


def test_control_characters_are_spelt_out():
    for text, shown in SHOWN.items():
        assert visible(text) == shown
        assert str(UserError(text)) == " ".join(shown.splitlines())


def test_the_console_obeys_its_own_colours_alone():
    for text in (HOSTILE, "[/]", "[link=https://a.b]c[/link]", ":bomb:"):
        file = io.StringIO()
        console = TextConsole(file=file, width=200, force_terminal=True, _environ={})
        table = Table(text, title=text)
        table.add_row(text)
        console.print(text, style="red")
        console.print(table)
        print_rows(console, table)
        plain = re.sub("\x1b[^a-z]*m", "", file.getvalue())
        assert plain != file.getvalue()
        assert plain.count(r"\x1b[2J" if text == HOSTILE else text) == 7
        assert "\x1b" not in plain


TEXT = json.dumps(HOSTILE)  # which YAML reads as JSON does
STUDY_OF = "agents: [{}]\nenvironments: [FrozenLake-v1]\n"
NAMED = [
    (compare, "text.yml"),
    (compare, "--logged", "log.csv", "--policy", "uniform"),
    (enjoy, f"{HOSTILE}.zip"),
    (train, *LAKE, "-params", f"{HOSTILE}:1"),
]


def test_what_a_strangers_texts_are_refused_with(monkeypatch, capsys, tmp_path):
    monkeypatch.chdir(tmp_path)
    Path("text.yml").write_text(STUDY_OF.format(TEXT))
    Path("log.csv").write_text(f"arm,{HOSTILE}\n0,1\n")
    Path(f"{HOSTILE}.zip").write_text("junk")
    for module, *words in NAMED:
        monkeypatch.setattr("sys.argv", ["program", *words])
        with pytest.raises(SystemExit) as stop:
            run_command(module.main)
        out, err = capsys.readouterr()
        assert (stop.value.code, len(err.splitlines())) == (2, 1)
        assert not {"\x1b", "\x07"} & set(out + err)
        assert r"\x1b" in err
