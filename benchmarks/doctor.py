"""Faults that checkers of environments find, and their false alarms.

    python benchmarks/doctor.py [--json FILE]

The faults are those of tests/diagnosis/planted_environments.py. Gymnasium's and Stable-Baselines3's
checkers find a fault if they raise or warn in any way that they do not on the right environment.
Ours finds it if its name is among the findings. Environments of this project, of Gymnasium's toy
text and classic control count as right: there, errors, warnings and findings of the levels breaks
and bites are false alarms.
"""

from __future__ import annotations

import argparse
import contextlib
import io
import sys
import time
import warnings
from collections.abc import Callable
from pathlib import Path
from typing import Any

import gymnasium as gym
from gymnasium.utils.env_checker import check_env
from stable_baselines3.common import env_checker

from rl_yardstick.diagnosis.environment_checks import examine
from rl_yardstick.envs import ENVIRONMENTS

ROOT = Path(__file__).resolve().parents[1]
sys.path[:0] = [str(ROOT), str(ROOT / "docs" / "scripts")]

from measured_tables import measured_block, publish  # noqa: E402
from tests.diagnosis.planted_environments import PLANTED, maker  # noqa: E402

PLAY = ("FrozenLake-v1", "FrozenLake8x8-v1", "Taxi-v4", "CliffWalking-v1", "Blackjack-v1")
CONTROL = ("CartPole-v1", "MountainCar-v0", "MountainCarContinuous-v0", "Pendulum-v1", "Acrobot-v1")
RIGHT = [*(name for name in ENVIRONMENTS if name != "ReplayBandit-v0"), *PLAY, *CONTROL]


def said_by(check: Callable[[Any], object], make: Callable[..., Any]) -> set[str]:
    """The error and the warnings of a checker."""
    with warnings.catch_warnings(record=True) as caught, contextlib.redirect_stdout(io.StringIO()):
        warnings.simplefilter("always")
        try:
            env = make()
            is_plain = env.spec is not None or isinstance(env, gym.wrappers.TimeLimit)
            check(env.unwrapped if is_plain else env)  # both warn of wrappers
        except Exception as error:  # noqa: BLE001  # an environment may raise any
            return {str(error)}
    return {str(warning.message) for warning in caught}


def found_by_us(make: Callable[..., Any]) -> set[str]:
    """The names of findings, but for notes, which carry another sign."""
    return {one.name if one.level != "note" else f"note: {one.name}" for one in examine(make)}


def main() -> None:
    """Print the table, or publish it."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--json", type=Path)
    path: Path = parser.parse_args().json or Path("environment-checks.json")
    checkers: dict[str, Callable[[Callable[..., Any]], set[str]]] = {
        "Gymnasium's `check_env`": lambda make: said_by(check_env, make),
        "Stable-Baselines3's `check_env`": lambda make: said_by(env_checker.check_env, make),
    }
    rows = ["| checker | found | missed | false alarms | seconds each |", "|---|---|---|---|---|"]
    for name, check in {**checkers, "`yardstick check-env`": found_by_us}.items():
        usual, begin, n_found = check(maker()), time.monotonic(), 0
        for kind, make in PLANTED.values():
            told = check(make) - usual
            n_found += bool({kind, f"note: {kind}"} & told) if check is found_by_us else bool(told)
        seconds = (time.monotonic() - begin) / len(PLANTED)
        alarms = [
            check(lambda on=on, **extra: gym.make(on, disable_env_checker=True, **extra))
            for on in RIGHT
        ]
        n_alarms = sum(any(not one.startswith("note: ") for one in each) for each in alarms)
        counts = f"{n_found} of {len(PLANTED)} | {len(PLANTED) - n_found}"
        rows.append(f"| {name} | {counts} | {n_alarms} of {len(RIGHT)} | {seconds:.1f} |")
    publish(path, "\n".join(rows))
    print(measured_block(str(path.resolve())))


if __name__ == "__main__":
    main()
