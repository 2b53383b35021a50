"""Mistakes: one line on stderr, exit code 2, no folder; the table is wrong_commands.yml."""

import shlex
from pathlib import Path

import pytest
import yaml

TABLE = yaml.safe_load(Path(__file__).with_name("wrong_commands.yml").read_text(encoding="utf-8"))
NEEDS_RUNS = ("logs/qlearning", "logs/linucb", "enjoy.py --algo qlearning")


@pytest.fixture(scope="module")
def runs(tmp_path_factory, train_in):
    folder = tmp_path_factory.mktemp("runs")
    train_in(folder, "--env", "FrozenLake-v1", "--algo", "qlearning", "-n", "300")
    return train_in(folder, "--env", "SegmentBandit-v0", "--algo", "linucb", "-n", "300")


@pytest.mark.parametrize("line", TABLE["commands"])
def test_mistakes_are_one_line(line, type_command, tmp_path, request):
    for name, text in TABLE["files"].items():
        (tmp_path / name).write_text(text, encoding="utf-8")
    if any(word in line for word in NEEDS_RUNS):
        (tmp_path / "logs").symlink_to(request.getfixturevalue("runs") / "logs")
    before = set(tmp_path.rglob("*"))
    code, out, err = type_command(*shlex.split(line))
    assert code == 2, out + err
    assert err.count("\n") == 1, err
    assert "Traceback" not in out + err
    assert set(tmp_path.rglob("*")) == before
    assert len(err) < 1200
