"""What the commands print, on terminals whose encoding has few signs."""

import io
import os
import re
import subprocess
import sys
from pathlib import Path

import pytest

import compare
import enjoy
import train
from commands.cli import run_command

ROOT = Path(train.__file__).parent
ANGLE = ["--algo", "angle", "--env", "CartPole-v1"]
STUDY = (
    "title: Größer als ∞?\nseeds: 2\nn_episodes: 30\n"
    "agents: {Ärger 日本: {algo: qlearning}, sarsa: {sweep: {gamma: [0.5]}}}\n"
    "environments: {'Eis, glatt': {id: FrozenLake-v1}}\n"
)


@pytest.fixture(params=["ascii", "cp1252", "cp437"])
def terminal(request, monkeypatch, tmp_path):
    """Run a command line with standard output in another encoding; what the terminal shows."""
    monkeypatch.chdir(tmp_path)
    (tmp_path / "länge.yml").write_text(STUDY, encoding="utf-8")

    def run(module, *words):
        stream = io.TextIOWrapper(io.BytesIO(), encoding=request.param)
        monkeypatch.setattr(sys, "stdout", stream)
        monkeypatch.setattr(sys, "argv", [f"{module.__name__}.py", *words])
        with pytest.raises(SystemExit) as stop:
            run_command(module.main)
        stream.flush()
        return stop.value.code, stream.buffer.getvalue().decode(request.param)

    return run


def test_training_and_playing(terminal):
    code, out = terminal(train, *ANGLE, "--seed", "0", "-n", "300")
    assert code == 0
    assert re.search(r"over \d+ episodes", out)
    code, out = terminal(enjoy, *ANGLE, "--render", "none", "--n-episodes", "2")
    assert code == 0
    assert " ± " in out or " +- " in out
    assert terminal(train, "--list")[0] == 0
    assert terminal(enjoy, "--help")[0] == 0


def test_comparing(terminal, tmp_path):
    code, out = terminal(compare, "länge.yml", "--no-report", "-f", "studies")
    assert code == 0
    assert "als inf?" in out or "als ∞?" in out
    assert "gamma = 0.5" in out or "γ = 0.5" in out
    assert (tmp_path / "studies" / "länge" / "runs" / "Ärger_日本" / "Eis,_glatt_2").is_dir()


def test_a_machine_that_knows_ascii_alone(tmp_path):
    """Files too are then opened as ASCII where nothing else is said; with figures and page."""
    labels = STUDY.replace("Ärger 日本", "anger")  # folders
    (tmp_path / "s.yml").write_text(labels, encoding="utf-8")
    plain = {"LC_ALL": "C", "PYTHONUTF8": "0", "PYTHONCOERCECLOCALE": "0"}
    done = subprocess.run(
        [sys.executable, str(ROOT / "compare.py"), "s.yml", "-f", "studies"],
        cwd=tmp_path,
        env={**os.environ, **plain, "PYTHONIOENCODING": "ascii", "PYTHONPATH": str(ROOT)},
        capture_output=True,
        check=False,
    )
    assert (done.returncode, done.stderr) == (0, b"")
    assert b"Gr??er als inf?" in done.stdout
    page = (tmp_path / "studies" / "s" / "report.html").read_text(encoding="utf-8")
    assert "Größer als ∞?" in page
