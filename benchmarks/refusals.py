"""What refusing a file takes, by the real commands: seconds and memory above a command's start-up.

    python benchmarks/refusals.py

Start-up is what the same command imports when its files are good, in a process that does nothing
else: nobody waits less who uses the command. A refusal should come within a second and 200 MB of
that, and comes long before where the file is looked at before the libraries are imported.
"""

from __future__ import annotations

import base64
import io
import json
import os
import pickle
import shutil
import subprocess
import sys
import tempfile
import zipfile
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import torch as th
from rich.console import Console

import envs  # noqa: F401  # registers the environments
from agents import load_algorithm

ROOT = Path(__file__).resolve().parent.parent
REFUSED = 2
ENJOY = ("enjoy.py", "model.zip", "--algo", "sac", "--env", "Pendulum-v1", "--render", "none")
PLAY = (*ENJOY, "-n", "5")
GO_ON = ("train.py", "--algo", "sac", "--env", "Pendulum-v1", "-n", "5", "-i", "model.zip")
TRAIN = ("train.py", "--algo", "qlearning", "--env", "Warehouse-v0", "-n", "50", "-params")
JUDGE = ("compare.py", "--logged", "log.csv", "--policy", "ucb.zip")
STUDY = ("compare.py", "study.yml", "--no-report", "-j", "1")
LOG = "arm,reward,propensity\n" + "0,1,0.4\n1,0,0.3\n2,1,0.3\n" * 50
GOOD_STUDY = """\
title: T
agents: {a: {algo: qlearning}}
environments: {e: {id: Warehouse-v0}}
n_timesteps: 50
"""


# The module behind which a command's libraries are.
_LIBRARIES = {
    "enjoy.py": "pipeline.models.load",
    "train.py": "pipeline.training",
    "compare.py": "experiments.off_policy.logged_policies",
}

# A small process in between: one that is forked counts the memory of the one that forks it.
_WATCH = """
import json, os, subprocess, sys, time
started = time.perf_counter()
process = subprocess.Popen([sys.executable, *sys.argv[1:]], stdout=subprocess.DEVNULL)
_, status, usage = os.wait4(process.pid, 0)
taken = time.perf_counter() - started
print(json.dumps([taken, usage.ru_maxrss, os.waitstatus_to_exitcode(status)]))
"""


class Attack:
    """Asks for a shell where it is unpickled."""

    def __reduce__(self) -> tuple[Any, ...]:
        return os.system, ("true",)


@dataclass(frozen=True)
class Case:
    """A command, and what is done to its good files beforehand."""

    name: str
    words: tuple[str, ...]
    spoil: Callable[[Path], object]


def measured(words: tuple[str, ...], folder: Path) -> tuple[float, float, int, str]:
    """Seconds, megabytes, exit code and errors of a process."""
    done = subprocess.run(
        [sys.executable, "-c", _WATCH, *words],
        cwd=folder,
        env={**os.environ, "PYTHONPATH": str(ROOT), "OMP_NUM_THREADS": "1"},
        capture_output=True,
        text=True,
        check=True,
    )
    taken, kilobytes, code = json.loads(done.stdout.splitlines()[-1])
    return taken, kilobytes / 1024, code, done.stderr


def command(words: tuple[str, ...]) -> tuple[str, ...]:
    """A command as it is typed in the folder."""
    return (str(ROOT / words[0]), *words[1:])


def start_up(program: str, folder: Path) -> tuple[float, float]:
    """Seconds and megabytes of importing what a command imports where its files are good."""
    seconds, megabytes, _, _ = measured(("-c", f"import {_LIBRARIES[program]}"), folder)
    return seconds, megabytes


def make_good(folder: Path) -> None:
    """The good files that the commands are given."""
    folder.mkdir()
    settings: dict[str, Any] = {"policy_kwargs": {"net_arch": [4]}, "learning_starts": 4}
    sac: Any = load_algorithm("sac")
    sac("MlpPolicy", "Pendulum-v1", device="cpu", **settings).learn(6).save(folder / "model.zip")
    ucb: Any = load_algorithm("ucb")
    ucb(next(iter(ucb.policy_aliases)), "BernoulliBandit-v0").learn(9).save(folder / "ucb.zip")
    (folder / "log.csv").write_text(LOG)
    (folder / "study.yml").write_text(GOOD_STUDY)
    (folder / "map.txt").write_text("S.\n.G\n")


def with_members(change: Callable[[dict[str, bytes]], object]) -> Callable[[Path], object]:
    """What changes the members of the model's zip."""

    def spoil(folder: Path) -> None:
        path = folder / "model.zip"
        with zipfile.ZipFile(path) as archive:
            members = {name: archive.read(name) for name in archive.namelist()}
        change(members)
        with zipfile.ZipFile(path, "w", zipfile.ZIP_DEFLATED) as archive:
            for name, content in members.items():
                archive.writestr(name, content)

    return spoil


def with_settings(**changes: Any) -> Callable[[Path], object]:
    """What changes the settings in the model's zip."""
    return with_members(
        lambda m: m.update(data=json.dumps({**json.loads(m["data"]), **changes}).encode())
    )


def with_weights(change: Callable[[Any], object]) -> Callable[[Path], object]:
    """What changes the weights in the model's zip."""

    def spoil(members: dict[str, bytes]) -> None:
        weights = th.load(io.BytesIO(members["policy.pth"]), weights_only=True)
        change(weights)
        content = io.BytesIO()
        th.save(weights, content)
        members["policy.pth"] = content.getvalue()

    return with_members(spoil)


