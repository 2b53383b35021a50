"""The installed command: what it runs, and how messages name it."""

import runpy
import shlex
import sys
from functools import partial
from importlib.metadata import version
from pathlib import Path

import pytest

import compare
import enjoy
import train
from commands import main as yardstick
from commands.cli import COMMANDS, as_called, called_as, command_line, run_command

ROOT = Path(train.__file__).parent
QUICK = ["--algo", "qlearning", "--env", "FrozenLake-v1", "--seed", "0", "-n", "500"]
MAINS = {
    "yardstick": yardstick,
    "train.py": partial(run_command, train.main),
    "enjoy.py": partial(run_command, enjoy.main),
    "compare.py": partial(run_command, compare.main),
}


@pytest.fixture
def type_command(monkeypatch, capsys, tmp_path):
    """Run a command line in this process, inside an empty folder."""
    monkeypatch.chdir(tmp_path)

    def run(*words):
        monkeypatch.setattr(sys, "argv", list(words))
        with pytest.raises(SystemExit) as stop:
            MAINS[Path(words[0]).name]()
        captured = capsys.readouterr()
        return stop.value.code, captured.out, captured.err

    return run


@pytest.mark.parametrize(
    ("program", "named"),
    [
        ("train.py", "python enjoy.py"),
        ("/a place/compare.py", "python '/a place/enjoy.py'"),
        ("../train.py", "python ../enjoy.py"),
        ("yardstick compare", "yardstick enjoy"),
        ("/somewhere/pytest", "python enjoy.py"),
        ("", "python enjoy.py"),
    ],
)
def test_commands_are_named_as_the_user_calls_them(monkeypatch, program, named):
    monkeypatch.setattr(sys, "argv", [program])
    assert called_as("enjoy") == named
    assert as_called("  python enjoy.py X\n  python enjoy.py") == f"  {named} X\n  {named}"


@pytest.mark.parametrize(
    ("words", "typed"),
    [
        (["train.py", "--env", "A B"], "python train.py --env 'A B'"),
        (["yardstick train", "--env", "A B"], "yardstick train --env 'A B'"),
    ],
)
def test_the_command_line_can_be_typed_again(monkeypatch, words, typed):
    monkeypatch.setattr(sys, "argv", words)
    assert command_line() == typed


@pytest.mark.parametrize("program", ["/venv/bin/yardstick", "yardstick"])
def test_training_and_playing_by_the_installed_name(type_command, tmp_path, program):
    code, out, err = type_command(program, "train", *QUICK)
    assert (code, err) == (0, "")
    assert "watch    yardstick enjoy --algo qlearning --env FrozenLake-v1\n" in out
    run = tmp_path / "logs" / "qlearning" / "FrozenLake-v1_1"
    written = (run / "FrozenLake-v1" / "command.txt").read_text()
    assert written == f"yardstick train {shlex.join(QUICK)}\n"
    code, out, err = type_command(program, "enjoy", *QUICK[:4], "--render", "none")
    assert (code, err) == (0, "")
    assert "over 10 episodes" in out


def test_mistakes_name_the_installed_command(type_command):
    code, _, err = type_command("yardstick", "enjoy", "--algo", "dqn", "--env", "CartPole-v1")
    assert code == 2
    assert err == (
        "yardstick enjoy: error: no run of dqn on CartPole-v1 in logs: "
        "train one with: yardstick train --algo dqn --env CartPole-v1 -f logs\n"
    )
    code, _, err = type_command("yardstick", "train", "--evn", "X")
    assert (code, err.count("\n")) == (2, 1)
    assert err.startswith("yardstick train: error: unknown argument --evn")


@pytest.mark.parametrize("command", ["train", "enjoy", "compare"])
def test_help_has_examples_for_the_one_who_asks(type_command, command):
    code, out, _ = type_command("yardstick", command, "--help")
    assert code == 0
    assert out.startswith(f"usage: yardstick {command} [-h]")
    assert f"\n  yardstick {command} --env" in out
    assert ".py" not in out.replace("STUDY.py", "")
    code, out, _ = type_command(f"{command}.py", "--help")
    assert out.startswith(f"usage: {command}.py [-h]")
    assert f"\n  python {command}.py --env" in out
    assert "yardstick" not in out


@pytest.mark.parametrize(
    ("words", "complaint"),
    [
        (["trian"], "unknown command 'trian': did you mean 'train'?"),
        (["trian", "--env", "X"], "unknown command 'trian': did you mean 'train'?"),
        (["x"], "unknown command 'x': known are train, enjoy, compare, tune, pack, inspect"),
        ([], "which command? train, enjoy, compare, tune, pack, inspect"),
        (["--env", "train"], "unknown argument --env: known are -h, --help, --version"),
    ],
)
def test_what_is_no_command_ends_in_one_line(type_command, words, complaint):
    code, out, err = type_command("yardstick", *words)
    assert (code, out) == (2, "")
    assert err == f"yardstick: error: {complaint} (see --help)\n"


def test_help_and_version(type_command):
    code, out, _ = type_command("yardstick", "--help")
    assert code == 0
    assert all(f"  yardstick {command}" in out for command in COMMANDS)
    assert type_command("yardstick", "--version") == (0, f"{version('rl-yardstick')}\n", "")


def test_a_study_of_ours_is_found_by_its_name(type_command, tmp_path):
    """Here without its runs: what it should be compared by is a mistake."""
    for given in ("mine-maze", "mine-maze.yml", "studies/mine-maze.yml"):
        code, _, err = type_command("yardstick", "compare", given, "-params", "gama:1")
        assert code == 2
        assert str(ROOT / "studies" / "mine-maze.yml") in err
    (tmp_path / "mine-maze.yml").write_text("agents: [sarsaa]\nenvironments: [Taxi-v4]\n")
    code, _, err = type_command("yardstick", "compare", "mine-maze.yml")
    assert err.startswith("yardstick compare: error: mine-maze.yml:1: unknown agent 'sarsaa'")


@pytest.mark.parametrize("program", ["train.py", "enjoy.py", "compare.py", "yardstick compare"])
def test_ctrl_c_while_the_command_itself_is_imported(monkeypatch, capsys, program):
    """Which takes a tenth of a second, in which a traceback would be all that there is to say."""
    wanted = program.removesuffix(".py").split()[-1]

    class Interrupted:
        @staticmethod
        def find_spec(name, path=None, target=None):
            if name == f"commands.{wanted}":
                raise KeyboardInterrupt

    monkeypatch.setattr(sys, "argv", program.split())
    monkeypatch.setattr(sys, "meta_path", [Interrupted, *sys.meta_path])
    monkeypatch.delitem(sys.modules, f"commands.{wanted}", raising=False)
    script = partial(runpy.run_path, str(ROOT / program), run_name="__main__")
    with pytest.raises((SystemExit, KeyboardInterrupt)) as stop:
        (script if program.endswith(".py") else yardstick)()
    assert getattr(stop.value, "code", None) == 130
    assert "Traceback" not in capsys.readouterr().err


def test_ctrl_c_while_the_last_word_is_being_said(monkeypatch):
    def interrupted(*_, **__):
        raise KeyboardInterrupt

    monkeypatch.setattr("commands.cli.print", interrupted, raising=False)
    with pytest.raises((SystemExit, KeyboardInterrupt)) as stop:
        run_command(interrupted)
    assert getattr(stop.value, "code", None) == 130
