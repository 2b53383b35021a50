"""compare.py as a user types it: what is run, what is skipped, and what survives."""

import contextlib
import os
import re
import signal
import subprocess
import sys
import time
from pathlib import Path

import pandas as pd
import pytest
from PIL import Image

import compare
import train

LAKE = ["--env", "FrozenLake-v1", "--no-report", "-f", "studies"]
PAIR = [*LAKE, "--algos", "qlearning", "sarsa", "--n-episodes", "60"]

# Environments of a user's own, which the command imports.
FRAGILE = '''
import os
import signal
import time
from pathlib import Path

import gymnasium as gym

MARK = Path(__file__).with_name("mark")


class Walk(gym.Env):
    """Five places in a row; the goal is the last."""

    observation_space = gym.spaces.Discrete(5)
    action_space = gym.spaces.Discrete(2)
    steps = 0
    seed = None

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        self.place, self.seed = 0, self.seed if seed is None else seed
        return 0, {}

    def step(self, action):
        self.steps += 1
        self.act()
        self.place = min(max(self.place + 2 * int(action) - 1, 0), 4)
        return self.place, float(self.place == 4), self.place == 4, False, {}


class Fragile(Walk):
    """Kills its process once, when there is a state, or raises; then says how far it has come."""

    def act(self):
        if self.seed == 1:
            if self.steps == 50:
                raise RuntimeError("thin ice")
        elif MARK.exists():
            if not MARK.read_text():
                MARK.write_text(str(self.steps))
        elif self.steps == 30:
            time.sleep(1.1)
        elif self.steps == 60:
            MARK.touch()
            os.kill(os.getpid(), signal.SIGKILL)


class Slow(Walk):
    """Takes its time while there is no file that says it may hurry."""

    def act(self):
        if not MARK.exists():
            time.sleep(0.05)


for kind in (Fragile, Slow):
    gym.register(f"{kind.__name__}-v0", entry_point=kind, max_episode_steps=20)
'''


@pytest.fixture
def folder(own_folder):
    (own_folder / "fragile_walks.py").write_text(FRAGILE)
    return own_folder


@pytest.fixture
def type_command(folder, type_study):
    return type_study


def wait_for(condition, seconds=60):
    deadline = time.monotonic() + seconds
    while not condition():
        assert time.monotonic() < deadline
        time.sleep(0.05)


FILES = ["curves.csv.gz", "runs", "study.yml", "summary.csv"]
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
    return sorted(path.name for path in folder.iterdir())


def test_what_is_there_is_not_run_again_and_is_what_train_py_makes(
    type_command, folder, monkeypatch
):
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
    words = "train.py --algo sarsa --env FrozenLake-v1 --seed 0 --n-episodes 60 --verbose 0"
    monkeypatch.setattr(sys, "argv", words.split())
    assert train.main() == 0
    places = (folder / "logs", study / "runs")
    paths = (place / "sarsa" / "FrozenLake-v1_1" / "0.monitor.csv" for place in places)
    theirs, ours = (pd.read_csv(path, skiprows=1)[["r", "l"]] for path in paths)
    assert theirs.equals(ours)
    # Finished runs of other settings are replaced only when that is asked for.
    first, other = records(study), [*PAIR, "--seeds", 2, "-params", "gamma:0.9"]
    code, out, err = type_command(*other)
    assert (code, out.count("\n"), err.count("\n")) == (2, 1, 1)
    assert "4 finished runs have other settings (gamma: 0.995 there, 0.9 now): --name" in err
    assert records(study) == first
    code, out, _ = type_command(*other, "--replace")
    assert (code, "4 runs, 0 of them there already" in out) == (0, True)
    assert not set(records(study).values()) & set(first.values())
    place = study / "replaced" / "1"
    assert f"4 runs that are done again: the old folders are in {place.relative_to(folder)}" in out
    place.rename(place.parent / "runs")
    assert records(place.parent) == first


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


# --- runs that fail or are killed -----------------------------------------------------------------


def test_each_run_ends_for_itself_alone(type_command, folder):
    """A killed one goes on from what it has saved; what fails is told, and where it was."""
    words = ["--env", "Fragile-v0", "--gym-packages", "fragile_walks", "--algos", "qlearning"]
    words += ["-n", 200, "--seeds", 2, "-j", 2, "--no-report", "--name", "walks", "-f", "studies"]
    code, out, err = type_command(*words)
    assert (code, err) == (1, "")
    assert int((folder / "mark").read_text()) > 1
    study = folder / "studies" / "walks"
    assert rows(study)["seed"].tolist() == [0]
    assert not (study / ".drafts").exists()
    (log,) = (study / "failures").iterdir()
    assert "RuntimeError: thin ice" in log.read_text()
    assert re.search(r"qlearning on Fragile-v0, seed 1: .*thin ice", out)
    assert str(log.relative_to(folder)) in out
    assert "1 of 2 runs of qlearning is missing" in " ".join(out.split())


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


SLOW = ["--env", "Slow-v0", "--gym-packages", "fragile_walks", "--algos", "qlearning"]
SLOW += ["--no-report", "-n", "2000", "--seeds", "2", "-j", "2", "-f", "studies"]


@pytest.fixture
def begun(folder, type_command):
    """A study in the middle of its runs: the command, its folder, all of its processes."""
    process = subprocess.Popen(
        [sys.executable, compare.__file__, *SLOW],
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
        start_new_session=True,
    )
    study = folder / "studies" / "Slow-v0_qlearning"
    wait_for(lambda: len(list(study.glob(".drafts/*/0.monitor.csv"))) == 2)
    started = session_of(process.pid)
    assert len(started) >= 4
    yield process, study, started
    if process.poll() is None:
        os.killpg(process.pid, signal.SIGKILL)


def test_ctrl_c_ends_all_and_the_same_command_goes_on(type_command, folder, begun):
    process, study, started = begun
    # A second driver says who is at work, and touches nothing.
    before = [*sorted(study.iterdir()), *sorted(study.glob(".drafts/*"))]
    code, _, err = type_command(*SLOW, "-params", "gamma:0.5", "--replace", "--repair")
    assert (code, err.count("\n")) == (2, 1)
    assert f"process {process.pid} on " in err
    assert [*sorted(study.iterdir()), *sorted(study.glob(".drafts/*"))] == before
    os.killpg(process.pid, signal.SIGINT)
    out, err = process.communicate(timeout=60)
    wait_for(lambda: not any(map(is_alive, started)))
    assert (process.returncode, err) == (130, "compare.py: interrupted\n")
    assert "0 of 2 runs" in out
    assert "the same command continues" in out
    assert not study.exists()
    (folder / "mark").touch()
    code, out, _ = type_command(*SLOW)
    assert (code, "2 runs, 0 of them there already" in out) == (0, True)
    assert len(records(study)) == 2
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
    n_runs, looks = len(rows(study)), (study / "looks.json").read_bytes()
    last = f"{n_runs} runs, where 14 seeds of each agent would be 42; "
    assert last_line(whole).startswith(last)
    code, out, _ = type_command(*words)
    assert (code, last_line(out)) == (0, last_line(whole))
    assert (study / "looks.json").read_bytes() == looks
