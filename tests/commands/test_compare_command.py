"""compare.py as a user types it: what is run, what is skipped, and what survives."""

import contextlib
import itertools
import json
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
from experiments import launching
from pipeline.errors import UserError

ROOT = Path(compare.__file__).parent
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
    """Raises on the 50th step of the training with seed 1."""

    def act(self):
        if self.seed == 1 and self.steps == 50:
            raise RuntimeError("thin ice")


class Killed(Walk):
    """Kills its process once, when there is a state; says what its first step is after that."""

    def act(self):
        if MARK.exists():
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


for kind in (Fragile, Killed, Slow):
    gym.register(f"{kind.__name__}-v0", entry_point=kind, max_episode_steps=20)
'''


@pytest.fixture
def folder(own_folder):
    (own_folder / "fragile_walks.py").write_text(FRAGILE)
    return own_folder


@pytest.fixture
def type_command(folder, type_study):
    return type_study


def start(*words, program=ROOT / "compare.py"):
    return subprocess.Popen(
        [sys.executable, str(program), *map(str, words)],
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
        start_new_session=True,
    )


def wait_for(condition, seconds=60):
    deadline = time.monotonic() + seconds
    while not condition():
        assert time.monotonic() < deadline
        time.sleep(0.05)


FILES = ["curves.csv.gz", "runs", "study.yml", "summary.csv", "verdicts.md", "verdicts.tex"]


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
    code, out, err = type_command(*PAIR, "--seeds", 2)
    assert (code, err) == (0, "")
    assert "4 runs, 0 of them there already" in out
    first = records(study)
    runs = itertools.product(("qlearning", "sarsa"), ("FrozenLake-v1_1", "FrozenLake-v1_2"))
    assert sorted(first) == list(runs)
    assert names(study) == FILES
    before = (study / "summary.csv").read_text()
    code, out, _ = type_command(*PAIR, "--seeds", 2)
    assert (code, "4 runs, 4 of them there already" in out) == (0, True)
    assert records(study) == first
    assert (study / "summary.csv").read_text() == before
    assert "6 runs, 4 of them there already" in type_command(*PAIR, "--seeds", 3)[1]
    assert first.items() <= records(study).items()
    assert sorted(rows(study)["seed"]) == [0, 0, 1, 1, 2, 2]
    words = "train.py --algo sarsa --env FrozenLake-v1 --seed 0 --n-episodes 60 --verbose 0"
    monkeypatch.setattr(sys, "argv", words.split())
    assert train.main() == 0
    places = (folder / "logs", study / "runs")
    paths = (place / "sarsa" / "FrozenLake-v1_1" / "0.monitor.csv" for place in places)
    theirs, ours = (pd.read_csv(path, skiprows=1)[["r", "l"]] for path in paths)
    assert theirs.equals(ours)
    # Finished runs of other settings are replaced only when that is asked for.
    first, other = records(study), [*PAIR, "--seeds", 3, "-params", "gamma:0.9"]
    code, out, err = type_command(*other)
    assert (code, out.count("\n"), err.count("\n")) == (2, 1, 1)
    assert "6 finished runs have other settings (gamma: 0.995 there, 0.9 now): --name" in err
    assert records(study) == first
    code, out, _ = type_command(*other, "--replace")
    assert (code, "6 runs, 0 of them there already" in out) == (0, True)
    assert not set(records(study).values()) & set(first.values())
    place = study / "replaced" / "1"
    assert f"6 runs that are done again: the old folders are in {place.relative_to(folder)}" in out
    place.rename(place.parent / "runs")
    assert records(place.parent) == first


def test_the_first_training_is_played_of_a_users_own_environment(type_command, folder, monkeypatch):
    monkeypatch.setattr("report.figures.write_figures", lambda *_: [])  # which take longest
    monkeypatch.setattr("report.films.film_of", lambda _: None)
    words = ["--env", "Fragile-v0", "--gym-packages", "fragile_walks", "--algos", "qlearning"]
    words += ["--seeds", 1, "-n", 300, "-j", 1, "-f", "studies", "--watch-learning"]
    code, out, err = type_command(*words)
    assert (code, err) == (0, "")
    study, place = folder / "studies" / "Fragile-v0_qlearning", "learning/qlearning/Fragile-v0_1"
    assert f"{place}.html" in out.split()
    assert "300 steps" in (study / f"{place}.html").read_text(encoding="utf-8")
    assert f'href="{place}.html"' in (study / "report.html").read_text(encoding="utf-8")
    code, out, err = type_command(*words, "--no-report")
    assert (code, out, err.count("\n")) == (2, "", 1)
    assert "leave out --no-report" in err


# --- runs that fail or are killed -----------------------------------------------------------------


def test_each_run_ends_for_itself_alone(type_command, folder):
    """A killed one goes on from what it has saved; what fails is told, and where it was."""
    (folder / "walks.yml").write_text(
        "agents: [qlearning]\nn_timesteps: 500\nseeds: 2\nenvironments: [Fragile-v0, Killed-v0]\n"
    )
    words = ["walks.yml", "--gym-packages", "fragile_walks", "--no-report", "-f", "studies"]
    code, out, err = type_command(*words, "-j", 2)
    assert (code, err) == (1, "")
    assert int((folder / "mark").read_text()) > 1
    study = folder / "studies" / "walks"
    done = rows(study).groupby("environment")["seed"].apply(sorted).to_dict()
    assert done == {"Fragile-v0": [0], "Killed-v0": [0, 1]}
    assert not (study / ".drafts").exists()
    (log,) = (study / "failures").iterdir()
    assert log.name == "qlearning@Fragile-v0_2.txt"
    assert "RuntimeError: thin ice" in log.read_text()
    assert re.search(r"qlearning on Fragile-v0, seed 1: .*thin ice", out)
    assert str(log.relative_to(folder)) in out
    assert "1 of 2 runs of qlearning is missing" in " ".join(out.split())


# --- a command that is stopped or killed, and a second one beside it ------------------------------


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
def begun(type_command, folder):
    """A study in the middle of its runs: the command, its folder, all of its processes."""
    process = start(*SLOW)
    study = folder / "studies" / "Slow-v0_qlearning"
    wait_for(lambda: len(list(study.glob(".drafts/*/0.monitor.csv"))) == 2)
    started = session_of(process.pid)
    assert len(started) >= 4
    yield process, study, started
    if process.poll() is None:
        os.killpg(process.pid, signal.SIGKILL)


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGKILL])
def test_a_signal_ends_all_and_the_same_command_goes_on(type_command, folder, begun, number):
    process, study, started = begun
    if number == signal.SIGINT:  # a second driver says who is at work, and touches nothing
        before = [*sorted(study.iterdir()), *sorted(study.glob(".drafts/*"))]
        code, _, err = type_command(*SLOW, "-params", "gamma:0.5", "--replace", "--repair")
        assert (code, err.count("\n")) == (2, 1)
        assert f"process {process.pid} on " in err
        assert [*sorted(study.iterdir()), *sorted(study.glob(".drafts/*"))] == before
    kept, _ = sorted(study.glob(".drafts/*"))
    if number == signal.SIGKILL:
        (kept / "state").mkdir()
        (kept / "state" / "odd.state").touch()  # it is no state: the run begins anew
    (os.killpg if number == signal.SIGINT else os.kill)(process.pid, number)
    out, err = process.communicate(timeout=60)
    wait_for(lambda: not any(map(is_alive, started)))
    if number == signal.SIGKILL:
        # Of the driver itself its lock is left, which nobody heeds; and what can be gone on with.
        wait_for(lambda: list(study.glob(".drafts/*")) == [kept])
        assert names(study) == [".drafts", ".lock"]
    else:
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


def figures(folder):
    """What a study has come to, but for times."""
    table = rows(folder).drop(columns=["seconds", "cpu_seconds", "path"])
    looks = json.loads((folder / "looks.json").read_text())
    for environment in looks["environments"].values():
        for look in environment["taken"]:
            del look["date"]
    return table.sort_values(["agent", "seed"]).to_csv(index=False), looks


def last_line(out):
    return [line for line in out.splitlines() if line][-1]


@pytest.fixture
def power_cut(monkeypatch):
    """Within the ``with`` statement the second batch of runs ends after the first of them."""
    do_runs = launching.execute

    @contextlib.contextmanager
    def cut():
        calls = []

        def stopped(runs, *args):
            calls.append(len(runs))
            if len(calls) == 2:
                do_runs(runs[:1], *args)
                raise UserError("the power is gone")
            return do_runs(runs, *args)

        with monkeypatch.context() as patch:
            patch.setattr(launching, "execute", stopped)
            yield
        assert len(calls) == 2

    return cut


def test_it_grows_until_decided_also_when_it_is_stopped_between(type_command, folder, power_cut):
    (folder / "bandits.yml").write_text(BANDITS)
    words = ["bandits.yml", "--until-decided", "--no-report", "--max-seeds", 14, "-j", 2]
    code, whole, err = type_command(*words, "-f", "whole")
    assert (code, err) == (0, "")
    assert "BernoulliBandit-v0, look 1 of " in whole
    n_runs = len(rows(folder / "whole" / "bandits"))
    last = f"{n_runs} runs, where 14 seeds of each agent would be 42; "
    assert last_line(whole).startswith(last)
    with power_cut():
        assert type_command(*words, "-f", "parts")[0] == 2
    for place in ("parts", "whole"):  # gone on with, and asked for once more
        code, out, _ = type_command(*words, "-f", place)
        assert (code, last_line(out)) == (0, last_line(whole))
        assert figures(folder / place / "bandits") == figures(folder / "whole" / "bandits")


def test_runs_that_fail_are_tried_once_and_do_not_hold_a_study_up(type_command):
    words = ["--env", "Fragile-v0", "--gym-packages", "fragile_walks", "--no-report", "-j", 2]
    words += ["--algos", "qlearning", "sarsa", "--seeds", 6, "--until-decided", "--max-seeds", 7]
    code, out, _ = type_command(*words, "-n", 60, "-f", "s")
    assert code == 1
    assert out.count("thin ice; see ") == 2
    assert "Fragile-v0, look 1 of 2: 1 of 1 pairs is undecided" in out
    assert last_line(out) == (
        "14 runs, where 7 seeds of each agent would be 14; "
        "undecided: qlearning and sarsa on Fragile-v0"
    )


# --- what else a study keeps ----------------------------------------------------------------------


def test_films_of_training(type_command, folder):
    words = [*LAKE, "--algos", "qlearning", "--n-episodes", "60", "--seeds", 2]
    assert type_command(*words)[0] == 0
    study = folder / "studies" / "FrozenLake-v1_qlearning"
    table = rows(study)
    code, out, err = type_command(*words, "--render-every", 20)
    assert (code, err) == (0, "")
    # The first run is done again, this time with checkpoints; training is the same with them.
    assert "2 runs, 1 of them there already" in out
    timeless = [column for column in table if column not in ("path", "seconds", "cpu_seconds")]
    assert rows(study)[timeless].equals(table[timeless])
    films = sorted(study.glob("films/*"))
    assert [path.name for path in films] == [
        f"qlearning_FrozenLake-v1_{n}.gif" for n in (20, 40, 60)
    ]
    for path in films:
        with Image.open(path) as film:
            assert film.n_frames > 1
    times = [path.stat().st_mtime_ns for path in films]
    assert "2 runs, 2 of them there already" in type_command(*words, "--render-every", 20)[1]
    assert [path.stat().st_mtime_ns for path in films] == times
