"""train.py and tune.py as a user types them: what is run, what is said, what is written down."""

import json
import os
import subprocess
import sys
import time
from pathlib import Path

import pytest
import yaml

import train

ROOT = Path(train.__file__).parent
QUICK = ["--algo", "qlearning", "--env", "FrozenLake-v1", "--seed", "0", "-n", "500"]


def test_the_head_says_what_auto_stands_for_and_what_a_discount_costs(type_command, tmp_path):
    slipping = ["--algo", "qlearning", "--env", "Warehouse-v0", "--env-kwargs", "slip:0.2"]
    code, out, _ = type_command("train.py", *slipping, "-n", "500", "--seed", "0")
    assert code == 0
    assert "gamma=0.9995 (auto: 1 - 1/(2 x time limit of 1,000))" in " ".join(out.split())
    assert "exact planning" not in out
    run = tmp_path / "logs" / "qlearning" / "Warehouse-v0_1"
    spec = json.loads((run / "run.json").read_text())["spec"]
    assert (spec["hyperparams"]["gamma"], *spec["origins"]) == (0.9995, "gamma", "learning_rate")
    assert yaml.safe_load((run / "Warehouse-v0" / "config.yml").read_text())["gamma"] == 0.9995
    code, out, _ = type_command(
        *("train.py", *slipping, "-n", "500", "--seed", "0", "-params", "gamma:0.99")
    )
    assert code == 0
    assert "at gamma 0.99 even exact planning scores 0.00 here; 0.9995: 1.00" in out


# --- --watch-learning: the page that plays a training -------------------------------------------

WATCHED = ("train.py", *QUICK[:-1], "300", "--verbose", "1", "--watch-learning", "page.html")


def test_a_run_that_fails_leaves_the_page_of_what_it_came_to(type_command, tmp_path):
    words = ("-params", "learning_rate:30", "gamma:1", "--eval-freq", "-1")
    words = ("--env", "Warehouse-v0", "-n", "3000", *words)
    code, out, err = type_command(*WATCHED, *words)
    assert (code, err.count("\n")) == (2, 1)
    assert "q_tables of the agent at step 3,000 is nan" in err
    assert out.splitlines()[-1] == "learning page.html"
    assert "3,000 steps" in (tmp_path / "page.html").read_text(encoding="utf-8")


# --- a search ---------------------------------------------------------------------------------


SPACE = """\
default:
  learning_rate: {low: 0.01, high: 1.0, scale: log}
  gamma: {low: 0.5, high: 1.0}
"""
SEARCH = ["--env", "FrozenLake-v1", "--algo", "qlearning", "--search-space", "space.yml"]
SEARCH += ["--n-episodes", "40", "--seeds-per-trial", "2", "--retest-seeds", "2", "--retest", "1"]
SEARCH += ["--n-startup-trials", "3", "-j", "1", "--no-report", "--storage", "journal:trials.log"]
FOLDER = Path("logs/tuning/FrozenLake-v1_qlearning")


@pytest.fixture
def search(own_folder, type_study):
    """Do a search in this process, inside a folder of its own."""
    (own_folder / "space.yml").write_text(SPACE)
    return lambda *words: type_study(*SEARCH, *words, program="tune.py")


UNTIL_DECIDED = ["--until-decided", "--max-retest-seeds", "12"]
# Without a look ahead nothing is learnt but the last step.
BLIND = "FrozenLake-v1: {n_episodes: 600, learning_rate: 0.1, gamma: 0.0}"
NEAR = "FrozenLake-v1: {n_episodes: 600, learning_rate: 0.1, gamma: 0.9}"
NEARBY = "default: {learning_rate: {low: 0.09, high: 0.11}}"
EASY = ["--env-kwargs", "is_slippery:False", "--conf-file", "blind.yml", "--retest", "2"]


def test_a_saturated_search_ends_and_its_re_test_grows_until_decided(search, own_folder):
    (own_folder / "blind.yml").write_text(BLIND)
    words = [*EASY, *UNTIL_DECIDED, "--trials", "40", "--retest-seeds", "8", "--n-episodes", "600"]
    code, out, err = search(*words)
    assert (code, err) == (0, "")
    assert "settings have the optimum on all seeds" in out
    assert "the search ends here" in out
    assert "FrozenLake-v1, look 1 of 2: all pairs are decided" in out
    assert "better on average than the shipped settings" in out
    record = json.loads((FOLDER / "tuning.json").read_text())
    assert record["n_at_optimum"] == 10
    best = [each for each in record["trials"] if len(each["at_optimum"]) == 2]
    best.sort(key=lambda each: sum(each["at_optimum"].values()))
    labels = [each["label"] for each in record["retest"]["settings"]]
    assert labels == ["shipped", *(f"trial {each['number']}" for each in best[:2])]
    assert (record["retest"]["winner"], record["held_out_seeds"]) == (
        labels[1],
        [*range(1000, 1008)],
    )
    code, again, _ = search(*words)
    assert (code, out.splitlines()[-8:-1]) == (0, again.splitlines()[-8:-1])
    assert "24 runs, 24 of them there already" in again
    code, _, err = search(*words, "--max-retest-seeds", "20")
    assert (code, err.count("\n")) == (2, 1)
    assert "the looks were fixed before the first of them and cannot change" in err


def test_a_growing_re_test_that_is_stopped_between_goes_on(search, own_folder, power_cut):
    (own_folder / "near.yml").write_text(NEAR)
    (own_folder / "nearby.yml").write_text(NEARBY)
    words = [*UNTIL_DECIDED, "--trials", "3", "--retest-seeds", "8", "--n-episodes", "600"]
    words += ["--conf-file", "near.yml", "--search-space", "nearby.yml"]
    assert search(*words, "--name", "whole")[0] == 0
    with power_cut():
        assert search(*words, "--name", "parts")[0] == 2
    assert search(*words, "--name", "parts")[0] == 0
    whole, parts = (
        json.loads((FOLDER.parent / name / "tuning.json").read_text())
        for name in ("whole", "parts")
    )
    assert whole["held_out_seeds"] == [*range(1000, 1012)]
    assert parts["retest"] == whole["retest"]
    assert parts["retest"]["settings"][1]["verdict"] == "undecided"


def finished_runs():
    return sorted(FOLDER.glob("runs/*/*/run.json"))


def test_a_driver_that_is_killed_and_started_again_beside_another_makes_one_study(search):
    def start():
        return subprocess.Popen(
            [sys.executable, str(ROOT / "tune.py"), *SEARCH, "--trials", "5"],
            stdout=subprocess.PIPE,
            stderr=subprocess.STDOUT,
            text=True,
            env={**os.environ, "PYTHONPATH": str(ROOT)},
        )

    killed = start()
    while len(finished_runs()) < 3:
        assert killed.poll() is None, killed.communicate()
        time.sleep(0.01)
    killed.kill()
    killed.communicate()
    before = {path: path.stat().st_mtime_ns for path in finished_runs()}
    other = start()
    code, out, err = search("--trials", "5")
    said, _ = other.communicate(timeout=120)
    assert other.returncode == 0, said
    assert (code, err) == (0, "")
    assert {path: path.stat().st_mtime_ns for path in before} == before
    record = json.loads((FOLDER / "tuning.json").read_text())
    assert [trial["number"] for trial in record["trials"]] == list(range(5))
    assert {trial["state"] for trial in record["trials"]} <= {"complete", "pruned"}
    assert len({json.dumps(trial["params"]) for trial in record["trials"]}) == 5
    assert "5 trials: " in out