def written(name: str, content: str | bytes) -> Callable[[Path], object]:
    """What replaces a file."""
    data = content.encode() if isinstance(content, str) else content
    return lambda folder: (folder / name).write_bytes(data)


def pipe(name: str) -> Callable[[Path], object]:
    """What replaces a file by a pipe, which to open may wait for ever."""

    def spoil(folder: Path) -> None:
        (folder / name).unlink(missing_ok=True)
        os.mkfifo(folder / name)

    return spoil


def cut(folder: Path) -> None:
    """Cut the model's zip in two."""
    content = (folder / "model.zip").read_bytes()
    (folder / "model.zip").write_bytes(content[: len(content) // 2])


ATTACK = {":type:": "x", ":serialized:": base64.b64encode(pickle.dumps(Attack())).decode()}
WEIGHT = "actor.mu.bias"
BOMB = "a: &a [x,x,x,x,x,x,x,x,x]\n" + "".join(
    f"{b}: &{b} [{', '.join([f'*{a}'] * 9)}]\n" for a, b in zip("abcdefgh", "bcdefghi", strict=True)
)


def cases() -> Iterator[Case]:
    """Every kind of refusal."""
    yield from zips()
    yield from settings_and_logs()


def zips() -> Iterator[Case]:
    """Zips, statistics and replay buffers."""
    yield Case("zip cut off", PLAY, cut)
    yield Case("no zip", PLAY, written("model.zip", b"x" * 1000))
    yield Case("a pipe", PLAY, pipe("model.zip"))
    yield Case("a member of 2 GB", PLAY, with_members(lambda m: m.update(a=bytes(2 << 30))))
    yield Case("a strange member", PLAY, with_members(lambda m: m.update({"x.py": b""})))
    yield Case("settings nested", PLAY, with_members(lambda m: m.update(data=b"[" * 10**6)))
    yield Case("a number of 10^6 digits", PLAY, digits)
    yield Case("a pickle that runs", PLAY, with_settings(ep_info_buffer=ATTACK))
    yield Case("the same, train -i", GO_ON, with_settings(ep_info_buffer=ATTACK))
    yield Case("a method hidden", PLAY, with_settings(predict=1))
    yield Case("huge networks", PLAY, with_settings(policy_kwargs={"net_arch": [10**6] * 2}))
    yield Case("weights not finite", PLAY, with_weights(lambda w: w[WEIGHT].fill_(th.nan)))
    yield Case(
        "weights of int8", PLAY, with_weights(lambda w: w.update({WEIGHT: w[WEIGHT].char()}))
    )
    statistics = "model_vecnormalize.pkl"
    yield Case("statistics that run", PLAY, written(statistics, pickle.dumps(Attack())))
    yield Case("statistics, a pipe", (*PLAY, "--vec-normalize", "pipe"), pipe("pipe"))
    yield Case("buffer that runs", GO_ON, written("replay_buffer.pkl", pickle.dumps(Attack())))


def settings_and_logs() -> Iterator[Case]:
    """What is text."""
    yield Case("YAML bomb", STUDY, written("study.yml", BOMB))
    yield Case("YAML tag", STUDY, written("study.yml", "a: !!python/name:os.system\n"))
    yield Case(
        "a sweep of 10^9", (*STUDY,), written("study.yml", f"{GOOD_STUDY}seeds: 1000000000\n")
    )
    for value in ("/dev/zero", "pipe"):
        flag = f'env_kwargs:{{"desc": "{value}"}}'
        yield Case(f"map {value}", (*TRAIN, flag), pipe("pipe"))
    yield Case("n_envs:10**9", (*TRAIN, "n_envs:1000000000"), lambda folder: None)
    yield Case("log, 5000 columns", JUDGE, written("log.csv", ",".join(map(str, range(5000)))))
    yield Case("log, one line of 900 MB", JUDGE, written("log.csv", b"1," * (450 << 20)))
    yield Case("log, 1e308", JUDGE, written("log.csv", LOG + "1,1e308,0.5\n"))
    yield Case("log, 1e-300", JUDGE, written("log.csv", LOG + "1,1,1e-300\n"))
    yield Case("policy that runs", (*JUDGE[:-1], "model.zip"), with_settings(algorithm="UCB"))


def digits(folder: Path) -> None:
    """Settings with a number that takes long to read."""
    with_members(lambda m: m.update(data=b'{"seed": ' + b"9" * 10**6 + b"}"))(folder)


def main() -> int:
    """Measure and print; the exit code is 1 where something was not refused in one line."""
    console, is_right = Console(width=120), True
    known: dict[str, tuple[float, float]] = {}
    with tempfile.TemporaryDirectory() as root:
        make_good(good := Path(root) / "good")
        for case in cases():
            folder = Path(root) / "case"
            shutil.copytree(good, folder)
            program = case.words[0]
            if program not in known:
                known[program] = start_up(program, folder)
            case.spoil(folder)
            taken, used, code, errors = measured(command(case.words), folder)
            shutil.rmtree(folder)
            is_refused = code == REFUSED and errors.count("\n") == 1
            is_right &= is_refused
            seconds, megabytes = known[program]
            console.print(
                f"{case.name:24} {taken:5.1f} s ({taken - seconds:+5.1f})  {used:4.0f} MB "
                f"({used - megabytes:+5.0f})  {'' if is_refused else errors[-300:] or code}",
                markup=False,
            )
    return 0 if is_right else 1


if __name__ == "__main__":
    sys.exit(main())
