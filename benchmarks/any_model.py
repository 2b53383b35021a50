"""The models that `model_of` finds: states, processor seconds, optimum, and whether they are right.

    python benchmarks/any_model.py [--json FILE] [--seconds SECONDS] [NAME ...]

Each model has passed a test on 20,000 steps of its environment. Where each state shows another
observation, the models are tested again on 20,000 steps with another seed, and compared with the
published model if there is one. Optima are those within the time limit, or of 1,000 steps.
"""

from __future__ import annotations

import argparse
import contextlib
import importlib.util
import sys
from collections.abc import Callable
from functools import partial
from pathlib import Path
from time import process_time
from typing import Any

import gymnasium as gym

from rl_yardstick.envs import ENVIRONMENTS, found_models, register_environments
from rl_yardstick.envs.known_models import observations_of_states, transition_model
from rl_yardstick.envs.model_of import FoundModel, NotFinite, model_of
from rl_yardstick.envs.model_of.check import refutation

ROOT = Path(__file__).resolve().parents[1]
sys.path[:0] = [str(ROOT), str(ROOT / "docs" / "scripts")]

from measured_tables import measured_block, publish  # noqa: E402
from tests.envs.test_model_of import TicTacToe, Tutorial, name_of, optimum, same_model  # noqa: E402

TOY_TEXT: dict[str, dict[str, Any]] = {
    "FrozenLake-v1": {},
    "FrozenLake-v1, not slippery": {"is_slippery": False},
    "FrozenLake8x8-v1": {},
    "CliffWalking-v1": {},
    "CliffWalking-v1, slippery": {"is_slippery": True},
    "Taxi-v4": {},
    "Taxi-v4, rainy": {"is_rainy": True},
    "Taxi-v4, fickle": {"fickle_passenger": True},
    "Taxi-v4, rainy and fickle": {"is_rainy": True, "fickle_passenger": True},
}
MINIGRID: dict[str, tuple[int, ...] | None] = {  # with the seeds of resets; None for all
    "MiniGrid-Empty-5x5-v0": None,
    "MiniGrid-DoorKey-5x5-v0": None,
    "MiniGrid-FourRooms-v0": (0,),
}
HEADING = ["environment", "states x actions", "seconds", "optimum", "impossible", "as published"]


def makers() -> dict[str, Callable[[], Any]]:
    """How to make each environment."""
    register_environments()
    found: dict[str, Callable[[], Any]] = {}
    for name, options in TOY_TEXT.items():
        found[name] = partial(gym.make, name.partition(",")[0], **options)
    found |= {"the tutorial's grid": Tutorial, "tic-tac-toe, random player": TicTacToe}
    if importlib.util.find_spec("minigrid"):
        importlib.import_module("minigrid")
        found |= {name: partial(gym.make, name) for name in MINIGRID}
    own = (name for name in ENVIRONMENTS if name != "ReplayBandit-v0")
    return found | {name: partial(gym.make, name) for name in own}


def impossible(env: gym.Env[Any, Any], found: FoundModel) -> str:
    """What 20,000 more steps refute, where observations tell states apart."""
    names = dict.fromkeys(map(name_of, found.observations))
    numbers = {name: number for number, name in enumerate(names)}
    times = len(found.observations) // len(numbers)

    def state_of(observation: Any, time: int) -> int | None:
        number = numbers.get(name_of(observation))
        return None if number is None else min(time, times - 1) * len(numbers) + number

    actions = [*range(found.model.n_actions)]
    problem = refutation(env, found.model, state_of, actions, found.mask, seed=1)
    return problem or "0 of 40,000"


def row(name: str, make: Callable[[], Any], seconds: float) -> list[str]:
    """A line of the table."""
    env, starts = make(), MINIGRID.get(name)
    begin = process_time()
    try:
        found = model_of(env, seconds=seconds, starts=starts)
    except NotFinite as reason:
        return [name, "", "", f"refused: {reason}", "", ""]
    spent = process_time() - begin
    limit = (env.spec and env.spec.max_episode_steps) or 1000
    published, same, hidden = transition_model(env), "", "behind" in " ".join(found.notes)
    if published is not None and not hidden:
        same = "no"
        with contextlib.suppress(AssertionError):
            same_model(found, published, observations_of_states(env))
            same = "yes, to 1e-9"
    size = f"{found.model.n_states:,} x {found.model.n_actions}"
    tested = "0 of 20,000" if starts or hidden else impossible(env.unwrapped, found)
    return [name, size, f"{spent:.1f}", f"{optimum(found, limit):.7g}", tested, same]


def main() -> None:
    """Print the table, or publish it."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("names", nargs="*", metavar="NAME")
    parser.add_argument("--json", type=Path, default=Path("any-model.json"))
    parser.add_argument("--seconds", type=float, default=100.0)
    given = parser.parse_args()
    found_models.limit("none")  # so that `transition_model` gives what is published
    rows = [HEADING, ["---"] * len(HEADING)]
    for name, make in makers().items():
        if not given.names or name in given.names:
            rows.append(row(name, make, given.seconds))
            print(*rows[-1], sep=" | ", file=sys.stderr, flush=True)
    publish(given.json, "\n".join(f"| {' | '.join(cells)} |" for cells in rows))
    print(measured_block(str(given.json.resolve())))


if __name__ == "__main__":
    main()
