"""Faults that checkers of environments find, and their false alarms.

    python benchmarks/doctor.py [--json FILE]

The faults are those of tests/diagnosis/planted_environments.py. Other checkers find a fault if they
raise or warn as they do not on the right environment, ours if it has the right name. On this
project's environments, toy text and classic control, errors, warnings and findings of the levels
breaks and bites are false alarms.
"""

from __future__ import annotations

import argparse
import contextlib
import io
import sys
import time
import warnings
from functools import partial
from pathlib import Path
from typing import Any

import gymnasium as gym
from gymnasium.utils.env_checker import check_env
from stable_baselines3.common import env_checker

from rl_yardstick.diagnosis.environment_checks import examine
from rl_yardstick.envs import ENVIRONMENTS
from rl_yardstick.pipeline.environment_trial import KINDS

ROOT = Path(__file__).resolve().parents[1]
sys.path[:0] = [str(ROOT), str(ROOT / "docs" / "scripts")]

from measured_tables import measured_block, publish  # noqa: E402
from tests.diagnosis.planted_environments import PLANTED, RIGHT  # noqa: E402

PLAY = ("FrozenLake-v1", "FrozenLake8x8-v1", "Taxi-v4", "CliffWalking-v1", "Blackjack-v1")
CONTROL = ("CartPole-v1", "MountainCar-v0", "MountainCarContinuous-v0", "Pendulum-v1", "Acrobot-v1")
IDS = [*(name for name in ENVIRONMENTS if name != "ReplayBandit-v0"), *PLAY, *CONTROL]


def said_by(check: Any, make: Any) -> set[str]:
    """The error and the warnings of a checker; both checkers warn of wrappers."""
    with warnings.catch_warnings(record=True) as caught, contextlib.redirect_stdout(io.StringIO()):
        warnings.simplefilter("always")
        try:
            env = make()
            is_plain = env.spec is not None or isinstance(env, gym.wrappers.TimeLimit)
            check(env.unwrapped if is_plain else env)
        except (Exception, SystemExit) as error:  # noqa: BLE001  # an environment may raise any
            return {str(error)}
    return {str(warning.message) for warning in caught}


def main() -> None:
    """Print the table, or publish it."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--json", type=Path, default=Path("environment-checks.json"))
    path: Path = parser.parse_args().json
    checkers: dict[str, Any] = {
        "Gymnasium's `check_env`": lambda make: said_by(check_env, make),
        "Stable-Baselines3's `check_env`": lambda make: said_by(env_checker.check_env, make),
        "`yardstick check-env`": lambda make: {f"{one.level} {one.name}" for one in examine(make)},
    }
    rows = ["| checker | found | missed | false alarms | seconds each |", "|---|---|---|---|---|"]
    for name, check in checkers.items():
        usual, begin, n_found = check(RIGHT["ferry"]), time.monotonic(), 0
        for kind, make in PLANTED.values():
            told = check(make) - usual
            ours = {f"{KINDS[kind][0]} {kind}"} if "yardstick" in name else told
            n_found += bool(ours & told)
        seconds = (time.monotonic() - begin) / len(PLANTED)
        makers = (partial(gym.make, each, disable_env_checker=True) for each in IDS)
        n_alarms = sum(any(one[:4] != "note" for one in check(make)) for make in makers)
        counts = f"{n_found} of {len(PLANTED)} | {len(PLANTED) - n_found}"
        rows.append(f"| {name} | {counts} | {n_alarms} of {len(IDS)} | {seconds:.1f} |")
    publish(path, "\n".join(rows))
    print(measured_block(str(path.resolve())))


if __name__ == "__main__":
    main()
