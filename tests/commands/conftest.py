import os
import subprocess
import sys
from pathlib import Path

import pytest

import enjoy
import train
from commands import share
from commands.cli import run_command
from pipeline.signs_of_life import Silence

ROOT = Path(train.__file__).parent
COMMANDS = {"train.py": train.main, "enjoy.py": enjoy.main, "pack": share.pack}


@pytest.fixture(autouse=True)
def nothing_takes_long(monkeypatch):
    """However slow the machine is, no command says that it is still loading."""
    monkeypatch.setattr(Silence.__init__, "__defaults__", (1e9,))


@pytest.fixture
def pictures():
    """For tests that look at what a run draws."""


@pytest.fixture(autouse=True)
def no_pictures_elsewhere(request, monkeypatch):
    """They take most of a short run."""
    if "pictures" not in request.fixturenames:
        monkeypatch.setattr("pipeline.training.draw", lambda *_: None)


@pytest.fixture
def type_command(monkeypatch, capsys, tmp_path):
    """Run a command line in this process, inside an empty folder: exit code, output, errors."""
    monkeypatch.chdir(tmp_path)

    def run(*words):
        monkeypatch.setattr(sys, "argv", [str(word) for word in words])
        with pytest.raises(SystemExit) as stop:
            run_command(COMMANDS[words[0]])
        captured = capsys.readouterr()
        return stop.value.code, captured.out, captured.err

    return run


@pytest.fixture
def left_by_its_reader():
    """Start a command and read its first line alone; the line, all errors and the exit code."""

    def start(folder, program, *words):
        process = subprocess.Popen(
            [sys.executable, str(ROOT / program), *map(str, words)],
            cwd=folder,
            text=True,
            env={**os.environ, "PYTHONPATH": str(ROOT)},
            stdout=subprocess.PIPE,
            stderr=subprocess.PIPE,
        )
        with process, process.stdout as out, process.stderr as err:
            line = out.readline()
            out.close()
            return line, err.read(), process.wait(timeout=120)

    return start
