"""``train.py --watch-learning`` as a user types it: when a page is written, and when it is not."""

import os
import re
import signal

from pipeline.watching import TableRecorder

LAKE = ("train.py", "--env", "FrozenLake-v1", "--seed", "0", "--verbose", "1")
TABLE = (*LAKE, "--algo", "qlearning", "-n", "300", "--watch-learning", "page.html")


def test_the_page_is_named_and_replaces_the_one_before(type_command, tmp_path):
    for words in ((), ("--watch-episodes", "2")):
        code, out, err = type_command(*TABLE, *words)
        assert (code, err) == (0, "")
        assert out.splitlines()[-1] == "learning page.html"
    assert "2 whole episodes" in (tmp_path / "page.html").read_text(encoding="utf-8")


def test_a_run_that_fails_leaves_the_page_of_what_it_came_to(type_command, tmp_path):
    words = ("-params", "learning_rate:30", "gamma:1", "--eval-freq", "-1")
    words = ("--env", "Warehouse-v0", "-n", "3000", *words)
    code, out, err = type_command(*TABLE, *words)
    assert (code, err.count("\n")) == (2, 1)
    assert "q_tables of the agent at step 3,000 is nan" in err
    assert out.splitlines()[-1] == "learning page.html"
    assert "3,000 steps" in (tmp_path / "page.html").read_text(encoding="utf-8")


def test_a_training_that_is_stopped_is_shown_as_far_as_it_came(type_command, tmp_path, monkeypatch):
    begun = TableRecorder._on_rollout_start

    def stop_later(recorder):
        begun(recorder)
        if recorder.model.num_timesteps == 64:
            signal.raise_signal(signal.SIGINT)

    monkeypatch.setattr(TableRecorder, "_on_rollout_start", stop_later)
    # On a slow machine there is no time for pictures.
    monkeypatch.setattr("pipeline.training.draw", lambda *_: None)
    code, out, _ = type_command(*TABLE)
    assert (code, out.splitlines()[-1]) == (130, "learning page.html")
    text = (tmp_path / "page.html").read_text(encoding="utf-8")
    (number,) = re.findall(r"seed 0 · (\d+) steps", text)
    assert int(number) in {64, 65}


def test_a_page_that_finds_no_room_afterwards_ends_in_one_line(type_command, tmp_path, monkeypatch):
    monkeypatch.setattr("report.page.learning.write_text", fails)
    code, out, err = type_command(*TABLE)
    assert (code, err.count("\n")) == (2, 1)
    assert "page.html" in err
    assert "final" in out
    assert [path.name for path in tmp_path.iterdir()] == ["logs"]


def fails(path, _):
    raise OSError(28, os.strerror(28), str(path))
