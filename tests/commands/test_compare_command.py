"""compare.py and tune.py as a user types them: what is run, what is skipped, and what survives."""

import contextlib
import json
import os
import re
import shutil
import signal
import subprocess
import sys
import time
from pathlib import Path

import gymnasium as gym
import pandas as pd
import pytest
from filelock import FileLock
from PIL import Image

from rl_yardstick.envs.bandits import log_uniformly
from rl_yardstick.experiments.off_policy import difference_in_value
from tests.pipeline.short_runs import trained

COMPARE = Path(__file__).parents[2] / "compare.py"
LAKE = ["--env", "FrozenLake-v1", "--no-report", "-f", "studies"]
PAIR = [*LAKE, "--algos", "qlearning", "sarsa", "--n-episodes", "60"]


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


@pytest.mark.usefixtures("in_this_process")
def test_what_is_there_is_not_run_again_and_is_what_train_py_makes(typed, own_folder):
    study = own_folder / "studies" / "FrozenLake-v1_qlearning-sarsa"
    assert "2 runs, 0 of them there already" in typed.done("compare.py", *PAIR, "--seeds", 1)
    first = records(study)
    assert sorted(first) == [("qlearning", "FrozenLake-v1_1"), ("sarsa", "FrozenLake-v1_1")]
    assert names(study) == FILES
    assert "4 runs, 2 of them there already" in typed("compare.py", *PAIR, "--seeds", 2)[1]
    assert first.items() <= records(study).items()
    assert sorted(rows(study)["seed"]) == [0, 0, 1, 1]
    words = ["--algo", "sarsa", "--env", "FrozenLake-v1", "--seed", 0, "--n-episodes", 60]
    assert typed("train.py", *words)[0] == 0
    places = (own_folder / "logs", study / "runs")
    paths = (place / "sarsa" / "FrozenLake-v1_1" / "0.monitor.csv" for place in places)
    theirs, ours = (pd.read_csv(path, skiprows=1)[["r", "l"]] for path in paths)
    assert theirs.equals(ours)
    # Finished runs of other settings stay as they are.
    first = records(study)
    err = typed.refused("compare.py", *PAIR, "--seeds", 2, "-params", "gamma:0.9")
    assert "4 finished runs have other settings (gamma: 0.995 there, 0.9 now): give" in err
    assert records(study) == first
    # What a study's record says is enough to do it elsewhere.
    (own_folder / "copy").mkdir()
    (own_folder / "copy" / "study.json").write_bytes((study / "study.json").read_bytes())
    assert typed("compare.py", "--resume", "copy", "--no-report")[0] == 0
    columns = ["agent", "seed", "final", "training", "n_timesteps"]
    assert rows(own_folder / "copy")[columns].equals(rows(study)[columns])
    said = "--seeds cannot be given with --resume"
    assert said in typed.refused("compare.py", "--resume", "copy", "--seeds", 3)


@pytest.mark.usefixtures("in_this_process")
def test_films_and_pages_of_training(typed, own_folder, monkeypatch):
    # What takes longest.
    monkeypatch.setattr("rl_yardstick.report.figures.write_figures", lambda *_: [])
    monkeypatch.setattr("rl_yardstick.report.page.world_sections.film_of", lambda _: None)
    words = ["--env", "FrozenLake-v1", "--algos", "qlearning", "--n-episodes", 40, "--seeds", 1]
    words += ["-j", 1, "-f", "studies", "--watch-learning", "--render-every", 20]
    out = typed.done("compare.py", *words)
    study = own_folder / "studies" / "FrozenLake-v1_qlearning"
    place = "learning/qlearning/FrozenLake-v1_1.html"
    assert place in out.split()
    assert "<h1>qlearning on FrozenLake-v1</h1>" in (study / place).read_text(encoding="utf-8")
    assert f'href="{place}"' in (study / "report.html").read_text(encoding="utf-8")
    # The page stays as it is where nothing is new.
    page = study / "report.html"
    made = page.stat().st_mtime_ns
    assert {place, page.name} <= {*typed("compare.py", *words)[1].split()}
    assert page.stat().st_mtime_ns == made
    assert typed("compare.py", *words, "--metric", "best")[0] == 0
    assert page.stat().st_mtime_ns > made
    films = sorted(study.glob("films/*"))
    assert [path.name for path in films] == [f"qlearning_FrozenLake-v1_{n}.gif" for n in (20, 40)]
    for path in films:
        with Image.open(path) as film:
            assert film.n_frames > 1


