"""rl_zoo3 finds, reads and plays our runs; its plots, and the library's, read our monitors.

In processes of their own, of the Python that has it: importing it changes Gymnasium's time limit.
"""

import csv
import json
import os
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
import yaml
from stable_baselines3.common.monitor import load_results
from stable_baselines3.common.results_plotter import ts2xy

import train
from pipeline.packs import pack
from pipeline.runs import Run
from tests.peers.peer_environment import peer_python

ROOT = Path(train.__file__).parent

# rl_zoo3.enjoy needs `requests` for downloading models, which is not done here, and does not
# itself ask for it to be installed.
ENJOY = """
import importlib.util, json, types
if importlib.util.find_spec("requests") is None:
    stand_in = types.ModuleType("requests.exceptions")
    stand_in.HTTPError = type("HTTPError", (OSError,), {})
    sys.modules["requests"] = types.ModuleType("requests")
    sys.modules["requests.exceptions"] = stand_in
from rl_zoo3.enjoy import enjoy
for words in json.loads(sys.argv[3]):
    print("=====")
    sys.argv = ["enjoy.py", *words]
    enjoy()
"""

READ = """
import sys
from rl_zoo3.utils import create_test_env, get_latest_run_id, get_model_path, get_saved_hyperparams
from stable_baselines3 import PPO
import envs

folder, env_id = sys.argv[1:3]
print(get_latest_run_id(f"{folder}/ppo", env_id))
for kwargs in ({}, {"load_best": True}, {"load_checkpoint": 128}, {"load_last_checkpoint": True}):
    _, model_path, log_path = get_model_path(0, folder, "ppo", env_id, **kwargs)
    print(model_path)
    hyperparams, stats_path = get_saved_hyperparams(f"{log_path}/{env_id}", test_mode=True)
    env = create_test_env(
        env_id,
        stats_path=stats_path,
        seed=0,
        should_render=False,
        hyperparams=hyperparams,
        env_kwargs=hyperparams.get("env_kwargs", {}),
    )
    model = PPO.load(model_path, env=env)
    obs = env.reset()
    print(type(env).__name__, obs.shape, env.normalize_obs is not None)
    for _ in range(5):
        obs, *_ = env.step(model.predict(obs, deterministic=True)[0])
"""

ENTRY = {
    "policy": "MlpPolicy",
    "policy_kwargs": {"net_arch": [8]},
    "n_envs": 2,
    "n_steps": 32,
    "batch_size": 32,
    "n_epochs": 1,
    "learning_rate": "lin_0.001",
    "n_timesteps": 256,
    "env_kwargs": {"observation": "position", "shelf_reward": -1},
    "train_env_kwargs": {"random_start": True},
    "train_env_wrapper": {"envs.wrappers.ScaleReward": {"scale": 0.01}},
    "normalize": True,
}


def python(program, *arguments, cwd=ROOT):
    result = subprocess.run(
        [peer_python(), "-c", program, *map(str, arguments)],
        cwd=cwd,
        capture_output=True,
        text=True,
        check=False,
        env={**os.environ, "PYTHONPATH": str(ROOT), "PYTHONWARNINGS": "ignore"},
    )
    assert result.returncode == 0, result.stderr
    return result.stdout


@pytest.fixture(scope="module")
def run(tmp_path_factory):
    """A tiny run of PPO, and a folder with a lower number beside it."""
    folder = tmp_path_factory.mktemp("runs")
    (folder / "logs" / "ppo" / "Warehouse-v0_1").mkdir(parents=True)
    (folder / "tiny.yml").write_text(yaml.safe_dump({"Warehouse-v0": ENTRY}))
    words = [
        *("train.py", "--algo", "ppo", "--env", "Warehouse-v0", "--seed", 0, "--verbose", 0),
        *("--conf-file", folder / "tiny.yml", "-f", folder / "logs", "--device", "cpu"),
        *("--eval-freq", 128, "--eval-episodes", 2, "--save-freq", 64),
        *("--env-kwargs", "max_episode_steps:15"),
    ]
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(sys, "argv", [str(word) for word in words])
        assert train.main() == 0
    return Run.find(folder / "logs", "ppo", "Warehouse-v0")


def _made(folder):
    folder.mkdir(parents=True)
    return folder


@pytest.fixture(scope="module")
def printed(run):
    """What is printed when it reads the run, plays it, its last checkpoint, and its pack."""
    folder = run.path.parent.parent
    words = ["--algo", "ppo", "--env", "Warehouse-v0", "-f", str(folder)]
    words += ["--no-render", "-n", "45", "--device", "cpu", "--gym-packages", "envs"]
    pack(run.path, _made(folder / "packs" / "ppo") / "Warehouse-v0_1")
    of_pack = [str(folder / "packs") if word == str(folder) else word for word in words]
    plays = json.dumps([words, [*words, "--load-last-checkpoint"], of_pack])
    parts = python(READ + ENJOY, folder, "Warehouse-v0", plays).split("=====\n")
    return [part.splitlines() for part in parts]


def test_rl_zoo3_reads_a_run_folder(run, printed):
    out, *_ = printed
    assert out[0] == "2"
    paths = [Path(line) for line in out if line.endswith(".zip")]
    assert paths == [
        run.model_path,
        run.best_model_path,
        run.checkpoint_path(128),
        run.checkpoint_path(256),
    ]
    assert out.count("VecNormalize (1, 2) True") == 4
    # The statistics of the normalisation are read as well.
    assert out.count("Loading running average") == 4


def test_rl_zoo3_plays_a_run(run, printed):
    """Its own command, with the environment as our hyperparameters make it."""
    _, *played, _ = printed
    for out, path in zip(played, (run.model_path, run.checkpoint_path(256)), strict=True):
        assert any(str(path) in line for line in out)
        lengths = [line for line in out if line.startswith("Episode Length")]
        assert lengths == ["Episode Length 15"] * 3


def test_rl_zoo3_plays_a_pack(printed):
    lengths = [line for line in printed[-1] if line.startswith("Episode Length")]
    assert lengths == ["Episode Length 15"] * 3
    assert any("packs" in line and "vecnormalize" not in line for line in printed[-1])


def test_the_librarys_plots_read_our_monitors(run):
    results = load_results(str(run.path))
    rows = [
        (float(episode_return), int(length))
        for path in run.path.glob("*.monitor.csv")
        for episode_return, length, _ in csv.reader(path.read_text().splitlines()[2:])
    ]
    assert len(rows) >= 16
    assert sorted(zip(results["r"], results["l"], strict=True)) == sorted(rows)
    # As the environment gives them: a move costs 1, and reaching the goal brings 100.
    assert all(returned in (-15, 101 - length) for returned, length in rows)
    steps, returns = ts2xy(results, "timesteps")
    assert steps[-1] == sum(length for _, length in rows)
    assert len(returns) == len(rows)


def test_evaluations_are_in_the_form_that_rl_zoo3_plots(run):
    evaluations = np.load(run.evaluations_path)
    assert evaluations["timesteps"].tolist() == [128, 256]
    assert evaluations["results"].shape == evaluations["ep_lengths"].shape == (2, 2)
    assert (evaluations["ep_lengths"] == 15).all()
