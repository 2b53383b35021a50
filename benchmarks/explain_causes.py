"""Whether explain's first two proposals mend runs that fail for a known cause.

    python benchmarks/explain_causes.py [--only WORD ...] [--json FILE]

Each cause changes the shipped settings, which are the good ones, so that training fails. The run
of the seed with the lowest return is explained, and each of the first two proposals is trained on
the seeds 0 to 4, with the same budget unless it changes the budget. A proposal mends the cause if
it closes at least half of the gap between the mean returns of the bad and the good settings, and
changes nothing if every seed returns the same as before.
"""

from __future__ import annotations

import argparse
import sys
import tempfile
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

import rl_yardstick as ys
from rl_yardstick.agents.common.callbacks import EpisodeBudget
from rl_yardstick.mdp import policy_return
from rl_yardstick.pipeline.evaluation.exact import exact_evaluator
from rl_yardstick.pipeline.settings import (
    BUDGETS,
    override,
    parse_assignments,
    read_entry,
    read_spec,
)
from rl_yardstick.pipeline.training import make_agent

ROOT = Path(__file__).resolve().parents[1]
sys.path[:0] = [str(ROOT), str(ROOT / "docs" / "scripts")]

from measured_tables import measured_block, publish  # noqa: E402

SEEDS, MENDS = range(5), 0.5
LAKE, LAKE8, TAXI, CLIFF = "FrozenLake-v1", "FrozenLake8x8-v1", "Taxi-v4", "CliffWalking-v1"
HOUSE, WIND, RIVER, MAZE = "Warehouse-v0", "WindyGridworld-v0", "RiverSwim-v0", "DynaMaze-v0"
CLIPPED = {"gymnasium.wrappers.ClipReward": {"max_reward": 0.0}}
NEGATED = {"rl_yardstick.envs.wrappers.ScaleReward": {"scale": -1.0}}
GREEDY = {"exploration_initial_eps": 0.0, "exploration_final_eps": 0.0}
BLIND = {**GREEDY, "initial_q": 0.0}
SHY = {"initial_q": -500.0, "exploration_initial_eps": 0.1, "n_timesteps": 100_000}
HIGH = {"initial_q": 1000.0, "learning_rate": 0.05, "n_timesteps": 100_000}
TIED = {"tie_breaking": "first", "exploration_initial_eps": 0.02, "n_timesteps": 20_000}
WILD = {"learning_rate": 0.3, "n_timesteps": 20_000}
CAUSES: tuple[tuple[str, str, str, dict[str, Any]], ...] = (
    ("too few steps", "qlearning", TAXI, {"n_timesteps": 10_000}),
    ("too few episodes", "qlearning", CLIFF, {"n_episodes": 15}),
    ("step size too small", "sarsa", HOUSE, {"learning_rate": 0.001}),
    ("step size too large", "double_qlearning", LAKE8, {"learning_rate": 0.95}),
    ("no exploration", "qlearning", LAKE, BLIND),
    ("exploration ends too early", "sarsa", LAKE8, {"exploration_fraction": 0.001, **BLIND}),
    ("no optimism", "qlearning", RIVER, {"initial_q": 0.0}),
    ("exploration never ends", "expected_sarsa", TAXI, {"exploration_final_eps": 0.9}),
    ("exploration never ends", "sarsa", CLIFF, {"exploration_initial_eps": 0.5}),
    ("discount too small", "sarsa", LAKE8, {"gamma": 0.8}),
    ("rewards clipped", "qlearning", LAKE, {"train_env_wrapper": CLIPPED}),
    ("rewards negated", "sarsa", LAKE, {"train_env_wrapper": NEGATED}),
    ("time limit hides the goal", "sarsa", WIND, {"train_env_kwargs": {"max_episode_steps": 9}}),
    ("ties go to the first action", "qlearning", MAZE, TIED),
    ("pessimistic start", "qlearning", TAXI, SHY),
    ("optimistic start", "qlearning", TAXI, HIGH),
    ("temperature too high", "sarsa", TAXI, {"exploration": "boltzmann", "temperature": 1000.0}),
    ("two causes", "sarsa", TAXI, {"learning_rate": 0.005, "gamma": 0.5}),
    ("planning switched off", "dyna_q", MAZE, {"planning_steps": 0, "n_timesteps": 1500}),
    ("a network's step size too large", "dqn", LAKE, WILD),
)


def final_return(algo: str, env_id: str, change: Mapping[str, Any], seed: int) -> float:
    """The exact return after a training with changes of the shipped settings."""
    entry = override(read_entry(algo, env_id), {"engine": "auto", **change})
    spec = read_spec(algo, env_id, entry, seed=seed, device="cpu")
    evaluator, agent = exact_evaluator(spec), make_agent(spec, None)
    assert evaluator is not None
    budget = EpisodeBudget(spec.n_episodes) if spec.n_episodes else None
    agent.learn(spec.total_timesteps, callback=budget)
    policy = evaluator.policy(agent, deterministic=True)
    return policy_return(evaluator.model, policy, evaluator.horizon).expected_return


def proposed(algo: str, env_id: str, change: Mapping[str, Any], seed: int) -> list[str]:
    """The first two proposals for a run."""
    with tempfile.TemporaryDirectory() as folder:
        settings = {"engine": "auto", "verbose": 0, "log_folder": folder, **change}
        run = ys.train(env_id, algo, seed=seed, **settings)
        return [*ys.explain(run)["proposals"][:2]]


def judged(algo: str, env_id: str, change: dict[str, Any]) -> tuple[list[str], bool, int]:
    """The cells of a row, whether a proposal mends, and how many change nothing."""

    def returns(settings: Mapping[str, Any]) -> np.ndarray[Any, np.dtype[np.float64]]:
        return np.array([final_return(algo, env_id, settings, seed) for seed in SEEDS])

    budget = {} if set(change) <= {*BUDGETS} else {k: change[k] for k in BUDGETS if k in change}
    bad, good = returns(change), returns(budget)
    cells, mends, n_same = [f"{bad.mean():.4g}", f"{good.mean():.4g}"], False, 0
    for typed in proposed(algo, env_id, change, int(bad.argmin())):
        found = returns(override(change, parse_assignments(typed.split(), "--test")))
        closed = (found.mean() - bad.mean()) / (good.mean() - bad.mean())
        mends, n_same = mends or closed >= MENDS, n_same + bool((found == bad).all())
        cells.append(f"`{typed}`: {closed:.0%}")
    return [*cells, "none", "none"][:4], mends, n_same


def main() -> None:
    """Print the table, or publish it."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--only", nargs="+", default=[""], metavar="WORD")
    parser.add_argument("--json", type=Path, default=Path("explain-causes.json"))
    args = parser.parse_args()
    rows = ["| cause | agent | bad | good | first proposal closes | second |", "|---" * 6 + "|"]
    n_mended = n_same = n_causes = 0
    for cause, algo, env_id, change in CAUSES:
        if any(word in f"{cause} {algo} {env_id}" for word in args.only):
            cells, mends, same = judged(algo, env_id, change)
            n_causes, n_mended, n_same = n_causes + 1, n_mended + mends, n_same + same
            rows.append(f"| {' | '.join([cause, f'{algo} on {env_id}', *cells])} |")
            print(rows[-1], flush=True)
    told = f"The first or the second proposal mends {n_mended} of {n_causes} causes. "
    told += f"Proposals that change nothing: {n_same}."
    publish(args.json, f"{told}\n\n" + "\n".join(rows))
    print(measured_block(str(args.json.resolve())))


if __name__ == "__main__":
    main()
