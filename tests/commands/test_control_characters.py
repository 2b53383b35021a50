"""What a terminal would obey is shown, wherever a text of a file or a name is printed."""

import io
import json
import re
import zipfile
from pathlib import Path

import pytest
from rich.live import Live
from rich.table import Table
from rich.text import Text

from commands import compare, enjoy, terminal, train
from commands.cli import run_command
from commands.terminal import TextConsole, print_rows, table_console
from pipeline.errors import UserError, visible

TITLE, CLEAR = "\x1b]0;x\x07", "\x1b[2J"
HOSTILE = TITLE + CLEAR


@pytest.fixture
def complaint(monkeypatch, capsys, tmp_path):
    """What a command says on stderr before it exits with code 2."""
    monkeypatch.chdir(tmp_path)

    def run(module, *words):
        monkeypatch.setattr("sys.argv", ["program", *map(str, words)])
        with pytest.raises(SystemExit) as stop:
            run_command(module.main)
        out, err = capsys.readouterr()
        assert stop.value.code == 2
        assert "\x1b" not in out + err
        assert "\x07" not in out + err
        assert len(err.splitlines()) == 1
        return err

    return run


@pytest.mark.parametrize(
    ("text", "shown"),
    [
        ("\u061cb\udce9", r"\u061cb\udce9"),
        (HOSTILE, r"\x1b]0;x\x07\x1b[2J"),
        ("\x9b2J", r"\x9b2J"),
        ("a\u202eb\u2066", r"a\u202eb\u2066"),
        ("ä 漢字 😀\ttab\nline", "ä 漢字 😀\ttab\nline"),
    ],
)
def test_control_characters_are_spelt_out(text, shown):
    assert visible(text) == shown
    assert str(UserError(text)) == " ".join(shown.splitlines())


@pytest.mark.parametrize("is_terminal", [False, True])
def test_the_console_obeys_its_own_colours_alone(is_terminal):
    file = io.StringIO()
    console = TextConsole(file=file, width=200, force_terminal=is_terminal, _environ={})
    table = Table(HOSTILE, title=HOSTILE)
    table.add_row(HOSTILE)
    console.print(HOSTILE, style="red")
    console.print(CLEAR)
    console.print(table)
    console.print(Text(HOSTILE))
    printed = file.getvalue()
    assert CLEAR not in printed
    assert "\x1b]0;" not in printed
    assert "\x07" not in printed
    assert re.sub("\x1b.*?m", "", printed).count(r"\x1b[2J") == 6
    assert ("\x1b[31m" in printed) is is_terminal


@pytest.mark.parametrize("text", ["[/]", "[link=https://a.b]c[/link]", "[red]d[/red]", ":bomb:"])
def test_no_text_is_markup(text, capsys):
    for console in (TextConsole(force_terminal=True, width=80, _environ={}), table_console()):
        table = Table(text, title=text, caption=text)
        table.add_row(text)
        console.print(text)
        console.print(table)
        print_rows(console, table)
        out = capsys.readouterr().out
        assert re.sub("\x1b[^a-z]*m", "", out).count(text) == 9
        assert "\x1b]8" not in out


def test_what_moves_the_cursor_still_does():
    file = io.StringIO()
    console = TextConsole(file=file, width=80, force_terminal=True, _environ={"TERM": "xterm"})
    with Live(CLEAR, console=console, auto_refresh=False) as live:
        live.update("done", refresh=True)
    assert "\x1b[?25l" in file.getvalue()
    assert CLEAR not in file.getvalue()


def test_titles_and_labels_of_a_study(complaint, tmp_path):
    study = tmp_path / "s.yml"
    text = json.dumps(HOSTILE)  # which YAML reads as JSON does
    for lines in (
        f"agents: {{{text}: }}\nenvironments: [FrozenLake-v1]\n",
        f"agents: {{{text}: {{algo: sarsa}}}}\nenvironments: [FrozenLake-v1]\n",
        f"agents: [sarsa]\nenvironments: {{{text}: {{id: FrozenLake-v1}}}}\n",
        f"title: {text}\nagents: [sarsa]\nenvironments: [FrozenLake-v1]\n",
        f"description: {text}\nagents: [sarsa]\nenvironments: [FrozenLake-v1]\n",
        f"agents: [qlearning]\nenvironments: [{text}]\n",
        f"{text}: 1\n",
        f"metric: {text}\n",
        f"agents: {{qlearning: {{callback: {text}}}}}\nenvironments: [FrozenLake-v1]\n",
    ):
        study.write_text(lines)
        assert r"\x1b" in complaint(compare, study)
        study.write_text(lines.replace("\\u001b", "\\ud83d"))
        assert r"\ud83d" in complaint(compare, study)


def test_no_command_prints_by_another_console():
    for path in Path(terminal.__file__).parent.glob("*.py"):
        assert not re.search(r"(?<!Text)\bConsole\(", path.read_text().replace("(Console)", ""))


def test_names_of_files_and_modules(complaint, tmp_path):
    for name in (f"{HOSTILE}.zip", f"{HOSTILE}.yml"):
        path = tmp_path / name
        path.write_text("junk")
        assert r"\x1b" in complaint(enjoy, path)
        assert r"\x1b" in complaint(compare, path)
    words = ("--env", "FrozenLake-v1", "--algo", "qlearning")
    for extra in (
        ["--conf-file", tmp_path / HOSTILE],
        ["--gym-packages", HOSTILE],
        ["-params", f"{HOSTILE}:1"],
        [HOSTILE],
    ):
        assert r"\x1b" in complaint(train, *words, *extra)
    assert r"\x1b" in complaint(train, "--env", f"{HOSTILE}:X-v0", "--algo", "qlearning")


def test_headers_of_a_log(complaint, tmp_path):
    (tmp_path / "log.csv").write_text(f"arm,{HOSTILE}\n0,1\n")
    assert r"\x1b" in complaint(compare, "--logged", "log.csv", "--policy", "uniform")


@pytest.mark.parametrize("key", ["algo", "env_id"])
def test_what_a_run_folder_says(complaint, tmp_path, key):
    spec = {"algo": "qlearning", "env_id": "FrozenLake-v1", key: HOSTILE, "hyperparams": {}}
    with zipfile.ZipFile(tmp_path / "x.zip", "w") as archive:
        archive.writestr("data", "{}")
    (tmp_path / "run.json").write_text(json.dumps({"state": "finished", "spec": spec}))
    complaint(enjoy, tmp_path / "x.zip")
