"""Extreme settings, of the right type, for all agents: each run ends, or is refused in one line.

    python benchmarks/extreme_settings.py              # every setting once, ten minutes
    python benchmarks/extreme_settings.py --share 0.1  # a tenth of them
    python benchmarks/extreme_settings.py --only ppo dqn

Each number that an agent's constructor takes is set to values at the ends of its type: huge, tiny,
zero, negative. A case is bad where it leaves a traceback, more than one line or none, a run folder
that does not say what became of the run, or takes longer than it should.
"""

from __future__ import annotations

import argparse
import json
import os
import random
import resource
import signal
import sys
import tempfile
import time
from collections import Counter
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

SECONDS = 30
MEMORY = 24 << 30  # bytes of addresses
STEPS = 300
REALS = ("1e38", "1e308", "1e-320", "0", "-1", "0.5", "1.5")
COUNTS = ("0", "1", "-1", "-5", "7", "1e9", "10000000000000000000000")
# Of these a large number asks for much work, and gets it.
WORK = ("train_freq", "gradient_steps", "n_epochs", "n_steps", "cg_max_steps", "n_delta")
WHOLE = {
    "n_envs": COUNTS,
    "frame_stack": COUNTS,
    "n_timesteps": ("1", "0", "-1", "1e-320"),
    "noise_std": REALS,
    "policy_kwargs": (
        "{'net_arch': [0]}",
        "{'net_arch': [-1]}",
        "{'net_arch': []}",
        "{'net_arch': [1]}",
        "{'net_arch': [1000000000000]}",
        "{'log_std_init': 1e38}",
        "{'log_std_init': -1e38}",
        "{'n_critics': 0}",
        "{'n_quantiles': 0}",
        "{'n_quantiles': 1}",
        "{'lstm_hidden_size': 0}",
        "{'n_lstm_layers': 0}",
        "{'optimizer_kwargs': {'weight_decay': 1e38}}",
        "{'optimizer_kwargs': {'eps': 0}}",
        "{'optimizer_kwargs': {'eps': -1}}",
        "{'optimizer_kwargs': {'betas': [2, 2]}}",
    ),
    "normalize": ("{'clip_obs': 0}", "{'clip_obs': -1}", "{'epsilon': 0}", "{'gamma': 1.5}"),
}


@dataclass(frozen=True)
class Case:
    """One agent with one extreme setting."""

    algo: str
    env_id: str
    setting: str

    @property
    def words(self) -> list[str]:
        """The command line."""
        budget = [] if self.setting.startswith("n_timesteps") else ["-n", str(STEPS)]
        small = _small(self.algo, self.setting.partition(":")[0])
        words = ["--algo", self.algo, "--env", self.env_id, *budget, "--seed", "1"]
        return [*words, "--eval-episodes", "1", "-params", *small, self.setting]


def _small(algo: str, changed: str) -> list[str]:
    """Settings that let an agent learn within the few steps."""
    from agents import load_algorithm
    from pipeline.settings.values import algorithm_parameters

    known = algorithm_parameters(load_algorithm(algo))
    small = {"learning_starts": 20, "buffer_size": 1000, "batch_size": 16}
    if "n_steps" in known and "buffer_size" not in known:
        small["n_steps"] = 32
    return [f"{k}:{v}" for k, v in small.items() if k in known and k != changed]


def cases() -> Iterator[Case]:
    """Every number of every agent, at the ends of its type."""
    from agents import ALGORITHMS, load_algorithm
    from pipeline.settings.values import algorithm_parameters

    for algo in ALGORITHMS:
        env_id = _environment(algo)
        if env_id is None:
            continue
        for name, parameter in algorithm_parameters(load_algorithm(algo)).items():
            for value in _values(name, parameter):
                yield Case(algo, env_id, f"{name}:{value}")
        for name, values in WHOLE.items():
            if name != "policy_kwargs":
                yield from (Case(algo, env_id, f"{name}:{value}") for value in values)


def _environment(algo: str) -> str | None:
    for env_id in ("Warehouse-v0", "Pendulum-v1", "BernoulliBandit-v0", "LinearBandit-v0"):
        if _fits(algo, env_id):
            return env_id
    return None


