"""What a machine refuses to a command: readers, room for its output, memory."""

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


FULL = os.strerror(errno.ENOSPC)
LOST = f"train.py: what it prints is lost: {FULL}\n"
ENDS = [  # lines printed, whether work goes on unread, the error; exit code, what is said
    (2, False, errno.EPIPE, 1, ""),  # all of it is read
    (9, False, errno.EPIPE, 0, ""),  # the output is the work, which ends with its reader
    (9, True, errno.EPIPE, 1, ""),  # the exit code is that of the work
    (9, False, errno.ENOSPC, 2, f"train.py: error: {FULL}\n"),
    (9, True, errno.ENOSPC, 1, LOST),
]


@pytest.mark.parametrize(("n_lines", "goes_on", "number", "code", "said"), ENDS)
def test_how_a_command_ends_whose_output_is_not_taken(run, n_lines, goes_on, number, code, said):
    main, work = printing(n_lines, ends=1, goes_on=goes_on)
    assert run(main, number) == (code, "0\n1\n", said)
    assert work == ["done"] * (goes_on or n_lines == 2)


@pytest.mark.parametrize(
    ("number", "code", "said"), [(errno.EPIPE, 0, ""), (errno.ENOSPC, 2, LOST)]
)
def test_work_that_succeeds_unread_is_lost_only_where_it_cannot_be_written(run, number, code, said):
    main, work = printing(9, goes_on=True)
    assert run(main, number) == (code, "0\n1\n", said)
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


# --- a machine that has no more memory, threads or processes -----------------------------------


@pytest.mark.parametrize(
    ("error", "line"),
    [
        (MemoryError(), "this machine gives no more memory"),
        (MemoryError("Unable to allocate 4 GiB"), "no more memory: Unable to allocate 4 GiB"),
        (
            RuntimeError("[enforce fail at alloc_cpu.cpp:1]\nDefaultCPUAllocator: can't allocate "),
            None,
        ),
        (
            RuntimeError("DefaultCPUAllocator: can't allocate memory:\nyou tried 9 bytes"),
            "no more memory: DefaultCPUAllocator: can't allocate memory: you tried 9 bytes",
        ),
        (ImportError("libtorch.so: failed to map segment from shared object"), "no more memory: "),
        (RuntimeError("can't start new thread"), "no more threads or processes: "),
        (RuntimeError("a bug"), None),
        (ImportError("No module named 'x'"), None),
    ],
)
def test_what_runs_out_is_named_and_a_bug_is_not_hidden(error, line, capsys):
    def main():
        raise error

    if line is None:
        with pytest.raises(type(error)):
            run_command(main)
        return
    with pytest.raises(SystemExit) as stop:
        run_command(main)
    said = capsys.readouterr().err
    assert stop.value.code == 2
    assert line in said
    assert said.count("\n") == 1


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
