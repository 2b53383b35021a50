"""What the commands produce: help, refusals, run folders, studies, a search, as lines of text.

Each command is typed in a process of its own. Most are forked from this one, which has imported the
libraries by then; those that start processes themselves are started anew.
"""

from __future__ import annotations

import csv
import io
import json
import os
import re
import runpy
import shlex
import subprocess
import sys
import tomllib
import zipfile
from collections.abc import Iterator
from functools import partial
from importlib import import_module
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import yaml
from trained import LOG, Thing, digest

HERE = Path(__file__).parent
# Wide enough for every column of every table; help is 80 columns wide.
WIDTH = 240

HELP = ("train.py", "enjoy.py", "compare.py", "tune.py")
HELP += ("yardstick pack", "yardstick inspect", "yardstick")
# Says the same as that of the scripts, so a digest is enough.
INSTALLED_HELP = ("yardstick train", "yardstick enjoy", "yardstick compare", "yardstick tune")
# The runs whose folders are looked at; refused commands find them too.
RUNS = {
    "qlearning/FrozenLake-v1_1": "-n 1000 --eval-freq 500 --save-freq 400",
    "sarsa/Warehouse-v0_1": "--n-episodes 30 --env-kwargs slip:0.1 -params gamma:0.99 n_envs:2",
    "linucb/SegmentBandit-v0_1": "-n 500 -params alpha:0.5",
    "ppo/CartPole-v1_1": "-n 64 --eval-freq 32 --eval-episodes 2 -params n_steps:32 batch_size:16 "
    "n_epochs:1 n_envs:1 normalize:true",
    "dqn/FrozenLake-v1_1": "-n 60 --save-replay-buffer -params learning_starts:16 batch_size:8 "
    "buffer_size:100 n_envs:1",
}
# What is typed beside them afterwards, in this order.
LAKE = "--env FrozenLake-v1 --algo qlearning"
AFTERWARDS = (
    "enjoy.py logs/qlearning/FrozenLake-v1_1 --n-episodes 3 --render none",
    f"enjoy.py {LAKE} --load-best --stochastic -n 30 --render none",
    "enjoy.py --algo sarsa --env Warehouse-v0 --n-episodes 1 -n 3 --render ansi",
    "enjoy.py --algo ppo --env CartPole-v1 --n-episodes 2 --render none",
    f"train.py {LAKE} -n 500 --seed 1 -i logs/qlearning/FrozenLake-v1_1",
    f"train.py {LAKE} -n 300 --seed 1 --watch-learning lake.html",
    "train.py --list",
    "compare.py --logged log.csv --policy logs/linucb/SegmentBandit-v0_1",
    "yardstick inspect logs/qlearning/FrozenLake-v1_1/FrozenLake-v1.zip",
    "yardstick inspect logs/ppo/CartPole-v1_1/CartPole-v1.zip",
    "yardstick pack logs/qlearning/FrozenLake-v1_1 lake.zip",
    "enjoy.py lake.zip --n-episodes 1 --render none",
)
STUDIES = {
    "tables": "compare.py --env FrozenLake-v1 CliffWalking-v1 --algos qlearning sarsa random "
    "--seeds 5 -n 2000 --name tables -f studies",
    "sweep": "compare.py --env RandomWalk-v0 --algos n_step_sarsa value_iteration --seeds 3 -n 500 "
    "-params gamma:1.0 --name sweep -f studies --no-report --episodes-table 10",
    "bandits": "compare.py bandits.yml --name bandits -f studies",
}
BANDITS = """\
title: Which arm?
environments: {three arms: {id: BernoulliBandit-v0, env_kwargs: {pulls: 200}}}
agents:
  greedy: {algo: epsilon_greedy, sweep: {exploration_initial_eps: [0.0, 0.1, 0.5]}}
  UCB1: {algo: ucb}
tuned: false
n_timesteps: 200
seeds: 8
metric: regret
"""
SEARCH = (
    "tune.py --env FrozenLake-v1 --algo qlearning --trials 3 --seeds-per-trial 2 --retest 1 "
    "--retest-seeds 5 -n 500 -j 1 --sampler random --no-report -f searches"
)

# Times, versions, dates, digests and machines: what differs from one run to the next.
VOLATILE = (
    (re.compile(r"\b\d{4}-\d\d-\d\d([ T]\d\d:\d\d(:\d\d)?)?(\.\d+)?Z?"), "DATE"),
    (re.compile(r"\b[0-9a-f]{40,64}\b"), "SHA"),
    (re.compile(r"\b\d[\d.,]* ?(ms|s|min|minutes?|seconds?|h|hours?)\b(?!\w)"), "TIME"),
    (re.compile(r"(about|less than) TIME"), "TIME"),
    (re.compile(r"\bdata +[\d,]+ bytes"), "data SIZE"),  # of which some are times
    (re.compile(r"start_time +\d+"), "start_time TIME"),
    (re.compile(r"\([\d.,]+ steps/s\)"), "(SPEED)"),
    (re.compile(r"\b\d+\.\d+(\.\d+)+(\+\w+)?"), "VERSION"),
    (re.compile(r"\b\d[\d.,]* ?[kKMG]?i?B\b"), "SIZE"),
)
# How far a long training has come is told by the clock.
PROGRESS = re.compile(r"^\d+%( |$)|^\d+ of \d+ runs in|, TIME$|compiling|left by the clock")
BOXES = re.compile(r"[\u2500-\u257f]+")
NOT_RECORDED = ("cpu_seconds", "distributions", "files", "machine", "seconds", "versions")


