"""rl_zoo3's plot commands, and its enjoy, on run folders of train.py and of studies."""

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


def compared(folder, name, settings, agents, env_id):
    """Do a study of two seeds."""
    study = {
        "seeds": 2,
        "eval_freq": 40,
        "eval_episodes": 3,
        "settings": {"n_timesteps": 120, **settings},
        "agents": {
            name: {"tuned": False, "policy": "MlpPolicy", **own} if own is not None else {}
            for name, own in agents.items()
        },
        "environments": [env_id],
    }
    (folder / name).write_text(yaml.safe_dump(study))
    call(compare.main, "compare.py", folder / name, "--no-report", "-f", folder)


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    """Two seeds of all agents in two studies, and two of some of them by train.py as well."""
    folder = tmp_path_factory.mktemp("zoo")
    shared = {"n_envs": 1, "eval_env_kwargs": {"max_episode_steps": 20}}
    compared(folder, "zoo.yml", shared, {"qlearning": None, **LIBRARY}, ENV_ID)
    short = {"env_kwargs": {"max_episode_steps": 30}}
    compared(folder, "robots.yml", short, CONTINUOUS, "Pendulum-v1")
    conf = folder / "short.yml"
    entry = {"policy": "MlpPolicy", "n_timesteps": 120, **LIBRARY["ppo"], **shared}
    conf.write_text(yaml.safe_dump({ENV_ID: entry}))
    words = ["train.py", "--env", ENV_ID, "--verbose", 0, "-f", folder / "logs", "--eval-freq", 40]
    for seed in (0, 1):
        call(train.main, *words, "--seed", seed, "--algo", "qlearning", "-n", 120)
        call(train.main, *words, "--seed", seed, "--algo", "ppo", "--conf-file", conf)
    return folder


def agents_in(runs):
    return sorted(path.name for path in runs.iterdir())


def plot_commands(folder, name):
    """Plots of a folder of runs, by what they are."""
    runs, data = folder / name, folder / name.partition("/")[0]
    algos, base = agents_in(runs), ["-e", ENV_ID, "-f", runs]
    # Each axis takes a column of rows that are the same for all agents.
    axes = zip(algos, cycle(["steps", "episodes", "time"]), strict=False)
    commands = {
        ("plot_train", name, algo, axis): [*base, "-a", algo, "-x", axis, "-w", 2]
        for algo, axis in [*axes, (algos[0], "episodes"), (algos[0], "time")]
    }
    words = [*base, "-a", *algos, "-l", "ours", "--no-display", "-print", "-o", f"{data}_data"]
    commands["all_plots", name] = words
    picture = ["-i", f"{data}_data.pkl", "-o", f"{data}_picture"]
    commands["plot_from_file", name] = picture
    return {key: [f"rl_zoo3.plots.{key[0]}", *words] for key, words in commands.items()}


def enjoy(algo, env_id, runs, n_steps):
    words = ["--algo", algo, "--env", env_id, "-f", runs, "--no-render", "-n", n_steps]
    return ["rl_zoo3.enjoy", *words, "--device", "cpu", "--gym-packages", "envs"]


@pytest.fixture(scope="module")
def printed(folder):
    """What commands print, by what they are: all in one process, since it imports for seconds."""
    robots = folder / "robots" / "runs"
    swings = ["-a", *CONTINUOUS, "-e", "Pendulum-v1", "-f", robots, "-l", "ours"]
    commands = {
        **plot_commands(folder, "logs"),
        **plot_commands(folder, "zoo/runs"),
        ("all_plots", "robots"): ["rl_zoo3.plots.all_plots", *swings, "--no-display", "-print"],
        **{("enjoy", algo): enjoy(algo, ENV_ID, folder / "zoo/runs", 150) for algo in LIBRARY},
        **{("enjoy", algo): enjoy(algo, "Pendulum-v1", robots, 60) for algo in CONTINUOUS},
    }
    return dict(zip(commands, zoo(*commands.values(), cwd=folder), strict=True))


@pytest.mark.parametrize("name", ["logs", "zoo/runs"])
def test_plot_train(printed, name):
    said = {key: out for key, out in printed.items() if key[:2] == ("plot_train", name)}
    assert {axis for *_, axis in said} == {"steps", "episodes", "time"}
    assert not any("No data" in out for out in said.values())


@pytest.mark.parametrize("name", ["logs", "zoo/runs"])
def test_all_plots_and_plot_from_file(folder, printed, name):
    runs, begin = folder / name, name.partition("/")[0]
    algos = agents_in(runs)
    for algo in algos:
        assert f"{ENV_ID}-{algo.upper()}-ours: 2" in printed["all_plots", name]
    with (folder / f"{begin}_data.pkl").open("rb") as file:
        data = pickle.load(file)
    for algo in algos:
        curve = data[ENV_ID][f"{algo.upper()}-ours"]
        ours = [np.load(path) for path in sorted(runs.glob(f"{algo}/*/evaluations.npz"))]
        assert curve["timesteps"].tolist() == ours[0]["timesteps"].tolist()
        expected = np.mean([run["results"].mean(axis=1) for run in ours], axis=0)
        assert np.allclose(curve["mean"], expected)
    assert len(list(folder.glob(f"{begin}_picture*"))) == 1


def test_enjoy_plays_the_runs_of_a_study(printed):
    for algo in LIBRARY:
        assert f"{algo}/{ENV_ID}_2" in printed["enjoy", algo]
        assert "pisode" in printed["enjoy", algo]


def test_agents_of_continuous_actions(printed):
    """The same for those that act in Box spaces: compared here, plotted and played there."""
    for algo in CONTINUOUS:
        assert f"Pendulum-v1-{algo.upper()}-ours: 2" in printed["all_plots", "robots"]
        assert f"{algo}/Pendulum-v1_2" in printed["enjoy", algo]
        assert printed["enjoy", algo].count("Episode Length 30") == 2
