"""Comparable contents of files, and the commands that `fault_campaign` disturbs."""

from __future__ import annotations

import contextlib
import csv
import gzip
import io
import json
import os
import re
import shutil
import subprocess
import sys
import time
import zipfile
from collections import Counter
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
import torch as th

ROOT = Path(__file__).resolve().parents[1]
SMALL = "n_steps:64 batch_size:32 n_envs:2 n_epochs:2"
EAGER = "learning_starts:50 buffer_size:2000 batch_size:16 n_envs:1"
TRAININGS = (
    ("Warehouse-v0", "qlearning", 6_000_000, "engine:compiled"),
    ("FrozenLake-v1", "sarsa", 40_000, "engine:interpreted"),
    ("FrozenLake-v1", "expected_sarsa", 8_000_000, "engine:compiled n_envs:3"),
    ("CartPole-v1", "double_qlearning", 40_000, "engine:interpreted"),
    ("Warehouse-v0", "value_iteration", 40_000, ""),
    ("Warehouse-v0", "optimal", 40_000, ""),
    ("CartPole-v1", "random", 40_000, ""),
    ("CartPole-v1", "angle", 40_000, ""),
    ("CartPole-v1", "dqn", 2500, EAGER),
    ("Warehouse-v0", "double_dqn", 2000, EAGER),
    ("Warehouse-v0", "deep_qlearning", 2000, ""),
    ("CartPole-v1", "ppo", 5000, SMALL),
    ("Pendulum-v1", "ppo", 4000, f"{SMALL} use_sde:True normalize:True frame_stack:2"),
    ("CartPole-v1", "a2c", 5000, ""),
    ("Pendulum-v1", "sac", 600, EAGER),
    ("Pendulum-v1", "td3", 600, f"{EAGER} noise_type:normal noise_std:0.1"),
    ("Pendulum-v1", "ddpg", 600, EAGER),
    ("CartPole-v1", "qrdqn", 2500, EAGER),
    ("Pendulum-v1", "tqc", 400, EAGER),
    ("Pendulum-v1", "crossq", 400, EAGER),
    ("CartPole-v1", "trpo", 4000, "n_steps:128 batch_size:32 n_envs:1"),
    ("Pendulum-v1", "ars", 20_000, "n_delta:4 n_top:2"),
    ("CartPole-v1", "ppo_lstm", 2000, SMALL),
    ("Warehouse-v0", "ppo_mask", 3000, SMALL),
    ("FrozenLake-v1", "ppo", 300_000, f"{SMALL} engine:compiled"),
    ("FrozenLake-v1", "dqn", 200_000, f"{EAGER} n_steps:3 engine:compiled"),
    ("BernoulliBandit-v0", "thompson", 20_000, ""),
    ("LinearBandit-v0", "linucb", 10_000, ""),
    ("BernoulliBandit-v0", "mabwiser_ucb1", 3000, ""),
)
# With -i, from an agent that was trained with the same settings for a tenth of the steps.
CONTINUATIONS = (
    ("Warehouse-v0", "qlearning", 6_000_000, "engine:compiled"),
    ("FrozenLake-v1", "sarsa", 40_000, "engine:interpreted n_envs:3"),
    ("FrozenLake-v1", "double_qlearning", 6_000_000, "engine:compiled"),
    ("BernoulliBandit-v0", "thompson", 20_000, ""),
    ("BernoulliBandit-v0", "ucb", 20_000, ""),
    ("LinearBandit-v0", "linucb", 10_000, ""),
)
STUDY = "--env CartPole-v1 FrozenLake-v1 --algos dqn qlearning --seeds 3 -j 2 --no-report"
FILMS = "--env FrozenLake-v1 --algos qlearning sarsa --seeds 1 -j 2 --name films --no-report"
LAKE = "--env FrozenLake-v1 --algo qlearning"
LOG = """
import sys, gymnasium, envs.bandits
for seed in range(2):
    with gymnasium.make("SegmentBandit-v0") as env:
        envs.bandits.log_uniformly(env, 3000, seed=seed, path=f"{sys.argv[1]}-{seed}.csv")
"""