class Done(NamedTuple):
    """A command that has ended."""

    code: int
    out: str
    err: str

    def words(self, *, with_output: bool = False) -> list[str]:
        """The complaint to the letter, and what was printed too if that is asked for."""
        out = self.out.splitlines() if with_output else []
        return [f"exit {self.code}", *out, *self.err.splitlines()]

    def lines(self) -> list[str]:
        """All that it said, without what differs from run to run."""
        out = [line for line in readable(self.out) if not PROGRESS.search(line)]
        return [f"exit {self.code}", *out, *(f"stderr: {line}" for line in readable(self.err))]


class Commands:
    """Types the commands of a checkout in a folder."""

    def __init__(self, root: Path, folder: Path) -> None:
        self.root, self.folder = root, folder
        project = tomllib.loads((root / "pyproject.toml").read_text())
        self._installed = project["project"]["scripts"]["yardstick"]

    def typed(self, line: str, width: int = WIDTH) -> Done:
        """Type a command, and wait for its end: in a child of this process, libraries and all."""
        paths = [self.folder / name for name in (".out", ".err")]
        child = os.fork()
        if child == 0:
            code = 1
            try:
                for descriptor, path in zip((1, 2), paths, strict=True):
                    os.dup2(os.open(path, os.O_CREAT | os.O_WRONLY | os.O_TRUNC), descriptor)
                os.environ["COLUMNS"] = str(width)
                os.chdir(self.folder)
                code = self._run(shlex.split(line))
            finally:
                for stream in (sys.stdout, sys.stderr):
                    stream.flush()
                os._exit(code)
        _, status = os.waitpid(child, 0)
        return Done(os.waitstatus_to_exitcode(status), *(self._text(path) for path in paths))

    def _run(self, words: list[str]) -> int:
        """Be the command, as Python or the installed script would call it."""
        sys.stdout = io.TextIOWrapper(os.fdopen(1, "wb"), "utf-8", line_buffering=True)
        sys.stderr = io.TextIOWrapper(os.fdopen(2, "wb"), "utf-8", line_buffering=True)
        program, *_ = sys.argv = words
        try:
            if program.endswith(".py"):
                runpy.run_path(str(self.root / program), run_name="__main__")
            else:
                module, _, function = self._installed.partition(":")
                getattr(import_module(module), function)()
        except SystemExit as stop:
            return stop.code if isinstance(stop.code, int) else 0 if stop.code is None else 1
        except BaseException:  # noqa: BLE001  # as Python ends with one
            sys.excepthook(*sys.exc_info())  # type: ignore[arg-type]
            return 1
        return 0

    def started(self, line: str) -> Done:
        """Type a command that starts processes itself: in a new one."""
        program, *words = shlex.split(line)
        done = subprocess.run(
            [sys.executable, self.root / program, *words],
            cwd=self.folder,
            env={**os.environ, "COLUMNS": str(WIDTH)},
            capture_output=True,
            text=True,
            check=False,
        )
        out, err = (self._plain(text) for text in (done.stdout, done.stderr))
        return Done(done.returncode, out, err)

    def _text(self, path: Path) -> str:
        return self._plain(path.read_text(encoding="utf-8"))

    def _plain(self, text: str) -> str:
        """Without the places where checkout and folder happen to lie."""
        return text.replace(str(self.folder), "HERE").replace(f"{self.root}/", "")


def readable(text: str, *, indented: bool = False) -> list[str]:
    """The lines of a text without times and versions, boxes and padding; empty ones left out."""
    for pattern, word in VOLATILE:
        text = pattern.sub(word, text)
    lines = []
    for line in text.splitlines():
        words = re.sub(r"  +", " ", BOXES.sub("|", line)).strip()
        margin = len(line) - len(line.lstrip()) if indented else 0
        if words.strip("| "):
            lines.append(" " * margin + words)
    return lines


