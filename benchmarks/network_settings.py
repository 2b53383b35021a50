"""What fused Adam and flushed denormals save in training DQN: processor time by the step.

    python benchmarks/network_settings.py                # three rounds, two minutes

Stable-Baselines3's own DQN on CartPole-v1, one thread; each variant is timed once in every round,
so that a machine whose speed changes slows all of them down alike. Medians over the rounds.
"""

from __future__ import annotations

import argparse
import os
import statistics
import time
from typing import Any

os.environ.setdefault("OMP_NUM_THREADS", "1")

import torch as th
from rich.console import Console
from rich.table import Table

# Those of rl_zoo3 for CartPole, but for a network that learns all the time; and a small one.
SETTINGS: dict[str, dict[str, Any]] = {
    "[256, 256], batch 64": {"net_arch": [256, 256], "batch_size": 64, "train_freq": 1},
    "[64, 64], batch 32, every 4 steps": {"net_arch": [64, 64], "batch_size": 32, "train_freq": 4},
}
# Fused Adam, and flushed denormals.
VARIANTS = {
    "library": (False, False),
    "fused": (True, False),
    "flushed": (False, True),
    "both": (True, True),
}
STEPS = 2000


def microseconds(net_arch: list[int], batch_size: int, train_freq: int, variant: str) -> float:
    """Processor time of a training by the step."""
    from stable_baselines3 import DQN

    fused, flushed = VARIANTS[variant]
    th.set_num_threads(1)
    th.set_flush_denormal(flushed)
    policy = {"net_arch": net_arch, "optimizer_kwargs": {"fused": True} if fused else {}}
    shared: dict[str, Any] = {"buffer_size": 10_000, "learning_starts": 100, "seed": 0}
    model = DQN(
        "MlpPolicy",
        "CartPole-v1",
        batch_size=batch_size,
        train_freq=train_freq,
        policy_kwargs=policy,
        device="cpu",
        **shared,
    )
    started = time.process_time()
    model.learn(STEPS)
    return 1e6 * (time.process_time() - started) / STEPS


def main() -> None:
    """Time everything and print it."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--repeats", type=int, default=3, metavar="N", help="rounds (default 3)")
    repeats = parser.parse_args().repeats
    table = Table("network", "variant", "us a step", "library takes")
    for name, settings in SETTINGS.items():
        rounds = [
            {variant: microseconds(**settings, variant=variant) for variant in VARIANTS}
            for _ in range(repeats)
        ]
        taken = {v: statistics.median(each[v] for each in rounds) for v in VARIANTS}
        for variant, spent in taken.items():
            table.add_row(name, variant, f"{spent:.0f}", f"{taken['library'] / spent:.2f} x")
    Console(width=100).print(table)


if __name__ == "__main__":
    main()
