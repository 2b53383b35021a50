"""rl_zoo3's plots and its enjoy on our run folders, whose layout studies have too."""

import json
import os
import pickle
import subprocess
from pathlib import Path

import numpy as np

from tests.peers.peer_environment import peer_python

ROOT = Path(__file__).parents[2]
ENV_ID = "FrozenLake-v1"
SHORT = ["-n", "120", "--eval-freq", "40", "--eval-episodes", "3"]
SHORT += ["--eval-env-kwargs", "max_episode_steps:20"]
AGENTS = {
    "qlearning": [],
    "ppo": ["-params", "n_envs:1", "n_steps:32", "batch_size:32", "n_epochs:1"],
}
RUN = """
import json, runpy, sys
for command in json.loads(sys.argv[1]):
    sys.argv = command
    runpy.run_module(command[0], run_name="__main__")
    print("=====")
"""


def zoo(*commands, cwd):
    """What commands of rl_zoo3 print, in a process of the Python that has it."""
    typed = json.dumps([list(map(str, words)) for words in commands])
    env = {**os.environ, "PYTHONPATH": str(ROOT), "PYTHONWARNINGS": "ignore", "MPLBACKEND": "Agg"}
    program = [peer_python(), "-c", RUN, typed]
    result = subprocess.run(program, cwd=cwd, env=env, capture_output=True, text=True, check=False)
    assert result.returncode == 0, result.stderr
    assert "not found" not in result.stdout
    outputs = result.stdout.split("=====\n")[:-1]
    assert len(outputs) == len(commands)
    return outputs


def test_plots_and_enjoy_of_rl_zoo3_take_our_runs(tmp_path, typed):
    """All in one process, since it imports for seconds."""
    for algo, words in AGENTS.items():
        assert typed("train.py", "--algo", algo, "--env", ENV_ID, *SHORT, *words)[0] == 0
    base = ["-f", "logs", "-e", ENV_ID]
    plot = [*base, "-a", *AGENTS, "-l", "ours", "-o", "data", "--no-display", "-print"]
    play = ["--algo", "ppo", "--env", ENV_ID, "-f", "logs", "--no-render", "-n", 150]
    plotted, played = zoo(
        ["rl_zoo3.plots.all_plots", *plot],
        ["rl_zoo3.enjoy", *play, "--device", "cpu", "--gym-packages", "rl_yardstick.envs"],
        cwd=tmp_path,
    )
    assert f"ppo/{ENV_ID}_1" in played
    assert "pisode" in played
    with (tmp_path / "data.pkl").open("rb") as file:
        data = pickle.load(file)
    for algo in AGENTS:
        assert f"{ENV_ID}-{algo.upper()}-ours: 1" in plotted
        curve = data[ENV_ID][f"{algo.upper()}-ours"]
        ours = np.load(tmp_path / "logs" / algo / f"{ENV_ID}_1" / "evaluations.npz")
        assert curve["timesteps"].tolist() == ours["timesteps"].tolist()
        assert np.allclose(curve["mean"], ours["results"].mean(axis=1))
