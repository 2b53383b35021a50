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
NOTHING = "score 0   return 0   best random or constant policy"
HIDES = HiddenState(95.8, (93.8, 93.8), with_memory=False)
BEST = "best random or constant policy"
# The final evaluation, and how the output ends.
ENDS = [
    # Exact, optimal, nearly optimal.
    (
        exact(0.740206, 0.740206, 0.744190, 0.0495),
        "score 0.99   return 0.7402 of 0.7442 (gap 0.0040)   success 74 %",
        f"score 0   return 0.0495   {BEST}",
    ),
    (exact(79 - 1e-14, 1.0, 79.0, 0.0), "score 1   return 79 of 79   success 100 %", NOTHING),
    (
        exact(79 - 1e-9, 1 - 1e-4, 79.0, 0.0),
        *("score 0.99   return 79 of 79 (gap 1e-09)   success 99.9 %", NOTHING),
    ),
    # Sampled, also between brackets, with a proof or not.
    (
        sampled(78.5, 79.0, yardstick=Yardstick(79.0, 0.0)),
        *("score 0.99   return 78.75 of 79 (gap 0.25; sampled, 2 episodes)", NOTHING),
    ),
    (
        sampled(260.0, yardstick=POLE),
        "score 0.50 to 0.52   return 260 of 500 at most (sampled, 1 episode)",
        *(f"score 0   return 20   {BEST}", "optimum   480 to 500"),
    ),
    (
        sampled(500.0, yardstick=replace(POLE, at_least=500.0, is_proven=False)),
        "score 1   return 500 of 500 at most (not proven; sampled, 1 episode)",
        *(f"score 0   return 20   {BEST}", "optimum   500 (the upper end is not proven)"),
    ),
    # Far below the scale, without an optimum, without a scale.
    (
        exact(-1000.0, None, -11.66, -12.0),
        *("score -2905.89   return -1000 of -11.66 (gap 988.34)", f"score 0   return -12   {BEST}"),
    ),
    (sampled(*[487.25] * 100), "return 487.2 (sampled, 100 episodes)"),
    (
        exact(749.5, None, 750.0, 750.0),
        *("return 749.5 of 750 (gap 0.5)", f"no score   return 750   {BEST}"),
    ),
    (
        exact(-80.0, 1 / 15, 93.8, -40.0, 35.0, hidden=HIDES),
        "score -0.54 to -0.30   return -80 of 93.80 at most   success 6.7 %",
        f"score 0   return -40   {BEST}",
        "optimum   35 to 93.80 without memory, 93.80 with memory, 95.80 by the state",
    ),
]
PULLS = PullSummary(n_pulls=1000, n_matched=1000, reward=0.5, optimal=0.85, regret=127.984)


def test_how_a_run_ends():
    for final, *lines in ENDS:
        assert result_lines(final) == lines
    said = "regret 127.98 over 1,000 pulls   best arm in 85 % of the last 100"
    assert describe_pulls(PULLS) == said
    said = "regret not known   reward 0.5000 a pull over the 1,000 of 1,000 that are in the log"
    assert describe_pulls(replace(PULLS, regret=None)) == said


def test_what_to_type_next(monkeypatch):
    monkeypatch.setattr(sys, "argv", ["train.py"])
    run = Run(Path("else where/qlearning/FrozenLake-v1_1"))
    lake = SimpleNamespace(
        algo="qlearning", env_id="FrozenLake-v1", env_kwargs={"is_slippery": False}
    )
    typed = build_parser().parse_args(
        ["--env-kwargs", "is_slippery:False", "-n", "500", "-conf", "my.yml"]
    )
    told = (
        "compare  python compare.py --env FrozenLake-v1 --algos qlearning sarsa --env-kwargs \\\n"
    )
    told += "    is_slippery:False --n-timesteps 500 --conf-file qlearning:my.yml"
    assert next_commands(run, lake, True, typed) == [
        f"watch    python enjoy.py '{run.path}'",
        f"explain  python -m rl_yardstick explain '{run.path}'",
        told,
    ]
    resumed = build_parser().parse_args(["--gym-packages", "mine"])  # typed with the first command
    (watched,) = next_commands(run, lake, False, resumed)
    assert watched == f"watch    python enjoy.py '{run.path}' --gym-packages mine"


def test_the_head_tells_what_auto_stands_for(type_command, tmp_path):
    slipping = ["--algo", "qlearning", "--env", "Warehouse-v0", "--env-kwargs", "slip:0.2"]
    code, out, _ = type_command("train.py", *slipping, "-n", "500")
    assert code == 0
    assert "gamma=0.9995 (auto: 1 - 1/(2 x time limit of 1,000))" in " ".join(out.split())
    run = tmp_path / "logs" / "qlearning" / "Warehouse-v0_1"
    spec = json.loads((run / "run.json").read_text())["spec"]
    assert (spec["algorithm"]["gamma"], *spec["origins"]) == (0.9995, "gamma", "learning_rate")
    assert yaml.safe_load((run / "Warehouse-v0" / "config.yml").read_text())["gamma"] == 0.9995
    assert (run / "Warehouse-v0" / "command.txt").read_text().startswith("python train.py --algo")


