"""What commands leave behind: the figures of runs, studies and a search, without their words.

Files are read by their formats alone (``run.json``, ``evaluations.npz``, ``monitor.csv``, model
zips, a study's tables), so the same program looks at commits whose code is laid out differently.
"""

from __future__ import annotations

import csv
import gzip
import io
import json
import os
import runpy
import shlex
import subprocess
import sys
import zipfile
from collections.abc import Iterator
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from trained import Thing, digest

# One training each, by a word that names it.
RUNS = {
    "table": "--algo qlearning --env FrozenLake-v1 -n 20000 --eval-freq 5000",
    "table interpreted": "--algo sarsa --env FrozenLake-v1 -n 3000 --eval-freq 700 "
    "-params engine:interpreted",
    "library": "--algo ppo --env FrozenLake-v1 -n 512 -params engine:library n_envs:1 n_steps:128 "
    "batch_size:64",
    "copies": "--algo sarsa --env FrozenLake-v1 -n 9000 --eval-freq 2000 -params n_envs:4",
    "episodes": "--algo qlearning --env Warehouse-v0 --n-episodes 200 --eval-freq 2000",
    "map": "--algo double_qlearning --env FrozenLake-v1 -n 9000 --env-kwargs map_name:8x8",
    "warehouse": "--algo sarsa --env Warehouse-v0 -n 20000 --env-kwargs slip:0.1 "
    "--eval-freq 5000 -params gamma:0.99",
    "evaluated elsewhere": "--algo qlearning --env Warehouse-v0 -n 9000 --eval-env-kwargs slip:0.2",
    "checkpoints": "--algo expected_sarsa --env CliffWalking-v1 -n 9000 --save-freq 3000",
    "mine": "--algo q_lambda --env MineMaze-v0 -n 20000 --eval-freq 5000",
    "taxi": "--algo qlearning --env Taxi-v4 -n 20000 -params mask_actions:True",
    "dyna": "--algo dyna_q --env FrozenLake-v1 -n 9000 --eval-freq 3000",
    "sweeping": "--algo prioritized_sweeping --env FrozenLake-v1 -n 3000",
    "monte carlo": "--algo monte_carlo --env Blackjack-v1 -n 20000 --eval-freq 5000",
    "n steps": "--algo n_step_sarsa --env RandomWalk-v0 -n 5000 -params n_steps:8",
    "planning": "--algo value_iteration --env Warehouse-v0 -n 500",
    "random": "--algo random --env FrozenLake-v1 -n 2000",
    "schedule": "--algo qlearning --env FrozenLake-v1 -n 9000 "
    "-params learning_rate:lin_0.5_0.01 exploration_decay:exponential",
    "bins": "--algo qlearning --env CartPole-v1 -n 20000 --eval-freq 5000",
    "tiles": "--algo semi_gradient_sarsa --env MountainCar-v0 -n 9000 --eval-freq 3000",
    "actor": "--algo actor_critic --env CartPole-v1 -n 9000 --eval-freq 3000",
    "reinforce": "--algo reinforce --env FrozenLake-v1 -n 5000",
    "hidden state": "--algo qlearning --env DarkWarehouse-v0 -n 20000 --eval-freq 5000",
    "bandit": "--algo ucb --env BernoulliBandit-v0 -n 2000 --eval-freq 500",
    "contextual bandit": "--algo linucb --env SegmentBandit-v0 -n 2000 --eval-freq 500",
    "mabwiser": "--algo mabwiser_ucb1 --env BernoulliBandit-v0 -n 500",
    "gaussian bandit": "--algo gradient_bandit --env GaussianBandit-v0 -n 2000",
    "ppo": "--algo ppo --env CartPole-v1 -n 1024 --eval-freq 512 --eval-episodes 3 "
    "-params n_envs:2 n_steps:128 batch_size:64",
    "ppo compiled": "--algo ppo --env Warehouse-v0 -n 1024 --eval-freq 512 "
    "-params engine:compiled n_steps:64 batch_size:64",
    "ppo normalised": "--algo ppo --env Pendulum-v1 -n 1024 --eval-episodes 2 "
    "-params normalize:true n_envs:2 n_steps:128 batch_size:64",
    "ppo stacked": "--algo ppo --env CartPole-v1 -n 512 --eval-episodes 2 "
    "-params frame_stack:2 n_envs:1 n_steps:128 batch_size:64",
    "memory": "--algo ppo_lstm --env CartPole-v1 -n 256 --eval-episodes 2 "
    "-params n_envs:1 n_steps:64 batch_size:64",
    "masks": "--algo ppo_mask --env Warehouse-v0 -n 512 -params n_envs:1 n_steps:128 batch_size:64",
    "a2c": "--algo a2c --env FrozenLake-v1 -n 600 --eval-freq 200",
    "dqn": "--algo dqn --env CartPole-v1 -n 1500 --eval-freq 500 --eval-episodes 3 "
    "-params learning_starts:200 buffer_size:1000",
    "dqn compiled": "--algo dqn --env Warehouse-v0 -n 3000 --eval-freq 1000 "
    "-params engine:compiled learning_starts:200 buffer_size:1000",
    "double dqn": "--algo double_dqn --env FrozenLake-v1 -n 1500 --eval-freq 500 "
    "-params learning_starts:200 buffer_size:1000",
    "sac": "--algo sac --env Pendulum-v1 -n 300 --eval-episodes 2 -params learning_starts:100",
    "wrapped": "--algo ppo --env CartPole-v1 -n 512 --eval-episodes 2 -params n_envs:1 n_steps:128 "
    "batch_size:64 env_wrapper:gymnasium.wrappers.TimeAwareObservation",
    "continued": "--algo qlearning --env FrozenLake-v1 -n 5000 -i {table}",
}
STUDIES = {
    "tables": "--env FrozenLake-v1 CliffWalking-v1 --algos qlearning sarsa random --seeds 5 "
    "-n 20000",
    "two budgets": "--env RandomWalk-v0 --algos n_step_sarsa value_iteration --seeds 3 -n 500 "
    "-params gamma:1.0 --no-report",
    "bandits": "bandits.yml --no-report",
    "sweep": "sweep.yml",
    "networks": "--env CartPole-v1 --algos ppo dqn --seeds 2 -n 600 --no-report",
    "until decided": "--env FrozenLake-v1 --algos qlearning random --seeds 5 -n 20000 "
    "--until-decided --no-report",
}
FILES = {
    "bandits.yml": """\
title: Which arm?
environments: {three arms: {id: BernoulliBandit-v0, env_kwargs: {pulls: 200}}}
agents:
  greedy: {algo: epsilon_greedy, sweep: {exploration_initial_eps: [0.0, 0.1, 0.5]}}
  UCB1: {algo: ucb}
tuned: false
n_timesteps: 200
seeds: 8
metric: regret
""",
    "sweep.yml": """\
title: Step sizes
environments:
  lake: {id: FrozenLake-v1}
  slippery hall: {id: Warehouse-v0, env_kwargs: {slip: 0.1}}
agents:
  Q: {algo: qlearning, sweep: {learning_rate: [0.01, 0.1, 0.5]}}
n_timesteps: 5000
seeds: 3
""",
}
SEARCH = (
    "tune.py --env FrozenLake-v1 --algo qlearning --trials 4 --seeds-per-trial 2 --retest 1 "
    "--retest-seeds 5 -n 5000 -j 1 --sampler random --no-report -f search"
)
# Clocks, places, and what only tells which program wrote it.
VOLATILE = ("seconds", "path", "folder", "spent", "time", "date", "version", "speed", "machine")


