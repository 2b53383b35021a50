"""train.py as a user types it: output, files, signals, and the commands to type next."""

import json
import re
import signal
import subprocess
import sys
import time
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
import yaml

from rl_yardstick.commands.terminal import result_lines
from rl_yardstick.commands.train import build_parser, describe_pulls, next_commands
from rl_yardstick.pipeline.callbacks import PullSummary
from rl_yardstick.pipeline.evaluation.yardstick import Evaluation, HiddenState, Yardstick
from rl_yardstick.pipeline.run import Run

LAKE = ["--algo", "qlearning", "--env", "FrozenLake-v1"]
TRAIN = str(Path(__file__).parents[2] / "train.py")


def sampled(*returns, **fields):
    return Evaluation(np.array(returns), np.ones(len(returns)), None, **fields)


def exact(value, success, *yardstick, **more):
    successes = None if success is None else np.array([success])
    scale = Yardstick(*yardstick, **more)
    return Evaluation(np.array([value]), np.ones(1), successes, 0.0, scale)


POLE = Yardstick(optimum=500.0, baseline=20.0, at_least=480.0)
HIDES = HiddenState(95.8, (93.8, 93.8), with_memory=False)
UNPROVEN = replace(POLE, at_least=500.0, is_proven=False)
ENDS = {  # final evaluations; how the output then ends is in the file
    "exact": exact(0.740206, 0.740206, 0.744190, 0.0495),
    "optimal": exact(79 - 1e-14, 1.0, 79.0, 0.0),
    "nearly optimal": exact(79 - 1e-9, 1 - 1e-4, 79.0, 0.0),
    "sampled": sampled(78.5, 79.0, yardstick=Yardstick(79.0, 0.0)),
    "between brackets": sampled(260.0, yardstick=POLE),
    "at an end without a proof": sampled(500.0, yardstick=UNPROVEN),
    "far below the scale": exact(-1000.0, None, -11.66, -12.0),
    "without an optimum": sampled(*[487.25] * 100),
    "without a scale": exact(749.5, None, 750.0, 750.0),
    "hidden": exact(-80.0, 1 / 15, 93.8, -40.0, 35.0, hidden=HIDES),
}
SAID = yaml.safe_load(Path(__file__).with_name("ends_of_runs.yml").read_text(encoding="utf-8"))
PULLS = PullSummary(n_pulls=1000, n_matched=1000, reward=0.5, optimal=0.85, regret=127.984)


def test_how_a_run_ends():
    assert {name: result_lines(final) for name, final in ENDS.items()} == SAID
    said = "regret 127.98 over 1,000 pulls   best arm in 85 % of the last 100"
    assert describe_pulls(PULLS) == said
    said = "regret not known   reward 0.5000 a pull over the 1,000 of 1,000 that are in the log"
    assert describe_pulls(replace(PULLS, regret=None)) == said


def test_what_to_type_next(monkeypatch):
    monkeypatch.setattr(sys, "argv", ["train.py"])
    run = Run(Path("else where/qlearning/FrozenLake-v1_1"))
    ice = {"is_slippery": False}
    lake = SimpleNamespace(algo="qlearning", env_id="FrozenLake-v1", env_kwargs=ice)
    words = "--env-kwargs is_slippery:False -n 500 -conf my.yml"
    typed = build_parser().parse_args(words.split())
    told = "compare  python compare.py --env FrozenLake-v1 --algos qlearning sarsa "
    told += "--env-kwargs \\\n    is_slippery:False --n-timesteps 500 --conf-file qlearning:my.yml"
    assert next_commands(run, lake, True, typed) == [
        f"watch    python enjoy.py '{run.path}'",
        f"explain  python -m rl_yardstick explain '{run.path}'",
        told,
    ]
    resumed = build_parser().parse_args(["--gym-packages", "mine"])  # typed with the first command
    (watched,) = next_commands(run, lake, False, resumed)
    assert watched == f"watch    python enjoy.py '{run.path}' --gym-packages mine"


def test_the_head_tells_what_auto_stands_for(typed, tmp_path):
    slipping = ["--algo", "qlearning", "--env", "Warehouse-v0", "--env-kwargs", "slip:0.2"]
    out = typed.done("train.py", *slipping, "-n", "500")
    assert "gamma=0.9995 (auto: 1 - 1/(2 x time limit of 1,000))" in " ".join(out.split())
    run = tmp_path / "logs" / "qlearning" / "Warehouse-v0_1"
    spec = json.loads((run / "run.json").read_text())["spec"]
    assert (spec["algorithm"]["gamma"], *spec["origins"]) == (0.9995, "gamma", "learning_rate")
    assert yaml.safe_load((run / "Warehouse-v0" / "config.yml").read_text())["gamma"] == 0.9995
    assert (run / "Warehouse-v0" / "command.txt").read_text().startswith("python train.py --algo")