def living(leader):
    """The processes of a command, but for those that are only remembered for their parents."""
    for path in Path("/proc").glob("[0-9]*/stat"):
        with contextlib.suppress(OSError):
            state, _, _, session = path.read_text().rpartition(")")[2].split()[:4]
            if int(session) == leader and state != "Z":
                yield path.parent.name


WALKS = Path(__file__).parents[1] / "experiments" / "walks.py"
SLOW = "--env Walk-v0 --env-kwargs is_slow:True --gym-packages walks --algos qlearning --no-report"
SLOW = [*SLOW.split(), "-n", "2000", "--seeds", "2", "-j", "2", "-f", "studies"]


@pytest.fixture
def begun(own_folder):
    """A study in the middle of its runs: the command, and its folder."""
    shutil.copy(WALKS, own_folder)
    words = [sys.executable, str(COMPARE), *SLOW]
    told = {"stdout": subprocess.PIPE, "stderr": subprocess.PIPE, "text": True}
    process = subprocess.Popen(words, **told, start_new_session=True)
    study = own_folder / "studies" / "Walk-v0_qlearning"
    wait_for(lambda: len(list(study.glob("runs/*/*/state.bin"))) == 2)
    yield process, study
    if process.poll() is None:
        os.killpg(process.pid, signal.SIGKILL)


def states(study):
    return [json.loads(path.read_text())["state"] for path in study.glob("runs/*/*/run.json")]


@pytest.mark.usefixtures("in_this_process")
@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGKILL])
def test_the_same_command_does_what_is_left(number, typed, own_folder, begun):
    process, study = begun
    # A second command says that the folder is in use, and touches nothing.
    assert "in use by another command" in typed.refused("compare.py", *SLOW, "-params", "gamma:0.5")
    # A terminal sends a signal to all processes.
    (os.killpg if number == signal.SIGINT else os.kill)(process.pid, number)
    out, err = process.communicate(timeout=120)
    wait_for(lambda: not [*living(process.pid)])
    if number == signal.SIGKILL:
        assert process.returncode == -number
    else:
        assert (process.returncode, err) == (128 + number, "")
        hint = f"stopped; continue with: python {COMPARE} --resume studies/Walk-v0_qlearning "
        assert f"{hint}--gym-packages walks" in " ".join(out.replace("\\\n", "").split())
        assert states(study) == ["interrupted"] * 2
    (own_folder / "mark").touch()
    begun_at = {path: path.stat().st_mtime_ns for path in study.glob("runs/*/*/0.monitor.csv")}
    words = ("--resume", study, "--gym-packages", "walks", "--no-report")
    assert "2 runs, 0 of them there already" in typed.done("compare.py", *words)
    assert len(begun_at) == 2
    assert states(study) == ["finished"] * 2
    assert names(study) == FILES


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


@pytest.mark.usefixtures("in_this_process")
def test_it_grows_until_decided_and_remembers_its_looks(typed, own_folder):
    (own_folder / "bandits.yml").write_text(BANDITS)
    words = ["bandits.yml", "--until-decided", "--no-report", "--max-seeds", 14, "-j", 2, "-f", "s"]
    whole = typed.done("compare.py", *words)
    assert "look 1 of 3, at 6 seeds: " in whole
    study = own_folder / "s" / "bandits"
    n_runs, record = len(rows(study)), (study / "study.json").read_bytes()
    last = f"{n_runs} runs, where 14 seeds of each agent would be 42; "
    assert last_line(whole).startswith(last)
    assert last_line(typed.done("compare.py", *words)) == last_line(whole)
    assert (study / "study.json").read_bytes() == record


