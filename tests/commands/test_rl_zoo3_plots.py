"""rl_zoo3's plot commands, and its enjoy, on the run folders of studies."""

import json
import os
import pickle
import subprocess
import sys
from pathlib import Path

import numpy as np
import yaml

import compare
from tests.peers.peer_environment import peer_python

ROOT = Path(compare.__file__).parent
ENV_ID = "FrozenLake-v1"
ALL_PLOTS = ["rl_zoo3.plots.all_plots", "-l", "ours", "--no-display", "-print"]
AGENTS = {
    "qlearning": {},
    "ppo": {"tuned": False, "policy": "MlpPolicy", "n_steps": 32, "batch_size": 32, "n_epochs": 1},
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


def test_plots_and_enjoy_of_rl_zoo3_take_the_runs_of_studies(tmp_path, monkeypatch):
    """All in one process, since it imports for seconds."""
    study = {
        "seeds": 2,
        "eval_freq": 40,
        "eval_episodes": 3,
        "environments": [ENV_ID],
        "settings": {"n_timesteps": 120, "n_envs": 1, "eval_env_kwargs": {"max_episode_steps": 20}},
        "agents": AGENTS,
    }
    (tmp_path / "zoo.yml").write_text(yaml.safe_dump(study))
    words = ["compare.py", str(tmp_path / "zoo.yml"), "--no-report", "-f", str(tmp_path)]
    monkeypatch.setattr(sys, "argv", words)
    assert compare.main() == 0
    runs = tmp_path / "zoo" / "runs"
    base = ["-e", ENV_ID, "-f", runs]
    play = ["--algo", "ppo", "--env", ENV_ID, "-f", runs, "--no-render", "-n", 150]
    learnt, plotted, _, played = zoo(
        ["rl_zoo3.plots.plot_train", *base, "-a", "ppo", "-x", "episodes", "-w", 2],
        [*ALL_PLOTS, *base, "-a", *AGENTS, "-o", "data"],
        ["rl_zoo3.plots.plot_from_file", "-i", "data.pkl", "-o", "picture"],
        ["rl_zoo3.enjoy", *play, "--device", "cpu", "--gym-packages", "envs"],
        cwd=tmp_path,
    )
    assert f"ppo/{ENV_ID}_2" in played
    assert "pisode" in played
    assert "No data" not in learnt
    assert len(list(tmp_path.glob("picture*"))) == 1
    with (tmp_path / "data.pkl").open("rb") as file:
        data = pickle.load(file)
    for algo in AGENTS:
        assert f"{ENV_ID}-{algo.upper()}-ours: 2" in plotted
        curve = data[ENV_ID][f"{algo.upper()}-ours"]
        ours = [np.load(path) for path in sorted(runs.glob(f"{algo}/*/evaluations.npz"))]
        assert curve["timesteps"].tolist() == ours[0]["timesteps"].tolist()
        expected = np.mean([run["results"].mean(axis=1) for run in ours], axis=0)
        assert np.allclose(curve["mean"], expected)