def things(root: Path, folder: Path) -> Iterator[Thing]:
    """Everything that this file looks at; files that it needs are made in ``folder``."""
    commands = Commands(root, folder)

    def helped(line: str) -> list[str]:
        return commands.typed(line, 80).words(with_output=True)

    (folder / "log.csv").write_text(f"x,y,arm,reward,propensity\n{LOG}")
    (folder / "bandits.yml").write_text(BANDITS)
    wrong = yaml.safe_load((HERE / "wrong_commands.yml").read_text(encoding="utf-8"))
    for name, text in wrong["files"].items():
        (folder / name).write_text(text, encoding="utf-8")
    for name in HELP:
        yield Thing(f"help {name}", "python", partial(helped, f"{name} --help"))
    for name in INSTALLED_HELP:
        yield Thing(f"help {name}", "python", lambda n=name: digest(helped(f"{n} --help")))
    for path, flags in RUNS.items():
        yield Thing(f"run {path}", "here", lambda p=path, f=flags: run(commands, p, f))
    for line in AFTERWARDS:
        yield Thing(f"then {line}", "here", lambda typed=line: commands.typed(typed).lines(), "run")
    yield Thing("pack lake.zip", "here", lambda: pack(folder / "lake.zip"), "then")
    for line in wrong["commands"]:
        needs = "run" if "logs/" in line or line.startswith("enjoy") else ""
        look = partial(lambda typed: commands.typed(typed).words(), line)
        yield Thing(f"wrong {line}", "python", look, needs)
    for name, line in STUDIES.items():
        yield Thing(f"study {name}", "here", lambda typed=line: commands.started(typed).lines())
        for file in ("summary.csv", "verdicts.md", "verdicts.tex", "study.yml"):
            look = partial(written, root, folder / "studies" / name / file)
            yield Thing(f"study {name} {file}", "here", look, f"study {name}")
    yield Thing("search", "here", lambda: commands.started(SEARCH).lines())
    yield Thing("search files", "here", lambda: listed(folder / "searches"), "search")


def run(commands: Commands, path: str, flags: str) -> list[str]:
    """Train, and say what is in the run folder."""
    algo, _, rest = path.partition("/")
    env_id = rest.rpartition("_")[0]
    done = commands.typed(f"train.py --algo {algo} --env {env_id} --seed 0 {flags}")
    folder = commands.folder / "logs" / path
    lines = done.lines()
    for file in sorted(file for file in folder.rglob("*") if file.is_file()):
        lines.append(f"file {file.relative_to(folder)}")
    record = json.loads((folder / "run.json").read_text())
    lines += [f"run.json {line}" for line in flattened(record)]
    for name in ("config.yml", "args.yml"):
        text = (folder / env_id / name).read_text(encoding="utf-8")
        lines += [f"{name} {line}" for line in text.splitlines()]
    for file in sorted(folder.glob("*.npz")):
        with np.load(file) as arrays:
            lines += [f"{file.name} {name} {digest(arrays[name])}" for name in sorted(arrays)]
    for file in sorted(folder.glob("*.monitor.csv")):
        head, *rows = file.read_text().splitlines()
        kept = [",".join(row.split(",")[:2]) for row in rows]
        lines.append(f"{file.name} {sorted(json.loads(head[1:]))} {rows[0]} {digest(kept)}")
    for file in sorted(folder.glob("*.zip")):
        lines += [f"{file.name} {line}" for line in model_file(file)]
    return lines


def flattened(value: Any, place: str = "") -> Iterator[str]:
    """The entries of a record, a line for each; of those that vary, that they are there."""
    if place in NOT_RECORDED:
        yield f"{place}: {sorted(value) if isinstance(value, dict) else type(value).__name__}"
    elif isinstance(value, dict) and value:
        for key in value:
            yield from flattened(value[key], f"{place}.{key}".removeprefix("."))
    else:
        yield f"{place}: {readable(json.dumps(value))[0]}"


def model_file(path: Path) -> Iterator[str]:
    """What a model zip holds: its members, the keys of its data, its tensors."""
    import torch as th

    with zipfile.ZipFile(path) as file:
        yield " ".join(sorted(file.namelist()))
        yield "data " + " ".join(sorted(json.loads(file.read("data"))))
        with file.open("policy.pth") as weights:
            tensors = th.load(io.BytesIO(weights.read()), weights_only=True)
        for name in sorted(tensors):
            yield f"policy {name} {digest(tensors[name].numpy())}"


def pack(path: Path) -> list[str]:
    """The members of a pack, and its card."""
    with zipfile.ZipFile(path) as file:
        return [*sorted(file.namelist()), *readable(file.read("README.md").decode())]


def listed(folder: Path) -> list[str]:
    """The files of a folder, but for those of single runs."""
    files = sorted(path.relative_to(folder).as_posix() for path in folder.rglob("*"))
    return [name for name in files if "/runs/" not in name]


def written(root: Path, path: Path) -> list[str]:
    """What a study has written into a file; nothing if there is none."""
    if not path.is_file():
        return ["no such file"]
    text = path.read_text(encoding="utf-8").replace(f"{root}/", "")
    if path.suffix == ".csv":
        rows = list(csv.DictReader(io.StringIO(text)))
        timeless = [key for key in rows[0] if "seconds" not in key]
        return [",".join(rows[0]), *(",".join(row[key] for key in timeless) for row in rows)]
    return readable(text, indented=True)
