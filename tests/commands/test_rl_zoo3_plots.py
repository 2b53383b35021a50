"""rl_zoo3's plot commands, and its enjoy, on run folders of train.py and of studies."""

import json
import os
import pickle
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
import yaml

import compare
import train
from tests.peers.peer_environment import peer_python

ROOT = Path(compare.__file__).parent
ENV_ID = "FrozenLake-v1"
LIBRARY = {
    "ppo": {"n_steps": 32, "batch_size": 32, "n_epochs": 1},
    "a2c": {},
    "dqn": {"learning_starts": 10, "buffer_size": 100},
    "qrdqn": {"learning_starts": 10, "buffer_size": 100},
    "trpo": {"n_steps": 32, "batch_size": 32},
    "ppo_lstm": {"policy": "MlpLstmPolicy", "n_steps": 32, "batch_size": 32, "n_epochs": 1},
}
OFF_POLICY = {"learning_starts": 90, "buffer_size": 200, "policy_kwargs": {"net_arch": [8]}}
NOISE = {"noise_type": "normal", "noise_std": 0.1}
CONTINUOUS = {
    "sac": {**OFF_POLICY, "use_sde": True},
    "td3": {**OFF_POLICY, **NOISE, "train_freq": [1, "episode"]},
    "ddpg": {**OFF_POLICY, **NOISE, "noise_type": "ornstein-uhlenbeck"},
    "tqc": OFF_POLICY,
    "crossq": {**OFF_POLICY, "normalize": True},
    # All candidates' episodes are of 30 steps, so that its two runs are equally long.
    "ars": {"n_delta": 2},
}
AGENTS = ["qlearning", *LIBRARY]

# rl_zoo3.enjoy needs `requests` for downloads, which are not made here.
RUN = """
import importlib.util, json, runpy, sys, types
if importlib.util.find_spec("requests") is None:
    stand_in = types.ModuleType("requests.exceptions")
    stand_in.HTTPError = type("HTTPError", (OSError,), {})
    sys.modules["requests"] = types.ModuleType("requests")
    sys.modules["requests.exceptions"] = stand_in
for command in json.loads(sys.argv[1]):
    sys.argv = command
    runpy.run_module(command[0], run_name="__main__")
    print("=====")
"""


def zoo(*commands, cwd):
    """What commands of rl_zoo3 print, in a process of the Python that has it."""
    result = subprocess.run(
        [peer_python(), "-c", RUN, json.dumps([list(map(str, words)) for words in commands])],
        cwd=cwd,
        capture_output=True,
        text=True,
        check=False,
        env={
            **os.environ,
            "PYTHONPATH": str(ROOT),
            "PYTHONWARNINGS": "ignore",
            "MPLBACKEND": "Agg",
        },
    )
    assert result.returncode == 0, result.stderr
    assert "not found" not in result.stdout
    outputs = result.stdout.split("=====\n")[:-1]
    assert len(outputs) == len(commands)
    return outputs


def call(main, *words):
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(sys, "argv", [str(word) for word in words])
        assert main() == 0


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    """Two seeds of all agents as a study, and two of them by train.py as well."""
    folder = tmp_path_factory.mktemp("zoo")
    shared = {"n_timesteps": 120, "n_envs": 1, "eval_env_kwargs": {"max_episode_steps": 20}}
    agents = {"qlearning": {}} | {
        name: {"tuned": False, "policy": "MlpPolicy", **own} for name, own in LIBRARY.items()
    }
    study = {
        "seeds": 2,
        "eval_freq": 40,
        "settings": shared,
        "agents": agents,
        "environments": [ENV_ID],
    }
    (folder / "zoo.yml").write_text(yaml.safe_dump(study))
    call(compare.main, "compare.py", folder / "zoo.yml", "--no-report", "-f", folder)
    conf = folder / "short.yml"
    conf.write_text(yaml.safe_dump({ENV_ID: {"policy": "MlpPolicy", **LIBRARY["ppo"], **shared}}))
    words = ["train.py", "--env", ENV_ID, "--verbose", 0, "-f", folder / "logs", "--eval-freq", 40]
    for seed in (0, 1):
        call(train.main, *words, "--seed", seed, "--algo", "qlearning", "-n", 120)
        call(train.main, *words, "--seed", seed, "--algo", "ppo", "--conf-file", conf)
    return folder


