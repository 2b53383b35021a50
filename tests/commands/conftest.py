import os
import random
import sys
from functools import partial
from pathlib import Path

import pytest

import compare
import enjoy
import train
import tune
from rl_yardstick.commands import explain, main, shaping, share
from rl_yardstick.commands.cli import run_command
from rl_yardstick.pipeline.signs_of_life import Silence

MAINS = {
    "train.py": train.main,
    "enjoy.py": enjoy.main,
    "explain.py": explain.main,
    "shaping.py": shaping.main,
    "compare.py": compare.main,
    "tune.py": tune.main,
}
COMMANDS = {name: partial(run_command, main) for name, main in MAINS.items()}
COMMANDS |= {"pack": partial(run_command, share.pack), "yardstick": main}


@pytest.fixture(autouse=True)
def nothing_takes_long(monkeypatch):
    """However slow the machine is, no command says that it is still loading."""
    monkeypatch.setattr(Silence.__init__, "__defaults__", (1e9,))


@pytest.fixture(autouse=True)
def seeds_are_drawn_alike(request, monkeypatch):
    """A command without --seed draws one: what fails once has to fail again."""
    drawing = random.Random(request.node.nodeid)  # noqa: S311  # to be repeated, not kept secret
    monkeypatch.setattr("secrets.randbelow", drawing.randrange)


@pytest.fixture
def pictures():
    """For tests that look at what a run draws."""


@pytest.fixture(autouse=True)
def no_pictures_elsewhere(request, monkeypatch):
    """They take most of a short run."""
    if "pictures" not in request.fixturenames:
        monkeypatch.setattr("rl_yardstick.pipeline.training.draw", lambda *_: None)


@pytest.fixture(scope="session")
def train_in():
    """Train inside a folder, without pictures."""

    def do(folder, *words):
        with pytest.MonkeyPatch.context() as patch:
            patch.chdir(folder)
            patch.setattr("rl_yardstick.pipeline.training.draw", lambda *_: None)
            patch.setattr("sys.argv", ["train.py", "--verbose", "0", "--seed", "0", *words])
            assert train.main() == 0
        return folder

    return do


@pytest.fixture
def type_command(monkeypatch, capsys, tmp_path):
    """Run a command line in this process, inside an empty folder: exit code, output, errors."""
    monkeypatch.chdir(tmp_path)

    def run(*words):
        monkeypatch.setattr(sys, "argv", [str(word) for word in words])
        with pytest.raises(SystemExit) as stop:
            COMMANDS[Path(words[0]).name]()
        captured = capsys.readouterr()
        return stop.value.code, captured.out, captured.err

    return run


@pytest.fixture
def type_study(own_folder, monkeypatch, capfd):
    """Run ``compare.py`` or ``tune.py`` in a user's own folder; also what child processes say."""
    path = os.pathsep.join([str(own_folder), str(Path(compare.__file__).parent)])
    monkeypatch.setenv("PYTHONPATH", path)

    def run(*words, program="compare.py"):
        monkeypatch.setattr(sys, "argv", [program, *map(str, words)])
        with pytest.raises(SystemExit) as stop:
            run_command(tune.main if program == "tune.py" else compare.main)
        captured = capfd.readouterr()
        return stop.value.code, captured.out, captured.err

    return run
