"""train.py and tune.py as a user types them: what is run, what is said, what is written down."""

import json
import os
import re
import signal
import subprocess
import sys
import time
import zipfile
from pathlib import Path

import numpy as np
import pytest
import yaml

import train
import tune
from commands import compare
from commands.cli import run_command
from commands.compare import study_spec
from commands.train import build_parser, train_spec
from experiments.plan import plan
from experiments.study import AgentSpec, EnvironmentSpec, StudySpec
from pipeline.environments import training_kwargs
from pipeline.settings import hyperparams
from pipeline.watching import TableRecorder

ROOT = Path(train.__file__).parent
QUICK = ["--algo", "qlearning", "--env", "FrozenLake-v1", "--seed", "0", "-n", "500"]


@pytest.mark.usefixtures("pictures")
def test_a_run_folder_is_whole(type_command, tmp_path):
    code, out, err = type_command("train.py", *QUICK, "--save-freq", "200")
    assert (code, err) == (0, "")
    run = tmp_path / "logs" / "qlearning" / "FrozenLake-v1_1"
    names = "0.monitor.csv FrozenLake-v1 FrozenLake-v1.zip args.yml best_model.zip command.txt "
    names += "config.yml evaluations.npz learning_curve.png rl_model_200_steps.zip "
    names += "rl_model_400_steps.zip run.json value_map.png value_maps.npz"
    assert sorted(path.name for path in run.rglob("*")) == names.split()
    info = json.loads((run / "run.json").read_text())
    assert info["state"] == "finished"
    assert info["n_timesteps"] == 500
    assert info["final"]["exact"]
    assert info["final"]["optimum"] == pytest.approx(0.7442, abs=1e-4)
    assert info["engine"] == "compiled"
    assert f"return {info['final']['mean_return']:.2f} (exact)" in out
    assert "logs/qlearning/FrozenLake-v1_1" in out
    config = yaml.safe_load((run / "FrozenLake-v1" / "config.yml").read_text())
    assert config["n_timesteps"] == 500
    assert "--seed 0" in (run / "FrozenLake-v1" / "command.txt").read_text()
    with np.load(run / "evaluations.npz") as evaluations:
        assert evaluations["results"].shape == (20, 2)
        assert evaluations["timesteps"][-1] == 500


def test_the_same_seed_gives_the_same_run_and_training_goes_on(type_command, tmp_path):
    runs = [tmp_path / "logs" / "qlearning" / f"FrozenLake-v1_{n}" for n in (1, 2, 3)]
    for more in ([], [], ["-i", runs[0] / "FrozenLake-v1.zip"]):
        assert type_command("train.py", *QUICK, *more)[0] == 0
    rows = [(run / "0.monitor.csv").read_text().splitlines()[2:] for run in runs]
    without_time = [[row.rsplit(",", 1)[0] for row in table] for table in rows]
    assert without_time[0] == without_time[1]
    data = [zipfile.ZipFile(run / "FrozenLake-v1.zip").read("policy.pth") for run in runs]
    assert data[0] == data[1] != data[2]
    assert json.loads((runs[2] / "run.json").read_text())["n_timesteps"] == 1000


def test_a_file_of_one_default_entry_is_enough(type_command, monkeypatch, tmp_path):
    """For listing, training, playing and comparing."""
    folder = tmp_path / "hyperparams"
    folder.mkdir()
    (folder / "qlearning.yml").write_text("default:\n  n_timesteps: 60\n  policy: QTablePolicy\n")
    monkeypatch.setattr(hyperparams, "_FOLDER", folder)
    code, out, err = type_command("train.py", "--list")
    assert (code, err) == (0, "")
    assert "qlearning" in out
    choice = ["--algo", "qlearning", "--env", "FrozenLake-v1"]
    assert type_command("train.py", *choice, "--seed", "0")[::2] == (0, "")
    code, out, err = type_command("enjoy.py", *choice, "--render", "none", "--n-episodes", "2")
    assert (code, err) == (0, "")
    agent = AgentSpec("qlearning", "qlearning")
    study = StudySpec("s", "S", (agent,), (EnvironmentSpec("FrozenLake-v1", "FrozenLake-v1"),))
    assert plan(study, tmp_path)[0].spec.hyperparams.n_timesteps == 60


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