@pytest.mark.usefixtures("pictures")
def test_a_run_with_its_page_and_a_run_from_its_model(type_command, tmp_path):
    words = ["train.py", *LAKE, "-n", "600", "--seed", "1"]
    code, out, err = type_command(*words, "--watch-learning", "page.html")
    assert (code, err) == (0, "")
    assert "learning step by step, steps 1 to 600 of 600" in out
    assert (tmp_path / "page.html").as_uri() in out.splitlines()[-1]
    assert "<html" in (tmp_path / "page.html").read_text(encoding="utf-8")
    run = tmp_path / "logs" / "qlearning" / "FrozenLake-v1_1"
    assert (run / "value_map.png").stat().st_size > 5000
    code, _, err = type_command(*words, "-i", run, "--verbose", "0")
    assert (code, err) == (0, "")
    again = json.loads((run.with_name("FrozenLake-v1_2") / "run.json").read_text())
    assert again["n_timesteps"] == 1200


def test_scripts_that_a_queue_starts_again(type_command, tmp_path):
    words = ["train.py", *LAKE, "-n", "300", "--seed", "1"]
    words.append("--resume-or-start")
    assert type_command(*words)[0] == 0
    code, out, _ = type_command(*words)
    assert (code, "is finished already" in out) == (0, True)
    assert len(list((tmp_path / "logs" / "qlearning").iterdir())) == 1
    record = tmp_path / "logs/qlearning/FrozenLake-v1_1/run.json"
    record.write_text(record.read_text().replace('"finished"', '"running"'))
    assert type_command(*words)[0] == 0
    assert json.loads(record.read_text())["state"] == "finished"
    code, _, err = type_command("train.py", "--resume", record.parent)
    assert (code, err.count("\n")) == (2, 1)
    assert "is finished already" in err


def test_a_signal_ends_a_command_and_tells_how_to_resume(type_command, tmp_path):
    """The other one is sent to a study, see ``test_compare_command.py``."""
    typed = ["--gym-packages", "math"]
    words = [sys.executable, TRAIN, "--env", "CartPole-v1", "--algo", "ppo", "-n", "1e7", *typed]
    process = subprocess.Popen(words, cwd=tmp_path, stdout=subprocess.PIPE, text=True)
    state = tmp_path / "logs/ppo/CartPole-v1_1/state.bin"
    begun = time.monotonic()
    while not state.exists() and time.monotonic() - begun < 200:
        time.sleep(0.1)
    code, _, err = type_command("train.py", "--resume", state.parent, *typed)
    assert (code, err.count("\n")) == (2, 1)
    assert f"is in use by another command, process {process.pid}" in err
    process.send_signal(signal.SIGTERM)
    out, _ = process.communicate(timeout=100)
    assert process.returncode == 128 + signal.SIGTERM
    hint = f"stopped; resume with: python {TRAIN} --resume logs/ppo/CartPole-v1_1 {' '.join(typed)}"
    assert hint in " ".join(out.replace("\\\n", "").split())
    record = json.loads((state.parent / "run.json").read_text())
    assert (record["state"], record["stopped_by"]) == ("interrupted", signal.SIGTERM)
    assert (state.parent / "CartPole-v1.zip").exists()


def test_a_run_is_tracked_in_weights_and_biases(type_command, tmp_path, monkeypatch):
    pytest.importorskip("wandb")
    monkeypatch.setenv("WANDB_MODE", "offline")
    words = ["-n", "3000", "--seed", "0", "--verbose", "0", "--track", "--wandb-group", "the lake"]
    code, out, err = type_command("train.py", *LAKE, *words, "-tags", "first", "second")
    assert (code, out) == (0, ""), err
    (record,) = tmp_path.glob("logs/qlearning/FrozenLake-v1_1/wandb/offline-run-*/*.wandb")
    told = record.read_bytes()
    for word in ("qlearning/FrozenLake-v1_1", "the lake", "second", "learning_rate", "eval/score"):
        assert word.encode() in told, word
    monkeypatch.setattr("importlib.util.find_spec", lambda name: None)
    assert type_command("train.py", *LAKE, "--track")[::2] == (
        2,
        "train.py: error: --track needs: pip install 'rl-yardstick[wandb]'\n",
    )


def test_agents_on_bins_print_their_return_in_the_cut_world(type_command):
    wrapper = "rl_yardstick.envs.wrappers.DiscretizeObservation"
    bins = ["-params", f"env_wrapper:{{{wrapper}: {{bins: 12}}}}", "gamma:1.0"]
    found = {}
    for algo in ("optimal", "qlearning"):
        words = ["--algo", algo, "--env", "MountainCar-v0", "-n", "400", *bins]
        code, out, _ = type_command("train.py", *words)
        form = r"bins +return (\S+) in the cut world of 144 bins, whose optimum is (\S+); neither"
        line = re.search(form, " ".join(out.split()))
        assert code == 0
        assert "optimum   -98.14 to -95.74" in out  # of the environment
        found[algo] = [float(number) for number in line.groups()]
    (planned, optimum), (learnt, same) = found["optimal"], found["qlearning"]
    assert planned == optimum == same
    assert -200 <= learnt < optimum