def _fits(algo: str, env_id: str) -> bool:
    import gymnasium as gym

    from agents import ALGORITHMS

    env = gym.make(env_id)
    misfit = ALGORITHMS[algo].env_misfit(env)
    env.close()
    return not misfit


def _values(name: str, parameter: Any) -> tuple[str, ...]:
    if name == "policy_kwargs":
        return WHOLE[name]
    annotation = str(parameter.annotation)
    if name in ("env", "seed", "verbose", "device", "tensorboard_log", "policy"):
        return ()
    if "float" in annotation:
        return REALS
    counts = [count for count in COUNTS if not (count == "1e9" and name in WORK)]
    return tuple(counts) if "int" in annotation else ()


def verdict(case: Case, folder: Path) -> tuple[str, str]:
    """What became of a case, in a word, and what it printed; done in a process of its own."""
    output = folder / "output"
    begun = time.monotonic()
    pid = os.fork()
    if pid == 0:
        _do(case, folder, output)
    while os.waitpid(pid, os.WNOHANG) == (0, 0):
        if time.monotonic() - begun > SECONDS:
            os.kill(pid, signal.SIGKILL)
            os.waitpid(pid, 0)
            return "too slow", _text(output)
        time.sleep(0.01)
    code = int((folder / "code").read_text()) if (folder / "code").exists() else -1
    return _word(code, _text(output), folder), _text(output)


def _text(path: Path) -> str:
    return path.read_text(encoding="utf-8", errors="replace") if path.exists() else ""


def _do(case: Case, folder: Path, output: Path) -> None:
    """Do a case as the command does, and leave."""
    number = os.open(output, os.O_WRONLY | os.O_CREAT | os.O_TRUNC)
    os.dup2(number, 1)
    os.dup2(number, 2)
    resource.setrlimit(resource.RLIMIT_AS, (MEMORY, MEMORY))
    sys.argv = ["train.py", *case.words, "-f", str(folder / "logs"), "--verbose", "0"]
    code = 1
    try:
        from commands.cli import run_command
        from commands.train import main

        run_command(main)
    except SystemExit as stop:
        code = stop.code if isinstance(stop.code, int) else 0
    except BaseException:  # noqa: BLE001  # it is what is looked for
        import traceback

        traceback.print_exc()
    sys.stdout.flush()
    sys.stderr.flush()
    (folder / "code").write_text(str(code))
    os._exit(0)


def _word(code: int, text: str, folder: Path) -> str:
    lines = [line for line in text.splitlines() if line.strip()]
    records = [json.loads(path.read_text()) for path in folder.rglob("run.json")]
    states = [record.get("state") for record in records]
    if code < 0:
        return "died"
    if "Traceback" in text:
        return "traceback"
    if code == 0:
        return (
            "done"
            if states == ["finished"] and not lines
            else f"done, but {states} {len(lines)} lines"
        )
    if code == 2 and len(lines) == 1:
        return (
            "refused"
            if not states
            else "failed"
            if states == ["failed"]
            else f"refused, but {states}"
        )
    return f"code {code} with {len(lines)} lines"


def main() -> int:
    """Do the cases; 1 where one is bad."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").partition("\n")[0])
    parser.add_argument("--share", type=float, default=1.0)
    parser.add_argument("--only", nargs="+", default=[])
    parser.add_argument("--settings", nargs="+", default=[], help="beginnings of settings")
    args = parser.parse_args()
    import torch as th

    import pipeline.training  # noqa: F401  # once, for all

    th.set_num_threads(1)
    draw, counts = random.Random(0), Counter[str]()  # noqa: S311
    for case in cases():
        if args.only and case.algo not in args.only:
            continue
        if args.settings and not case.setting.startswith(tuple(args.settings)):
            continue
        if draw.random() >= args.share:
            continue
        with tempfile.TemporaryDirectory() as folder:
            word, text = verdict(case, Path(folder))
        counts[word] += 1
        last = text.strip().splitlines()[-1:]
        print(f"{word:10} {case.algo} {case.setting}: {' '.join(last)}", flush=True)
    print(counts)
    return int(set(counts) - {"done", "refused", "failed"} != set())


if __name__ == "__main__":
    sys.exit(main())