def test_agents_of_the_library_and_blind_ones_are_judged(typed, tmp_path, monkeypatch):
    monkeypatch.setenv("COLUMNS", "120")  # room for the paths of runs
    log = {"env_kwargs": {"log": "log.csv"}}
    small = {"n_steps": 64, "batch_size": 64}
    with gym.make("SegmentBandit-v0") as env:
        log_uniformly(env, 1500, 0, tmp_path / "log.csv")
    blind, ppo = "logs/thompson/ReplayBandit-v0_1", "logs/ppo/ReplayBandit-v0_1"
    trained("thompson", "ReplayBandit-v0", {"ignore_context": True, **log}, n_timesteps=1500)
    trained("ppo", "ReplayBandit-v0", {**small, **log}, n_timesteps=200)
    out = typed.done("compare.py", "--logged", "log.csv", "--policy", blind, ppo)
    for run in (blind, ppo):
        assert f"{run} was trained on this log: its figures flatter it" in out


def test_the_python_of_the_page_runs(tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    page = Path(__file__).parents[2] / "docs" / "bandits.md"
    draw, decide = re.findall(r"```python\n(.*?)```", page.read_text(), re.DOTALL)
    names = {}
    exec(draw, names)  # noqa: S102
    exec(decide, names)  # noqa: S102
    names["env"].close()
    printed = capsys.readouterr().out
    # What the page quotes: +0.036 [+0.016, +0.056] against arm 1.
    assert printed.startswith("always arm 1 Estimate(point=0.036")
    estimate = difference_in_value(names["linucb"].terms, names["best"].terms, n_comparisons=4)
    assert (estimate.low, estimate.high) == pytest.approx((0.016, 0.056), abs=6e-4)


SPACE = """\
default:
  learning_rate: {low: 0.01, high: 1.0, scale: log}
  gamma: {low: 0.5, high: 1.0}
"""
# Without a look ahead nothing is learnt but the last step.
BLIND = "FrozenLake-v1: {n_episodes: 600, learning_rate: 0.1, gamma: 0.0}"
SEARCH = """
--env FrozenLake-v1 --env-kwargs is_slippery:False --algo qlearning --n-episodes 600
--search-space space.yml --conf-file blind.yml -j 1 --no-report
--trials 4 --seeds-per-trial 1 --n-startup-trials 3 --retest 1 --retest-seeds 8
--until-decided --max-retest-seeds 12
"""
PLACE = Path("logs/tuning/FrozenLake-v1_qlearning")


@pytest.fixture
def files(own_folder):
    (own_folder / "space.yml").write_text(SPACE)
    (own_folder / "blind.yml").write_text(BLIND)


@pytest.mark.usefixtures("in_this_process")
def test_a_search_finds_better_settings_and_its_re_test_grows_until_decided(typed, files):
    out = typed.done("tune.py", *SEARCH.split())
    assert "look 1 of 2, at 8 seeds: all pairs are decided" in out
    record = json.loads((PLACE / "tuning.json").read_text())
    assert len(record["trials"]) == 4
    for trial in record["trials"]:
        assert sorted(trial["figures"]) == [str(seed) for seed in record["seeds"]]
        assert [trial["value"]] == [*trial["figures"].values()]  # one seed
    _, best = record["retest"]["settings"]
    winner = best["label"]
    assert winner != "trial 0"
    assert f"winner: {winner}, in {PLACE / 'winner.yml'}" in out
    assert f"{winner}: 1 (95 % interval of the mean: 1 to 1), 8 runs" in out
    assert record["retest"]["winner"] == winner
    assert record["retest"]["optimism"] == best["in_search"] - best["held_out"]
    assert record["held_out_seeds"] == [*range(1000, 1008)]
    assert "16 runs, 16 of them there already" in typed.done("tune.py", *SEARCH.split())
    err = typed.refused("tune.py", *SEARCH.split(), "--max-retest-seeds", "20")
    assert "the looks were planned before the first of them and cannot change" in err
    with FileLock(PLACE / ".lock"):
        err = typed.refused("tune.py", *SEARCH.split())
    assert f"{PLACE} is in use by another command" in err