@dataclass
class Case:
    """One command, undisturbed and disturbed.

    In its words ``{logs}`` stands for the folder that it writes to, ``{before}`` for that of the
    commands before it.
    """

    name: str
    folder: Path  # of all its files
    words: list[str]
    before: tuple[list[str], ...] = ()  # commands to run once before, undisturbed
    begins_with_them: bool = False  # whether its folder begins with their files
    is_told: bool = False  # whether its result is its output
    whole: dict[str, Any] = field(default_factory=dict)  # the files of the undisturbed command
    seconds: float = 0.0  # the time of the undisturbed command
    counts: Counter[str] = field(default_factory=Counter)  # signals, outcomes of disturbed commands
    said: str = ""

    def run_in_peace(self) -> None:
        """Run the commands before it, and it undisturbed, twice: the second time is compiled."""
        for words in self.before:
            self._must(self.start(self.folder / "before", words))
        for name in ("warm", "whole"):
            logs = self.folder_of(name)
            begun = time.monotonic()
            self._must(self.start(logs))
            self.seconds = time.monotonic() - begun
        self.whole = self.result(self.folder / "whole")

    def _must(self, process: subprocess.Popen[str]) -> None:
        code, said = process.wait(), self.read_said()
        if code:
            raise SystemExit(f"{self.name}: {said}")

    def folder_of(self, name: str) -> Path:
        """A folder for the command to write to, with its initial files."""
        if self.begins_with_them:
            shutil.copytree(self.folder / "before", self.folder / name)
        return self.folder / name

    def start(self, logs: Path, words: list[str] | None = None) -> subprocess.Popen[str]:
        """Start the command in its own session, so that orphaned processes can be found."""
        places = {"{logs}": str(logs), "{before}": str(self.folder / "before")}
        filled = [
            re.sub(r"{logs}|{before}", lambda m: places[m[0]], w) for w in words or self.words
        ]
        if filled[0].endswith(".py"):
            filled = [str(ROOT / filled[0]), *filled[1:], "-f", str(logs)]
        environment = {**os.environ, "OMP_NUM_THREADS": "1", "PYTHONPATH": str(ROOT)}
        environment["PYTHONFAULTHANDLER"] = "1"  # prints where a process hangs
        with (self.folder / "output").open("a") as output:
            return subprocess.Popen(
                [sys.executable, *filled],
                cwd=self.folder,
                env=environment,
                stdout=output,
                stderr=output,
                text=True,
                start_new_session=True,
            )

    def read_said(self) -> str:
        """The output since the last call."""
        output = self.folder / "output"
        self.said = output.read_text(encoding="utf-8", errors="replace")
        output.write_text("")
        return self.said

    def result(self, logs: Path) -> dict[str, Any]:
        """The result, by the names of files."""
        found = contents(logs) if logs.exists() else {}
        # The output before the table is progress.
        table = self.said[self.said.find("┏") :]
        return {**found, "what it said": table} if self.is_told else found


def send(pid: int, number: int) -> None:
    """Send a signal to a process, if it is still there."""
    with contextlib.suppress(ProcessLookupError):
        os.kill(pid, number)


