"""Whole processes, from their start to their files on disk; processor seconds.

All processes that a command starts are counted, also those that it does not wait for.
"""

from __future__ import annotations

import contextlib
import ctypes
import json
import os
import subprocess
import sys
import tempfile
from functools import partial
from pathlib import Path
from typing import Any

from rl_yardstick.experiments.study import read_study
from tests.peers.peer_environment import peer_folder, peer_python
from timing import ROOT, Benchmark, Contender, Rows

PR_SET_CHILD_SUBREAPER = 36  # linux/prctl.h
SWEEPS = ("warehouse-learning-rate", "warehouse-discount", "warehouse-epsilon")
TESTBED: dict[str, dict[str, Any]] = {
    "greedy": {"algo": "epsilon_greedy", "exploration_initial_eps": 0.0},
    "epsilon 0.01": {"algo": "epsilon_greedy", "exploration_initial_eps": 0.01},
    "epsilon 0.1": {"algo": "epsilon_greedy", "exploration_initial_eps": 0.1},
    "UCB c=2": {"algo": "ucb", "variant": "sutton_barto", "c": 2.0},
    "gradient 0.1": {"algo": "gradient_bandit", "learning_rate": 0.1},
}
PPO = "--algo ppo --env CartPole-v1 -n 20000 --num-threads 1"
EQUAL = "--eval-freq 5000 --eval-episodes 5 --n-eval-envs 1"
IMPORT = "import stable_baselines3"


def python(*words: str, program: str = sys.executable) -> float:
    """The processor seconds of a process and of all processes that it has started.

    Raises:
        SystemExit: if the command fails.
    """
    before = os.times()
    with tempfile.TemporaryDirectory() as folder:
        filled = [word.replace("{folder}", folder) for word in words]
        done = subprocess.run(
            [program, *filled], cwd=ROOT, capture_output=True, text=True, check=False
        )
        with contextlib.suppress(ChildProcessError):
            while True:  # orphaned processes, which end by themselves
                os.wait()
    if done.returncode not in (0, 2):  # 2: a refusal
        raise SystemExit(f"{' '.join(words)}:\n{done.stderr}")
    after = os.times()
    user = after.children_user - before.children_user
    return user + after.children_system - before.children_system


def ours(command: str) -> Contender:
    """One of our commands; runs are written to a new folder."""
    script, *words = command.split()
    where = () if "--help" in words or "--list" in words else ("-f", "{folder}")
    return partial(python, script, *words, *where)


def study(folder: Path, name: str, content: dict[str, Any]) -> Contender:
    """A study from a file, with tables only."""
    path = folder / f"{name}.yml"
    path.write_text(json.dumps({"title": name, **content}), encoding="utf-8")
    return partial(python, "compare.py", str(path), "--no-report", "-f", "{folder}")


def sweeps() -> dict[str, Any]:
    """A coursework's three sweeps as one study: 9 settings, 30 seeds, 1,000 episodes."""
    agents = {
        f"{name} {agent.label}": {"algo": agent.algo, **agent.settings}
        for name in SWEEPS
        for agent in read_study(ROOT / "studies" / f"{name}.yml").agents
        if agent.settings.get("tie_breaking") == "first"
    }
    environments = {"Warehouse-v0": {"env_kwargs": {"shelf_reward": -1}}}
    return {
        "seeds": 30,
        "n_episodes": 1000,
        "tuned": False,
        "agents": agents,
        "environments": environments,
    }


def rows(folder: Path) -> Rows:
    """Commands compared with an import, rl_zoo3's training with ours, and studies alone."""
    # Orphans become this process's children, so that their time is counted.
    ctypes.CDLL(None).prctl(PR_SET_CHILD_SUBREAPER, 1, 0, 0, 0)
    commands = {
        command: ours(command)
        for command in (
            "train.py --help",
            "train.py --list",
            "train.py --env Warehose-v0",
            "train.py --algo qlearning --env FrozenLake-v1",
            "train.py --algo qlearning --env Warehouse-v0 --n-episodes 1000",
            "compare.py --algos qlearning sarsa --env FrozenLake-v1 --seeds 2 -n 1000",
        )
    }
    made: Rows = {"commands": {IMPORT: partial(python, "-c", IMPORT), **commands}}
    settings = f"--conf-file {peer_folder('rl_zoo3') / 'hyperparams' / 'ppo.yml'}"
    for name, more in (("defaults", ""), ("equal evaluation", EQUAL)):
        words = f"{PPO} {settings} {more} -f {{folder}}".split()
        made[f"PPO on CartPole-v1, 20,000 steps, one thread, {name}"] = {
            "rl_zoo3": partial(python, "-m", "rl_zoo3.train", *words, program=peer_python()),
            "train.py": partial(python, "train.py", *words),
        }
    lake = {"algo": "qlearning"}
    testbed = {
        "tuned": False,
        "agents": TESTBED,
        "environments": {"testbed": {"id": "GaussianBandit-v0"}},
        "metric": "regret",
    }
    made["studies"] = {
        "9 settings x 30 seeds x 1,000 episodes on the warehouse": study(
            folder, "sweeps", sweeps()
        ),
        "1,000 seeds of Q-learning on FrozenLake-v1, 200,000 steps": study(
            folder,
            "thousand",
            {
                "seeds": 1000,
                "n_timesteps": 200_000,
                "agents": {"q": lake},
                "environments": {"FrozenLake-v1": {}},
            },
        ),
        "the ten-armed testbed, 5 agents x 2,000 runs x 1,000 pulls": study(
            folder, "testbed", {"seeds": 2000, "n_timesteps": 1000, **testbed}
        ),
    }
    return made


BENCHMARK = Benchmark("seconds", rounds=3, rows=rows, is_speed=False, warms_up=True)