def test_typed_arguments_of_the_environment_win_over_what_an_entry_trains_on():
    words = ["--algo", "ppo", "--env", "MineMaze-v0", "--env-kwargs", "mine_reward:-1"]
    spec = train_spec(build_parser().parse_args(words))
    variant = {"random_start": True, "goal_reward": 20, "power_reward": 3}
    both = [*words[:4], "-params", "env_kwargs:{'mine_reward': -1}", "--env-kwargs", "slip:0.1"]
    asked = {**variant, "mine_reward": -1, "slip": 0.1}
    assert training_kwargs(train_spec(build_parser().parse_args(both))) == asked
    compared = ["--env", "MineMaze-v0", "--algos", "ppo", *both[4:]]
    study = study_spec(compare.build_parser().parse_args(compared))
    assert training_kwargs(plan(study, Path("nowhere"))[0].spec) == asked
    assert training_kwargs(spec) == {**variant, "mine_reward": -1}
    assert "without mine_reward: -20" in spec.origins["train_env_kwargs"]
    assert training_kwargs(train_spec(build_parser().parse_args(words[:4])))["mine_reward"] == -20


# --- --watch-learning: the page that plays a training -------------------------------------------

WATCHED = ("train.py", *QUICK[:-1], "300", "--verbose", "1", "--watch-learning", "page.html")


def test_the_page_is_named_and_replaces_the_one_before(type_command, tmp_path):
    for words in ((), ("--watch-episodes", "2")):
        code, out, err = type_command(*WATCHED, *words)
        assert (code, err) == (0, "")
        assert out.splitlines()[-1] == "learning page.html"
    assert "2 whole episodes" in (tmp_path / "page.html").read_text(encoding="utf-8")


def test_a_run_that_fails_leaves_the_page_of_what_it_came_to(type_command, tmp_path):
    words = ("-params", "learning_rate:30", "gamma:1", "--eval-freq", "-1")
    words = ("--env", "Warehouse-v0", "-n", "3000", *words)
    code, out, err = type_command(*WATCHED, *words)
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
    code, out, _ = type_command(*WATCHED)
    assert (code, out.splitlines()[-1]) == (130, "learning page.html")
    text = (tmp_path / "page.html").read_text(encoding="utf-8")
    (number,) = re.findall(r"seed 0 · (\d+) steps", text)
    assert int(number) in {64, 65}


def test_a_page_that_finds_no_room_afterwards_ends_in_one_line(type_command, tmp_path, monkeypatch):
    monkeypatch.setattr("report.page.learning.write_text", fails)
    code, out, err = type_command(*WATCHED)
    assert (code, err.count("\n")) == (2, 1)
    assert "page.html" in err
    assert "final" in out
    assert [path.name for path in tmp_path.iterdir()] == ["logs"]


def fails(path, _):
    raise OSError(28, os.strerror(28), str(path))


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
def search(tmp_path, monkeypatch, capfd):
    """Do a search in this process, inside a folder of its own."""
    (tmp_path / "space.yml").write_text(SPACE)
    monkeypatch.chdir(tmp_path)

    def run(*words):
        monkeypatch.setattr(sys, "argv", ["tune.py", *SEARCH, *words])
        with pytest.raises(SystemExit) as stop:
            run_command(tune.main)
        captured = capfd.readouterr()
        return stop.value.code, captured.out, captured.err

    return run


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


def test_the_same_command_again_does_nothing_and_says_the_same(search):
    words = ["--trials", "3", "--pruner", "none"]
    code, out, err = search(*words)
    assert (code, err) == (0, "")
    record = (FOLDER / "tuning.json").read_text()
    assert search(*words)[0] == 0
    assert (FOLDER / "tuning.json").read_text() == record
    found = json.loads(record)["retest"]
    shipped, other = found["settings"]
    best = max(json.loads(record)["trials"], key=lambda trial: trial["value"] or -9.0)
    of_best = next(each for each in found["settings"] if each["number"] == best["number"])
    assert found["optimism"] == of_best["in_search"] - of_best["held_out"]
    is_better = other["held_out"] > shipped["held_out"]
    assert (found["winner"] is not None) == is_better == (FOLDER / "winner.yml").exists()
    assert ("winner: trial" in out) == is_better
    assert "1 of 3 trials" not in out