def cases(folder: Path) -> list[Case]:
    """All commands that are stopped at random moments."""
    found = [
        Case(f"{one[1]} on {one[0]}", folder / f"train-{number}", _training(*one))
        for number, one in enumerate(TRAININGS)
    ]
    for number, (env_id, algo, steps, settings) in enumerate(CONTINUATIONS):
        words = [*_training(env_id, algo, steps, settings), "-i", f"{{before}}/{algo}/{env_id}_1"]
        before = (_training(env_id, algo, steps // 10, settings),)
        found.append(Case(f"{algo} -i on {env_id}", folder / f"go-on-{number}", words, before))
    found += _others(folder)
    for case in found:
        case.folder.mkdir(parents=True)
    return found


def _training(env_id: str, algo: str, steps: int, settings: str) -> list[str]:
    words = f"train.py --env {env_id} --algo {algo} -n {steps} --seed 1 --resume-or-start".split()
    return [*words, "--verbose", "0", *(["-params", *settings.split()] if settings else [])]


def _others(folder: Path) -> list[Case]:
    study = f"compare.py {STUDY} --name study -n 1500".split()
    films = f"compare.py {FILMS} --n-episodes 200 --render-every 20".split()
    agent = f"train.py {LAKE} -n 20000 --seed 1 --verbose 0".split()
    film = f"enjoy.py {LAKE} --record {{logs}}/film.gif --reward-log {{logs}}/returns".split()
    judged = ("linucb", "thompson")
    learning = "--env-kwargs log:{before}-0.csv -n 3000 --eval-freq -1 --seed 1 --verbose 0"
    policies = [f"train.py --env ReplayBandit-v0 --algo {a} {learning}".split() for a in judged]
    names = [f"{{before}}/{algo}/ReplayBandit-v0_1" for algo in judged]
    logged = ["compare.py", "--logged", "{before}-1.csv", "--policy", *names]
    return [
        Case("a study of 12 runs", folder / "study", study),
        Case("a study with films", folder / "films", films),
        Case("enjoy --record", folder / "record", film, (agent,), begins_with_them=True),
        Case(
            "compare --logged",
            folder / "logged",
            logged,
            (["-c", LOG, "{before}"], *policies),
            is_told=True,
        ),
    ]


# --- what is compared: contents of files without times and durations ------------------------------

TIMES = ("seconds", "cpu_seconds", "pid")
# Also digests of files with times, the settings with the folder's name, and the process.
NOT_COMPARED = (*TIMES, "began", "date", "ended", "files", "spec", "process", "command", "packed")


def contents(logs: Path) -> dict[str, Any]:
    """The contents of a run's or a study's files without times and durations, by relative name.

    The numbers of the folders with replaced runs of a study are left out of the names.
    """
    files = sorted(path for path in logs.rglob("*") if path.is_file())
    names = [re.sub(r"/replaced/\d+/", "/replaced/", p.relative_to(logs).as_posix()) for p in files]
    return dict(zip(names, map(_content, files), strict=True))


def _content(path: Path) -> Any:
    if path.suffix == ".zip":
        with zipfile.ZipFile(path) as members:
            tensors = [n for n in members.namelist() if n.endswith(".pth")]
            return [_bits(th.load(io.BytesIO(members.read(name)))) for name in tensors]
    if path.suffix == ".npz":
        return {name: array.tobytes() for name, array in np.load(path).items()}
    if path.name.endswith("monitor.csv"):
        lines = path.read_text(encoding="utf-8").splitlines()
        return [line.split(",")[:2] for line in lines[1:]]
    if path.suffix == ".json":
        return _without_times(json.loads(path.read_text(encoding="utf-8")))
    if path.suffix in (".csv", ".gz"):
        opened = gzip.open if path.suffix == ".gz" else open
        with opened(path, "rt", encoding="utf-8", newline="") as file:
            rows = list(csv.DictReader(file))
        return [{k: v for k, v in row.items() if k not in (*TIMES, "path")} for row in rows]
    if path.suffix == ".gif":
        return path.read_bytes()
    # Other files contain commands, durations and folders.
    return path.suffix


def _without_times(value: Any) -> Any:
    if isinstance(value, dict):
        return {k: _without_times(v) for k, v in value.items() if k not in NOT_COMPARED}
    return [_without_times(held) for held in value] if isinstance(value, list) else value


def _bits(value: Any) -> Any:
    if isinstance(value, th.Tensor):
        return value.detach().numpy().tobytes()
    if isinstance(value, dict):
        return [(name, _bits(held)) for name, held in value.items()]
    return [_bits(held) for held in value] if isinstance(value, list | tuple) else value
