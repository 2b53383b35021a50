"""Signals at named moments of a training: what is left, and how the process ends."""

import json
import os
import signal
import subprocess
import sys
import zipfile
from pathlib import Path

import pytest

import train
from agents import load_algorithm

ROOT = Path(train.__file__).parent
WORDS = ["--algo", "qlearning", "--env", "FrozenLake-v1", "-n", "600", "--seed", "0"]
# At most two seconds on a machine that has nothing else to do.
SECONDS = 10


@pytest.fixture(scope="module")
def server():
    process = subprocess.Popen(
        [sys.executable, str(Path(__file__).with_name("stopping_server.py"))],
        env={**os.environ, "PYTHONPATH": str(ROOT)},
        stdin=subprocess.PIPE,
        stdout=subprocess.PIPE,
        text=True,
    )
    with process:
        yield process


@pytest.fixture
def train_stopped(server, tmp_path):
    """Train, with signals by moment; exit code, the run's record or None, and the run folder."""

    def run(*words, ignored=(), engine="interpreted", **plan):
        words = [*WORDS, *words, "-params", f"engine:{engine}"]
        plan = {moment.replace("_", " "): names.split() for moment, names in plan.items()}
        request = {"folder": str(tmp_path), "words": words, "plan": plan, "ignored": ignored}
        server.stdin.write(json.dumps(request) + "\n")
        server.stdin.flush()
        answer = json.loads(server.stdout.readline())
        assert (tmp_path / "signalled").exists()
        assert answer["seconds"] < SECONDS
        folder = tmp_path / "logs" / "qlearning" / "FrozenLake-v1_1"
        record = json.loads((folder / "run.json").read_text()) if folder.exists() else None
        for path in folder.rglob("*.zip"):
            with zipfile.ZipFile(path) as archive:
                assert archive.testzip() is None
        return answer["code"], record, folder

    return run


def holds(folder):
    return sorted(p.name for p in folder.iterdir() if p.suffix in (".zip", ".png", ".tmp"))


BEGUN = ["compiling", "training", "evaluating", "saving", "judging", "drawing"]
CODES = {"SIGINT": 130, "SIGTERM": 143, "SIGHUP": 129}


@pytest.mark.parametrize(
    ("moment", "name"),
    [(moment, name) for moment in BEGUN for name in (CODES if moment == "training" else ["SIGINT"])]
    + [("judging", "SIGTERM"), ("saving", "SIGHUP")],
)
def test_what_was_learnt_is_saved(train_stopped, moment, name):
    engine = "compiled" if moment == "compiling" else "interpreted"
    if moment == "compiling":  # before, so that it takes less than the patience for a signal
        load_algorithm("qlearning")("QTablePolicy", "FrozenLake-v1", engine=engine).learn(10)
    code, record, folder = train_stopped(engine=engine, **{moment: name})
    assert (code, record["state"], record["stopped_by"]) == (CODES[name], "interrupted", name)
    assert "process" not in record
    assert "FrozenLake-v1.zip" in record["files"]
    is_trained = moment in ("saving", "judging", "drawing")
    assert (record["n_timesteps"] == 600) is is_trained
    assert (record["final"] is not None) is (moment == "drawing")
    assert [name for name in holds(folder) if name.endswith(".tmp")] == []


@pytest.mark.parametrize("moment", ["set-up", "between", "before the first step"])
@pytest.mark.parametrize("name", ["SIGINT", "SIGTERM"])
def test_before_the_first_step_nothing_is_left(train_stopped, tmp_path, moment, name):
    code, record, _ = train_stopped(**{moment: name})
    assert (code, record) == (CODES[name], None)
    assert not (tmp_path / "logs").exists()
    how = "interrupted" if name == "SIGINT" else f"ended by {name}"
    assert (tmp_path / "err").read_text() == f"train.py: {how}\n"


@pytest.mark.parametrize("moment", ["recording", "closing"])
def test_a_run_that_is_whole_stays_finished(train_stopped, moment):
    code, record, _ = train_stopped(**{moment: "SIGTERM"})
    assert (code, record["state"]) == (0, "finished")


@pytest.mark.parametrize("second", ["training", "saving", "drawing"])
def test_a_second_signal_leaves_out_what_can_be(train_stopped, second):
    plan = {"training": "SIGINT", second: "SIGTERM"}
    if second == "training":
        plan = {"training": "SIGINT SIGTERM"}
    code, record, folder = train_stopped(**plan)
    assert (code, record["state"], record["stopped_by"]) == (130, "interrupted", "SIGINT")
    best = ["best_model.zip"] if second == "drawing" else []
    assert holds(folder) == ["FrozenLake-v1.zip", *best]


def test_a_third_ends_it_at_once_and_the_next_command_clears_up(train_stopped):
    code, record, folder = train_stopped(saving="SIGINT SIGINT SIGTERM")
    assert (code, record["state"]) == (-signal.SIGTERM, "running")
    (draft,) = [name for name in holds(folder) if name.endswith(".tmp")]
    assert draft.startswith(".FrozenLake-v1.zip.")
    (folder / "notes.tmp").touch()
    code, _, _ = train_stopped("--eval-freq", "-1", drawing="SIGINT")
    assert code == 130
    assert holds(folder) == ["best_model.zip", "notes.tmp"]


def test_what_is_ignored_from_outside_stays_ignored(train_stopped):
    code, record, _ = train_stopped(ignored=["SIGHUP", "SIGINT"], training="SIGHUP SIGINT SIGHUP")
    assert (code, record["state"]) == (0, "finished")


def test_sigterm_works_in_the_background(train_stopped):
    code, record, _ = train_stopped(ignored=["SIGINT"], training="SIGINT SIGTERM")
    assert (code, record["stopped_by"]) == (143, "SIGTERM")
