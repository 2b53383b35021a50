"""compare.py as a user types it: what is run, what is skipped, and what survives."""

import contextlib
import json
import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import pandas as pd
import pytest
from PIL import Image

COMPARE = Path(__file__).parents[2] / "compare.py"
LAKE = ["--env", "FrozenLake-v1", "--no-report", "-f", "studies"]
PAIR = [*LAKE, "--algos", "qlearning", "sarsa", "--n-episodes", "60"]

# An environment of a user's own, slow while there is no file that says it may hurry.
WALKS = """
import time
from pathlib import Path

import gymnasium as gym

MARK = Path(__file__).with_name("mark")


class Slow(gym.Env):
    observation_space = gym.spaces.Discrete(5)
    action_space = gym.spaces.Discrete(2)

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        self.place = 0
        return 0, {}

    def step(self, action):
        if not MARK.exists():
            time.sleep(0.02)
        self.place = min(max(self.place + 2 * int(action) - 1, 0), 4)
        return self.place, float(self.place == 4), self.place == 4, False, {}


gym.register("Slow-v0", entry_point=Slow, max_episode_steps=20)
"""


@pytest.fixture
def folder(own_folder):
    (own_folder / "walks.py").write_text(WALKS)
    return own_folder


@pytest.fixture
def type_command(folder, type_study):
    return type_study


def wait_for(condition, seconds=60):
    deadline = time.monotonic() + seconds
    while not condition():
        assert time.monotonic() < deadline
        time.sleep(0.05)


FILES = ["curves.csv.gz", "runs", "study.json", "summary.csv"]
FILES += [f"verdicts.{suffix}" for suffix in ("csv", "json", "md", "tex")]


def records(study):
    """When each run was written down, by agent and number."""
    return {
        (path.parent.parent.name, path.parent.name): path.stat().st_mtime_ns
        for path in study.glob("runs/*/*/run.json")
    }


def rows(study):
    return pd.read_csv(study / "summary.csv")


def names(folder):
    return sorted(path.name for path in folder.iterdir() if path.name != ".lock")


def test_what_is_there_is_not_run_again_and_is_what_train_py_makes(type_command, folder):
    study = folder / "studies" / "FrozenLake-v1_qlearning-sarsa"
    code, out, err = type_command(*PAIR, "--seeds", 1)
    assert (code, err) == (0, "")
    assert "2 runs, 0 of them there already" in out
    first = records(study)
    assert sorted(first) == [("qlearning", "FrozenLake-v1_1"), ("sarsa", "FrozenLake-v1_1")]
    assert names(study) == FILES
    assert "4 runs, 2 of them there already" in type_command(*PAIR, "--seeds", 2)[1]
    assert first.items() <= records(study).items()
    assert sorted(rows(study)["seed"]) == [0, 0, 1, 1]
    words = ["--algo", "sarsa", "--env", "FrozenLake-v1", "--seed", 0, "--n-episodes", 60]
    assert type_command(*words, program="train.py")[0] == 0
    places = (folder / "logs", study / "runs")
    paths = (place / "sarsa" / "FrozenLake-v1_1" / "0.monitor.csv" for place in places)
    theirs, ours = (pd.read_csv(path, skiprows=1)[["r", "l"]] for path in paths)
    assert theirs.equals(ours)
    # Finished runs of other settings stay as they are.
    first, other = records(study), [*PAIR, "--seeds", 2, "-params", "gamma:0.9"]
    code, out, err = type_command(*other)
    assert (code, err.count("\n")) == (2, 1)
    assert "4 finished runs have other settings (gamma: 0.995 there, 0.9 now): give" in err
    assert records(study) == first
    # What a study's record says is enough to do it elsewhere.
    (folder / "copy").mkdir()
    (folder / "copy" / "study.json").write_bytes((study / "study.json").read_bytes())
    assert type_command("--resume", "copy", "--no-report")[0] == 0
    columns = ["agent", "seed", "final", "training", "n_timesteps"]
    assert rows(folder / "copy")[columns].equals(rows(study)[columns])
    code, _, err = type_command("--resume", "copy", "--seeds", 3)
    assert (code, "--seeds cannot be given with --resume" in err) == (2, True)


