"""Output that nobody reads to its end, or that cannot be written."""

import errno
import io
import json
import os
import subprocess
import sys
import threading
from pathlib import Path

import pytest

import enjoy
import train
from commands.cli import Output, go_on_unread, run_command, standard_streams
from commands.terminal import TextConsole
from pipeline.errors import UserError
from pipeline.signs_of_life import Heartbeat

ROOT = Path(train.__file__).parent


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


def printing(n_lines, ends=0, goes_on=False):
    def main():
        if goes_on:
            go_on_unread()
        for line in range(n_lines):
            sys.stdout.write(f"{line}\n")
        work.append("done")
        return ends

    work = []
    return main, work


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
        assert sys.stdout is out
        assert sys.stderr is err
        # It is not tried again and again.
        assert out.refusals <= 1
        return stop.value.code, out.getvalue(), err.getvalue()

    return do


def test_a_command_that_is_read_to_its_end_is_left_alone(run):
    main, work = printing(2, ends=1)
    assert run(main, errno.EPIPE) == (1, "0\n1\n", "")
    assert work == ["done"]


def test_a_thread_that_says_how_far_it_is_ends_without_a_word(run):
    """Where libraries took five seconds to load, `enjoy.py | head -1` played on for nobody."""
    said, consoles, work = threading.Event(), [], []

    def say():
        said.set()
        consoles[0].print("loading")

    def main():
        consoles.append(TextConsole())
        heart = Heartbeat(say, 0.01)
        heart.start()
        assert said.wait(10)
        heart.stop()
        consoles[0].print("loaded")
        work.append("played")
        return 1

    assert run(main, errno.EPIPE, 0) == (0, "", "")
    assert work == []


def test_where_the_output_is_the_work_it_ends_with_its_reader(run):
    main, work = printing(9, ends=1)
    assert run(main, errno.EPIPE) == (0, "0\n1\n", "")
    assert work == []


def test_where_it_is_not_the_work_goes_on_without_a_word(run):
    main, work = printing(9, goes_on=True)
    assert run(main, errno.EPIPE) == (0, "0\n1\n", "")
    assert work == ["done"]


def test_the_exit_code_is_that_of_the_work(run):
    main, _ = printing(9, ends=1, goes_on=True)
    assert run(main, errno.EPIPE)[0] == 1
    main, _ = printing(9, ends=1, goes_on=True)
    assert run(main, errno.ENOSPC)[0] == 1


def test_output_that_cannot_be_written_ends_in_one_line(run):
    main, work = printing(9)
    message = f"train.py: error: {os.strerror(errno.ENOSPC)}\n"
    assert run(main, errno.ENOSPC) == (2, "0\n1\n", message)
    assert work == []


def test_or_the_work_goes_on_after_that_line(run):
    main, work = printing(9, goes_on=True)
    message = f"train.py: what it prints is lost: {os.strerror(errno.ENOSPC)}\n"
    assert run(main, errno.ENOSPC) == (2, "0\n1\n", message)
    assert work == ["done"]


def test_a_mistake_is_told_where_nobody_hears_it(monkeypatch):
    def main():
        raise UserError("wrong")

    monkeypatch.setattr(sys, "stderr", Refusing(errno.EPIPE, 0))
    with pytest.raises(SystemExit) as stop:
        run_command(main)
    assert stop.value.code == 2


def test_without_a_command_nothing_is_told_to_go_on():
    before = sys.stdout
    go_on_unread()
    assert sys.stdout is before
    assert not isinstance(before, Output)


def test_a_stream_in_place_of_another_is_that_stream_otherwise():
    stream = io.StringIO("text")
    output = Output(stream, goes_on=True)
    assert output.read() == "text"
    assert output.write("more") == 4
    assert output.isatty() is False


def test_streams_that_were_closed_are_opened_on_nothing(monkeypatch):
    monkeypatch.setattr(sys, "stdout", None)
    with standard_streams() as output:
        assert output.name == os.devnull
        print("to nobody")  # noqa: T201  # as a library might
        output.close()


# --- real processes ------------------------------------------------------------------------------


def test_a_training_goes_on_after_its_reader_has_gone_and_playing_ends(
    tmp_path, left_by_its_reader, monkeypatch, run
):
    words = ["--algo", "qlearning", "--env", "FrozenLake-v1", "--seed", "0", "-n", "500"]
    line = "qlearning on FrozenLake-v1, seed 0, 500 steps\n"
    assert left_by_its_reader(tmp_path, "train.py", *words) == (line, "", 0)
    folder = tmp_path / "logs" / "qlearning" / "FrozenLake-v1_1"
    assert json.loads((folder / "run.json").read_text())["state"] == "finished"
    model = folder / "FrozenLake-v1.zip"
    for_ever = ["--n-episodes", 10**9, "--render", "none"]
    line, err, code = left_by_its_reader(tmp_path, "enjoy.py", model, *for_ever)
    assert line.startswith("qlearning on FrozenLake-v1")
    assert (err, code) == ("", 0)
    # Where a film is wanted, that is what the work is for.
    monkeypatch.chdir(tmp_path)
    film = ["--n-episodes", "1", "--record", "film.gif", "--reward-log", "returns"]
    argv = ["enjoy.py", str(model), *film]
    assert run(enjoy.main, errno.EPIPE, n_texts=1, argv=argv)[::2] == (0, "")
    assert (tmp_path / "film.gif").stat().st_size > 0


@pytest.mark.skipif(not Path("/dev/full").exists(), reason="there is no full device to write to")
@pytest.mark.parametrize("words", ["--help", "--list"])
def test_what_only_prints_says_so_on_a_full_device(words):
    with open("/dev/full", "w") as full:  # noqa: PTH123  # it is no path
        result = subprocess.run(
            [sys.executable, str(ROOT / "train.py"), words],
            stdout=full,
            stderr=subprocess.PIPE,
            text=True,
            check=False,
        )
    assert result.stderr == "train.py: error: No space left on device\n"
    assert result.returncode == 2


@pytest.mark.parametrize("closed", ["<&- >&-", "2>&-", "<&- >&- 2>&-"])
def test_a_command_does_without_the_streams_that_are_closed(tmp_path, closed):
    command = f'exec "{sys.executable}" "{ROOT / "train.py"}" --help {closed}'
    result = subprocess.run(
        ["/bin/sh", "-c", command], cwd=tmp_path, capture_output=True, text=True, check=False
    )
    assert (result.returncode, result.stderr) == (0, "")
    assert ("--algo" in result.stdout) is (">&- " not in f"{closed} ".replace("2>&-", ""))
