import os
import random
import signal
import sys
from functools import partial
from pathlib import Path

import pytest

from rl_yardstick.commands import main, run_command


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
    from rl_yardstick.commands import train

    def do(folder, *words):
        with pytest.MonkeyPatch.context() as patch:
            patch.chdir(folder)
            patch.setattr("rl_yardstick.pipeline.training.draw", lambda *_: None)
            patch.setattr("sys.argv", ["train.py", "--verbose", "0", "--seed", "0", *words])
            patch.setattr("signal.signal", lambda *_: None)  # the handlers stay the tests'
            assert train.main() == 0
        return folder

    return do


def exit_code(*words):
    """The exit code of a command line that is run in this process."""
    handlers = {number: signal.getsignal(number) for number in (signal.SIGINT, signal.SIGTERM)}
    name = Path(words[0]).name
    command = main if name == "yardstick" else partial(run_command, name.removesuffix(".py"))
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(os, "_exit", sys.exit)
        patch.setattr(sys, "path", [*sys.path])
        patch.setattr(sys, "argv", [str(word) for word in words])
        with pytest.raises(SystemExit) as stop:
            command()
    for number, handler in handlers.items():  # the process would end with its command
        signal.signal(number, handler)
    return stop.value.code


@pytest.fixture
def type_command(monkeypatch, capsys, tmp_path):
    """Run a command line inside an empty folder: exit code, output, errors."""
    monkeypatch.chdir(tmp_path)

    def run(*words):
        code = exit_code(*words)
        captured = capsys.readouterr()
        return code, captured.out, captured.err

    return run


@pytest.fixture
def type_study(own_folder, monkeypatch, capfd):
    """Run ``compare.py`` or ``tune.py`` in a user's own folder; also what child processes say."""
    path = os.pathsep.join([str(own_folder), str(Path(__file__).parents[2])])
    monkeypatch.setenv("PYTHONPATH", path)

    def run(*words, program="compare.py"):
        code = exit_code(program, *words)
        captured = capfd.readouterr()
        return code, captured.out, captured.err

    return run