@pytest.mark.usefixtures("pictures")
def test_a_run_with_its_page_and_a_run_from_its_model(typed, tmp_path):
    words = ["train.py", *LAKE, "-n", "600", "--seed", "1"]
    out = typed.done(*words, "--watch-learning", "page.html")
    assert "learning step by step, steps 1 to 600 of 600" in out
    assert (tmp_path / "page.html").as_uri() in out.splitlines()[-1]
    assert "<html" in (tmp_path / "page.html").read_text(encoding="utf-8")
    run = tmp_path / "logs" / "qlearning" / "FrozenLake-v1_1"
    assert (run / "value_map.png").stat().st_size > 5000
    typed.done(*words, "-i", run, "--verbose", "0")
    again = json.loads((run.with_name("FrozenLake-v1_2") / "run.json").read_text())
    assert again["n_timesteps"] == 1200


def test_scripts_that_a_queue_starts_again(typed, tmp_path):
    words = ["train.py", *LAKE, "-n", "300", "--seed", "1", "--resume-or-start"]
    first = typed.done(*words)
    assert "is finished already" in typed.done(*words)
    assert len(list((tmp_path / "logs" / "qlearning").iterdir())) == 1
    record = tmp_path / "logs/qlearning/FrozenLake-v1_1/run.json"
    record.write_text(record.read_text().replace('"finished"', '"running"'))
    typed.done(*words)
    assert json.loads(record.read_text())["state"] == "finished"
    assert "is finished already" in typed.refused("train.py", "--resume", record.parent)
    record.write_text(record.read_text().replace('"finished"', '"running"'))
    resumed = typed.done("train.py", "--resume", record.parent)
    assert resumed.splitlines()[-1] == first.splitlines()[-1]
    assert resumed.endswith("--n-timesteps 300\n")


def test_a_signal_ends_a_command_and_tells_how_to_resume(typed, tmp_path):
    """The other one is sent to a study, see ``test_compare_command.py``."""
    more = ["--gym-packages", "math"]
    words = [sys.executable, TRAIN, "--env", "CartPole-v1", "--algo", "ppo", "-n", "1e7", *more]
    process = subprocess.Popen(words, cwd=tmp_path, stdout=subprocess.PIPE, text=True)
    state = tmp_path / "logs/ppo/CartPole-v1_1/state.bin"
    begun = time.monotonic()
    while not state.exists() and time.monotonic() - begun < 200:
        time.sleep(0.1)
    err = typed.refused("train.py", "--resume", state.parent, *more)
    assert f"is in use by another command, process {process.pid}" in err
    process.send_signal(signal.SIGTERM)
    out, _ = process.communicate(timeout=100)
    assert process.returncode == 128 + signal.SIGTERM
    hint = f"stopped; resume with: python {TRAIN} --resume logs/ppo/CartPole-v1_1 {' '.join(more)}"
    assert hint in " ".join(out.replace("\\\n", "").split())
    record = json.loads((state.parent / "run.json").read_text())
    assert (record["state"], record["stopped_by"]) == ("interrupted", signal.SIGTERM)
    assert (state.parent / "CartPole-v1.zip").exists()


def test_a_run_is_tracked_in_weights_and_biases(typed, tmp_path, monkeypatch):
    pytest.importorskip("wandb")
    monkeypatch.setenv("WANDB_MODE", "offline")
    words = ["-n", "3000", "--seed", "0", "--verbose", "0", "--track", "--wandb-group", "the lake"]
    assert typed.done("train.py", *LAKE, *words, "-tags", "first", "second") == ""
    (record,) = tmp_path.glob("logs/qlearning/FrozenLake-v1_1/wandb/offline-run-*/*.wandb")
    told = record.read_bytes()
    for word in ("qlearning/FrozenLake-v1_1", "the lake", "second", "learning_rate", "eval/score"):
        assert word.encode() in told, word
    monkeypatch.setattr("importlib.util.find_spec", lambda name: None)
    said = "train.py: error: --track needs: pip install 'rl-yardstick[wandb]'\n"
    assert typed.refused("train.py", *LAKE, "--track") == said


def test_agents_on_bins_print_their_return_in_the_cut_world(typed):
    wrapper = "rl_yardstick.envs.wrappers.DiscretizeObservation"
    bins = ["-params", f"env_wrapper:{{{wrapper}: {{bins: 12}}}}", "gamma:1.0"]
    found = {}
    for algo in ("optimal", "qlearning"):
        words = ["--algo", algo, "--env", "MountainCar-v0", "-n", "400", *bins]
        out = typed.done("train.py", *words)
        form = r"bins +return (\S+) in the cut world of 144 bins, whose optimum is (\S+); neither"
        line = re.search(form, " ".join(out.split()))
        assert "optimum   -98.14 to -95.74" in out  # of the environment
        found[algo] = [float(number) for number in line.groups()]
    (planned, optimum), (learnt, same) = found["optimal"], found["qlearning"]
    assert planned == optimum == same
    assert -200 <= learnt < optimum
