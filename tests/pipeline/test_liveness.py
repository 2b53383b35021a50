"""Whether a recorded process is still there, and what is done with what dead ones have left."""

import json
import os
import signal
import subprocess
import sys

import pytest

from pipeline import locks
from pipeline.errors import UserError
from pipeline.locks import is_alive, mark
from pipeline.models.find import model_of
from pipeline.runs import INTERRUPTED, RUNNING, Run, remove_leftovers


@pytest.fixture(scope="module")
def dead():
    """The mark of a process that is no more."""
    code = "import json; from pipeline.locks import mark; print(json.dumps(mark()))"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, check=True)
    return json.loads(done.stdout)


def test_this_process_is_alive_and_one_that_has_ended_is_not(dead):
    assert is_alive(json.loads(json.dumps(mark()))) is True
    assert is_alive(dead) is False


def test_one_that_has_ended_and_is_not_yet_waited_for_is_not():
    with subprocess.Popen([sys.executable, "-c", "input()"], stdin=subprocess.PIPE) as process:
        record = {**mark(), "pid": process.pid, "began": locks._ticks_at_begin(process.pid)}
        assert is_alive(record) is True
        process.kill()
        os.waitid(os.P_PID, process.pid, os.WEXITED | os.WNOWAIT)
        assert is_alive(record) is False


@pytest.mark.parametrize(
    ("changes", "expected"),
    [
        ({"began": 1}, False),  # its number is another's now
        ({"began": None}, True),
        ({"boot": "earlier"}, False),
        ({"boot": "earlier", "host": "elsewhere"}, None),
        ({"boot": "earlier", "machine": "another of that name"}, None),
        ({"boot": "earlier", "machine": None}, None),
        ({"boot": None}, None),
        ({"host": "renamed"}, True),
        ({"namespace": "pid:[another container]", "pid": 1}, None),
        ({"pid": "7"}, None),
        ({"pid": True}, None),
        ({"pid": -1}, None),
        ({"pid": 0}, None),
        ({"pid": 2**40}, None),
    ],
)
def test_a_number_alone_names_no_process(changes, expected):
    assert is_alive({**mark(), **changes}) is expected


@pytest.mark.parametrize("record", [None, [], "7", {}, {"pid": 7}])
def test_of_what_is_no_mark_nothing_is_known(record):
    assert is_alive(record) is None


def test_a_process_that_is_hidden_is_asked_for_by_its_number(dead, monkeypatch):
    monkeypatch.setattr(locks, "_ticks_at_begin", lambda pid: None)
    assert (is_alive({**mark(), "began": 5}), is_alive(dead)) == (True, False)


def test_without_proc_host_and_number_have_to_do(dead, monkeypatch):
    monkeypatch.setattr(locks, "_BOOT", "/nowhere")
    assert is_alive(mark()) is True
    assert is_alive({**mark(), "pid": dead["pid"]}) is False
    assert is_alive({**mark(), "host": "elsewhere"}) is None
    assert is_alive(dead) is None


def test_a_name_with_brackets_and_spaces_is_read_over(tmp_path):
    program = tmp_path / "a) Z (b"
    program.symlink_to(sys.executable)
    with subprocess.Popen([str(program), "-c", "input()"], stdin=subprocess.PIPE) as process:
        assert locks._ticks_at_begin(process.pid) > 0
        process.communicate(b"\n")


# --- runs -----------------------------------------------------------------------------------------


def run_of(folder, process, **info):
    run = Run.claim(folder, "sarsa", "Taxi-v4")
    run.info_path.write_text(json.dumps({"state": RUNNING, "process": process, **info}))
    return run


def test_a_run_whose_process_is_gone_was_interrupted(tmp_path, dead):
    marks = (dead, mark(), {**dead, "boot": "x", "host": "elsewhere"}, None)
    states = [run_of(tmp_path, process).state for process in marks]
    assert states == [INTERRUPTED, RUNNING, RUNNING, RUNNING]
    for state in ("finished", "failed"):
        assert run_of(tmp_path, dead, state=state).state == state
    assert Run(tmp_path, "Taxi-v4").state is None


DRAFT = f".run.json.{'0' * 16}.tmp"


def test_a_set_up_that_was_killed_is_cleared_away(tmp_path, dead):
    """But not one that is at work, may be, or holds anything else."""
    elsewhere = {**dead, "boot": "x", "host": "elsewhere"}
    gone = run_of(tmp_path, dead)
    for name in ("0.monitor.csv", "Taxi-v4/config.yml", "Taxi-v4/command.txt", DRAFT):
        (gone.path / name).touch()
    (gone.path / "modules").mkdir()
    (gone.path / "modules" / "mine.py").touch()
    claimed = Run(tmp_path / "sarsa" / f".Taxi-v4.{'a' * 16}.tmp", "Taxi-v4")
    claimed.params_path.mkdir(parents=True)
    claimed.info_path.write_text(json.dumps({"state": RUNNING, "process": dead}))
    kept = [run_of(tmp_path, process) for process in (mark(), elsewhere, None)]
    kept += [run_of(tmp_path, dead, spec={"algo": "sarsa"})]
    for name in ("notes.txt", "best_model.zip", "Taxi-v4/mine.yml", "modules/sub"):
        kept.append(run_of(tmp_path, dead))
        (kept[-1].path / "modules").mkdir()
        (kept[-1].path / name).mkdir()
    kept.append(run_of(tmp_path, dead))
    (kept[-1].path / "0.monitor.csv").symlink_to(tmp_path)
    before = {path for run in kept for path in run.path.rglob("*")}
    remove_leftovers(tmp_path, "sarsa", "Taxi-v4")
    assert not gone.path.exists()
    assert sorted((tmp_path / "sarsa").iterdir()) == sorted(run.path for run in kept)
    assert {path for run in kept for path in run.path.rglob("*")} == before


def test_half_written_files_go_where_nobody_can_be_writing_them(tmp_path, dead):
    runs = [run_of(tmp_path, process, spec={"a": 1}) for process in (dead, mark(), None)]
    for run in runs:
        run.model_path.touch()
        for name in (DRAFT, f"Taxi-v4/{DRAFT}", ".mine.tmp", "mine.tmp"):
            (run.path / name).touch()
    remove_leftovers(tmp_path, "sarsa", "Taxi-v4")
    assert [len(list(run.path.rglob("*.tmp"))) for run in runs] == [2, 4, 4]


def test_a_damaged_record_and_a_missing_folder_are_left_alone(tmp_path, dead):
    run = run_of(tmp_path, dead)
    run.info_path.write_text("{")
    remove_leftovers(tmp_path, "sarsa", "Taxi-v4")
    remove_leftovers(tmp_path / "nowhere", "sarsa", "Taxi-v4")
    assert run.info_path.exists()


def test_a_training_that_was_killed_is_known_as_interrupted(tmp_path):
    """By its process: nothing else says so."""
    code = (
        "import os, signal, sys; from pathlib import Path; from pipeline.runs import Run\n"
        "Run.claim(Path(sys.argv[1]), 'sarsa', 'Taxi-v4').update_info(spec={'algo': 'sarsa'})\n"
        "os.kill(os.getpid(), signal.SIGKILL)"
    )
    done = subprocess.run([sys.executable, "-c", code, str(tmp_path)], check=False)
    assert done.returncode == -signal.SIGKILL
    assert Run.find(tmp_path, "sarsa", "Taxi-v4").state == INTERRUPTED
    with pytest.raises(UserError, match="its training was cut off before it was written"):
        model_of(Run.find(tmp_path, "sarsa", "Taxi-v4"))