class Checkout:
    """Types the commands of a checkout in a folder."""

    def __init__(self, root: Path, folder: Path) -> None:
        self.root, self.folder = root, folder

    def typed(self, line: str) -> int:
        """Type a command in a child of this process, libraries and all."""
        child = os.fork()
        if child == 0:
            code = 1
            try:
                program, *words = shlex.split(line)
                with (self.folder / "output").open("ab") as output:
                    os.dup2(output.fileno(), 1)
                    os.dup2(output.fileno(), 2)
                sys.argv = [program, *words]
                os.chdir(self.folder)
                runpy.run_path(str(self.root / program), run_name="__main__")
                code = 0
            except SystemExit as stop:
                code = stop.code if isinstance(stop.code, int) else int(stop.code is not None)
            finally:
                os._exit(code)
        return os.waitstatus_to_exitcode(os.waitpid(child, 0)[1])

    def started(self, line: str) -> int:
        """Type a command that starts processes itself: in a new one."""
        program, *words = shlex.split(line)
        with (self.folder / "output").open("ab") as output:
            command = [sys.executable, self.root / program, *words]
            return subprocess.run(
                command, cwd=self.folder, stdout=output, stderr=output, check=False
            ).returncode


def things(root: Path, folder: Path) -> Iterator[Thing]:
    """Everything that this file looks at; files that it needs are made in ``folder``."""
    checkout = Checkout(root, folder)
    for name, text in FILES.items():
        (folder / name).write_text(text)
    for name, flags in RUNS.items():
        needs = "run table" if "{" in flags else ""
        yield Thing(f"run {name}", "here", partial(run, checkout, name, flags), needs)
    for name, flags in STUDIES.items():
        yield Thing(f"study {name}", "here", partial(study, checkout, name, flags))
    yield Thing("search", "here", partial(search, checkout))


