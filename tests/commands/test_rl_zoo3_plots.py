"""rl_zoo3's plot commands, and its enjoy, on the run folders of studies."""

import json
import os
import pickle
import subprocess
import sys
from itertools import cycle
from pathlib import Path

import numpy as np
import pytest
import yaml

import compare
from tests.peers.peer_environment import peer_python

ROOT = Path(compare.__file__).parent
ENV_ID = "FrozenLake-v1"
LIBRARY = {
    "ppo": {"n_steps": 32, "batch_size": 32, "n_epochs": 1},
    "qrdqn": {"learning_starts": 10, "buffer_size": 100},
    "ppo_lstm": {"policy": "MlpLstmPolicy", "n_steps": 32, "batch_size": 32, "n_epochs": 1},
}
OFF_POLICY = {"learning_starts": 90, "buffer_size": 200, "policy_kwargs": {"net_arch": [8]}}
CONTINUOUS = {
    "td3": {**OFF_POLICY, "noise_type": "normal", "noise_std": 0.1, "train_freq": [1, "episode"]},
    "crossq": {**OFF_POLICY, "normalize": True},
    # All candidates' episodes are of 30 steps, so that its two runs are equally long.
    "ars": {"n_delta": 2},
}
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


def compared(folder, name, settings, agents, env_id):
    """Do a study of two seeds; its run folders."""
    own = {name: {"tuned": False, "policy": "MlpPolicy", **agents[name]} for name in agents}
    study = {
        "seeds": 2,
        "eval_freq": 40,
        "eval_episodes": 3,
        "environments": [env_id],
        "settings": {"n_timesteps": 120, **settings},
        "agents": {**own, **({"qlearning": {}} if "qlearning" in agents else {})},
    }
    (folder / name).write_text(yaml.safe_dump(study))
    words = ["compare.py", str(folder / name), "--no-report", "-f", str(folder)]
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(sys, "argv", words)
        assert compare.main() == 0
    return (folder / name).with_suffix("") / "runs"


def test_plots_and_enjoy_of_rl_zoo3_take_the_runs_of_studies(tmp_path):
    """All in one process, since it imports for seconds."""
    shared = {"n_envs": 1, "eval_env_kwargs": {"max_episode_steps": 20}}
    agents = {"qlearning": {}, **LIBRARY}
    lake = compared(tmp_path, "zoo.yml", shared, agents, ENV_ID)
    # Those that act in Box spaces: compared here, plotted and played there.
    short = {"env_kwargs": {"max_episode_steps": 30}}
    swings = compared(tmp_path, "robots.yml", short, CONTINUOUS, "Pendulum-v1")
    axes = dict(zip(agents, cycle(["steps", "episodes", "time"]), strict=False))
    base = ["-e", ENV_ID, "-f", lake]
    all_plots = ["rl_zoo3.plots.all_plots", "-l", "ours", "--no-display", "-print"]
    commands = {
        **{
            ("train", algo): ["rl_zoo3.plots.plot_train", *base, "-a", algo, "-x", axis, "-w", 2]
            for algo, axis in axes.items()
        },
        "lake": [*all_plots, *base, "-a", *agents, "-o", "data"],
        "file": ["rl_zoo3.plots.plot_from_file", "-i", "data.pkl", "-o", "picture"],
        "swings": [*all_plots, "-e", "Pendulum-v1", "-f", swings, "-a", *CONTINUOUS],
    }
    for runs, env_id, algos, n in (
        (lake, ENV_ID, LIBRARY, 150),
        (swings, "Pendulum-v1", CONTINUOUS, 60),
    ):
        for algo in algos:
            words = ["--algo", algo, "--env", env_id, "-f", runs, "--no-render", "-n", n]
            words += ["--device", "cpu", "--gym-packages", "envs"]
            best = ["--load-best"] if algo == "crossq" else []  # with its own statistics
            commands["enjoy", algo] = ["rl_zoo3.enjoy", *words, *best]
    outputs = zoo(*commands.values(), cwd=tmp_path)
    printed = dict(zip(commands, outputs, strict=True))
    assert not any("No data" in printed["train", algo] for algo in axes)
    for algo in agents:
        assert f"{ENV_ID}-{algo.upper()}-ours: 2" in printed["lake"]
    for algo in CONTINUOUS:
        assert f"Pendulum-v1-{algo.upper()}-ours: 2" in printed["swings"]
        assert f"{algo}/Pendulum-v1_2" in printed["enjoy", algo]
        assert printed["enjoy", algo].count("Episode Length 30") == 2
    for algo in LIBRARY:
        assert f"{algo}/{ENV_ID}_2" in printed["enjoy", algo]
        assert "pisode" in printed["enjoy", algo]
    assert len(list(tmp_path.glob("picture*"))) == 1
    with (tmp_path / "data.pkl").open("rb") as file:
        data = pickle.load(file)
    for algo in agents:
        curve = data[ENV_ID][f"{algo.upper()}-ours"]
        ours = [np.load(path) for path in sorted(lake.glob(f"{algo}/*/evaluations.npz"))]
        assert curve["timesteps"].tolist() == ours[0]["timesteps"].tolist()
        expected = np.mean([run["results"].mean(axis=1) for run in ours], axis=0)
        assert np.allclose(curve["mean"], expected)