@pytest.fixture(params=["logs", "zoo/runs"])
def runs(folder, request):
    return folder / request.param


def agents_in(runs):
    return sorted(path.name for path in runs.iterdir())


def test_plot_train(runs, tmp_path):
    commands = [
        ["rl_zoo3.plots.plot_train", "-a", algo, "-e", ENV_ID, "-f", runs, "-x", axis, "-w", 2]
        for algo in agents_in(runs)
        for axis in ("steps", "episodes", "time")
    ]
    assert not any("No data" in out for out in zoo(*commands, cwd=tmp_path))


def test_all_plots_and_plot_from_file(runs, tmp_path):
    algos = agents_in(runs)
    words = ["-a", *algos, "-e", ENV_ID, "-f", runs, "-l", "ours", "--no-display"]
    out, _ = zoo(
        ["rl_zoo3.plots.all_plots", *words, "-print", "-o", "data"],
        ["rl_zoo3.plots.plot_from_file", "-i", "data.pkl", "-o", "picture"],
        cwd=tmp_path,
    )
    for algo in algos:
        assert f"{ENV_ID}-{algo.upper()}-ours: 2" in out
    with (tmp_path / "data.pkl").open("rb") as file:
        data = pickle.load(file)
    for algo in algos:
        curve = data[ENV_ID][f"{algo.upper()}-ours"]
        ours = [np.load(path) for path in sorted(runs.glob(f"{algo}/*/evaluations.npz"))]
        assert curve["timesteps"].tolist() == ours[0]["timesteps"].tolist()
        expected = np.mean([run["results"].mean(axis=1) for run in ours], axis=0)
        assert np.allclose(curve["mean"], expected)
    assert len(list(tmp_path.glob("picture*"))) == 1


def test_enjoy_plays_the_runs_of_a_study(folder, tmp_path):
    options = ["--no-render", "-n", 150, "--device", "cpu", "--gym-packages", "envs"]
    commands = [
        ["rl_zoo3.enjoy", "--algo", algo, "--env", ENV_ID, "-f", folder / "zoo" / "runs", *options]
        for algo in LIBRARY
    ]
    for algo, out in zip(LIBRARY, zoo(*commands, cwd=tmp_path), strict=True):
        assert f"{algo}/{ENV_ID}_2" in out
        assert "pisode" in out


def test_agents_of_continuous_actions(tmp_path):
    """The same for those that act in Box spaces: compared here, plotted and played there."""
    study = {
        "seeds": 2,
        "eval_freq": 40,
        "settings": {"n_timesteps": 120, "env_kwargs": {"max_episode_steps": 30}},
        "agents": {
            name: {"tuned": False, "policy": "MlpPolicy", **own} for name, own in CONTINUOUS.items()
        },
        "environments": ["Pendulum-v1"],
    }
    (tmp_path / "robots.yml").write_text(yaml.safe_dump(study))
    call(compare.main, "compare.py", tmp_path / "robots.yml", "--no-report", "-f", tmp_path)
    where = ["-f", tmp_path / "robots" / "runs"]
    words = ["--env", "Pendulum-v1", *where, "--no-render", "-n", 60, "--device", "cpu"]
    labelled = ["-l", "ours", "--no-display", "-print"]
    plots, *played = zoo(
        ["rl_zoo3.plots.all_plots", "-a", *CONTINUOUS, "-e", "Pendulum-v1", *where, *labelled],
        *(["rl_zoo3.enjoy", "--algo", algo, *words] for algo in CONTINUOUS),
        cwd=tmp_path,
    )
    for algo, out in zip(CONTINUOUS, played, strict=True):
        assert f"Pendulum-v1-{algo.upper()}-ours: 2" in plots
        assert f"{algo}/Pendulum-v1_2" in out
        assert out.count("Episode Length 30") == 2