def test_films_and_pages_of_training(type_command, folder, monkeypatch):
    monkeypatch.setattr(
        "rl_yardstick.report.figures.write_figures", lambda *_: []
    )  # which take longest
    monkeypatch.setattr("rl_yardstick.report.films.film_of", lambda _: None)
    words = ["--env", "FrozenLake-v1", "--algos", "qlearning", "--n-episodes", 40, "--seeds", 1]
    words += ["-j", 1, "-f", "studies", "--watch-learning", "--render-every", 20]
    code, out, err = type_command(*words)
    assert (code, err) == (0, "")
    study = folder / "studies" / "FrozenLake-v1_qlearning"
    place = "learning/qlearning/FrozenLake-v1_1.html"
    assert place in out.split()
    assert "<h1>qlearning on FrozenLake-v1</h1>" in (study / place).read_text(encoding="utf-8")
    assert f'href="{place}"' in (study / "report.html").read_text(encoding="utf-8")
    films = sorted(study.glob("films/*"))
    assert [path.name for path in films] == [f"qlearning_FrozenLake-v1_{n}.gif" for n in (20, 40)]
    for path in films:
        with Image.open(path) as film:
            assert film.n_frames > 1
    code, out, err = type_command(*words, "--no-report")
    assert (code, out, err.count("\n")) == (2, "", 1)
    assert "leave out --no-report" in err


# --- a command that is stopped, and a second one beside it ----------------------------------------


def is_alive(pid):
    """Whether the process runs, and is not only remembered for its parent."""
    with contextlib.suppress(OSError):
        status = Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2]
        return status.split()[0] != "Z"
    return False


def session_of(leader):
    """The processes that a command has started, itself included."""
    found = set()
    for path in Path("/proc").glob("[0-9]*/stat"):
        with contextlib.suppress(OSError):
            fields = path.read_text().rpartition(")")[2].split()
            if int(fields[3]) == leader:
                found.add(int(path.parent.name))
    return found


SLOW = ["--env", "Slow-v0", "--gym-packages", "walks", "--algos", "qlearning"]
SLOW += ["--no-report", "-n", "2000", "--seeds", "2", "-j", "2", "-f", "studies"]


@pytest.fixture
def begun(folder, type_command):
    """A study in the middle of its runs: the command, its folder, all of its processes."""
    process = subprocess.Popen(
        [sys.executable, str(COMPARE), *SLOW],
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
        start_new_session=True,
    )
    study = folder / "studies" / "Slow-v0_qlearning"
    wait_for(lambda: len(list(study.glob("runs/*/*/state.bin"))) == 2)
    yield process, study, session_of(process.pid)
    if process.poll() is None:
        os.killpg(process.pid, signal.SIGKILL)


def states(study):
    return [json.loads(path.read_text())["state"] for path in study.glob("runs/*/*/run.json")]


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM, signal.SIGKILL])
def test_the_same_command_does_what_is_left(number, type_command, folder, begun):
    process, study, started = begun
    # A second command says that the folder is in use, and touches nothing.
    code, _, err = type_command(*SLOW, "-params", "gamma:0.5")
    assert (code, err.count("\n"), "in use by another command" in err) == (2, 1, True)
    if number == signal.SIGINT:
        os.killpg(process.pid, number)  # as a terminal sends it
    else:
        process.send_signal(number)
    out, err = process.communicate(timeout=120)
    wait_for(lambda: not any(map(is_alive, started)))
    if number == signal.SIGKILL:
        assert process.returncode == -number
    else:
        assert (process.returncode, err) == (128 + number, "")
        assert f"stopped; continue with: python {COMPARE} --resume studies/Slow-v0_qlearning" in out
        assert states(study) == ["interrupted"] * 2
    (folder / "mark").touch()
    begun_at = {path: path.stat().st_mtime_ns for path in study.glob("runs/*/*/0.monitor.csv")}
    code, out, _ = type_command("--resume", study, "--gym-packages", "walks", "--no-report")
    assert (code, "2 runs, 0 of them there already" in out) == (0, True)
    assert len(begun_at) == 2
    assert states(study) == ["finished"] * 2
    assert names(study) == FILES


# --- --until-decided -----------------------------------------------------------------------------

BANDITS = """
title: Two bandits
seeds: 6
metric: regret
margin: 1
n_timesteps: 60
environments: [BernoulliBandit-v0]
agents: [ucb, thompson, epsilon_greedy]
"""


def last_line(out):
    return [line for line in out.splitlines() if line][-1]


def test_it_grows_until_decided_and_remembers_its_looks(type_command, folder):
    (folder / "bandits.yml").write_text(BANDITS)
    words = ["bandits.yml", "--until-decided", "--no-report", "--max-seeds", 14, "-j", 2, "-f", "s"]
    code, whole, err = type_command(*words)
    assert (code, err) == (0, "")
    assert "look 1 of 3, at 6 seeds: " in whole
    study = folder / "s" / "bandits"
    n_runs, record = len(rows(study)), (study / "study.json").read_bytes()
    last = f"{n_runs} runs, where 14 seeds of each agent would be 42; "
    assert last_line(whole).startswith(last)
    code, out, _ = type_command(*words)
    assert (code, last_line(out)) == (0, last_line(whole))
    assert (study / "study.json").read_bytes() == record