def run(checkout: Checkout, name: str, flags: str) -> list[str]:
    """Train, and list the figures in the run folder."""
    place = name.replace(" ", "_")
    table = next((checkout.folder / "table").glob("*/*_1"), Path())
    flags = flags.format(table=next(table.glob("*-v*.zip"), ""))
    line = f"train.py {flags} --seed 0 -f {place} --verbose 0"
    return [f"exit {checkout.typed(line)}", *figures(next((checkout.folder / place).glob("*/*_1")))]


def figures(folder: Path) -> Iterator[str]:
    """What a run folder says in numbers."""
    record = json.loads((folder / "run.json").read_text())
    for place, value in flattened(record["final"], "final"):
        yield f"{place} {value!r}"
    for key in ("state", "n_timesteps", "n_episodes", "engine"):
        yield f"{key} {record.get(key)!r}"
    for file in sorted(folder.glob("*.npz")):
        with np.load(file) as arrays:
            for key in sorted(arrays):
                yield f"{file.name} {key} {digest(arrays[key])}"
    for file in sorted(folder.glob("*.monitor.csv")):
        rows = [row.split(",") for row in file.read_text().splitlines()[1:]]
        kept = [i for i, key in enumerate(rows[0]) if key != "t"]
        columns = " ".join(rows[0][i] for i in kept)
        text = "\n".join(",".join(row[i] for i in kept) for row in rows)
        yield f"{file.name} {columns} {len(rows) - 1} {digest(np.frombuffer(text.encode(), 'u1'))}"
    for file in sorted(folder.glob("*.zip")):
        yield f"{file.name} {weights(file)}"


def flattened(value: Any, place: str) -> Iterator[tuple[str, Any]]:
    """The leaves of a record, without clocks."""
    if isinstance(value, dict):
        for key in sorted(value):
            if not any(word in key for word in VOLATILE):
                yield from flattened(value[key], f"{place}.{key}")
    else:
        yield place, value


def weights(path: Path) -> str:
    """A digest of the tensors in a model zip."""
    import torch as th

    with zipfile.ZipFile(path) as file, file.open("policy.pth") as member:
        tensors = th.load(io.BytesIO(member.read()), weights_only=True)
    return digest(*(tensors[name].numpy() for name in sorted(tensors)))


def study(checkout: Checkout, name: str, flags: str) -> list[str]:
    """Carry a study out, and digest the columns of its tables."""
    place = name.replace(" ", "_")
    code = checkout.started(f"compare.py {flags} --name {place} -f studies")
    folder = checkout.folder / "studies" / place
    lines = [f"exit {code}"]
    for file in ("summary.csv", "curves.csv.gz", "verdicts.csv"):
        lines += columns(folder / file)
    return lines


def columns(path: Path) -> Iterator[str]:
    """A line for each column of a table that clocks and places do not touch."""
    if not path.is_file():
        yield f"{path.name} no such file"
        return
    opened = gzip.open if path.suffix == ".gz" else open
    with opened(path, "rt", encoding="utf-8", newline="") as file:
        rows = list(csv.DictReader(file))
    yield f"{path.name} {len(rows)} rows"
    for key in rows[0] if rows else ():
        if not any(word in key for word in VOLATILE):
            text = "\n".join(row[key] for row in rows)
            shown = text.replace("\n", " ") if len(text) < 60 else digest(list(text.encode()))
            yield f"{path.name} {key} {shown}"


def search(checkout: Checkout) -> list[str]:
    """Search for hyperparameters, and list the trials."""
    import optuna

    code = checkout.started(SEARCH)
    storage = f"sqlite:///{next((checkout.folder / 'search').rglob('trials.db'))}"
    trials = optuna.load_study(storage=storage, study_name=None).trials
    told = [f"{trial.number} {trial.state.name} {trial.values} {trial.params}" for trial in trials]
    return [f"exit {code}", *told]
