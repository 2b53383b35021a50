"""Success rates of the shipped settings of tables on maps that were not used for tuning.

    python benchmarks/tuned_settings.py
    python benchmarks/tuned_settings.py --algos dyna_q --seeds 5

The environments are those of `family`, the seeds are 1000 to 1000+n-1, and a run succeeds with an
exact score of 0.9. The settings were tuned on other maps, slips, rewards and lakes, with the seeds
0 to 9. The column "planning" is the score of the best policy under the agent's own discount: if
that is low, no table can be expected to do better.
"""

from __future__ import annotations

import argparse
import sys
import time
from dataclasses import dataclass
from functools import cache
from typing import Any

TABULAR = ("qlearning", "sarsa", "expected_sarsa", "double_qlearning")


@dataclass(frozen=True)
class Member:
    """One environment of the family."""

    env_id: str
    env_kwargs: dict[str, Any]


def _warehouse(**kwargs: Any) -> Member:
    return Member("Warehouse-v0", kwargs)


def _random_warehouse(size: int, map_seed: int, **kwargs: Any) -> Member:
    return Member("RandomWarehouse-v0", {"size": size, "map_seed": map_seed, **kwargs})


def _lake(size: int, seed: int, **kwargs: Any) -> Member:
    from gymnasium.envs.toy_text.frozen_lake import generate_random_map

    rows = generate_random_map(size=size, seed=seed)
    return Member("FrozenLake-v1", {"desc": rows, **kwargs})


def _rewards(factor: float, shelf: float) -> dict[str, float]:
    return {"shelf_reward": shelf * factor, "step_reward": -factor, "goal_reward": 100 * factor}


def family() -> dict[str, Member]:
    """The environments by their names in the table."""
    hall = ["G....#...", ".###.#.#.", ".#.....#.", ".#.###.##", "...#....S", ".#...##.."]
    spiral = ["S....", ".###.", ".#G..", ".####", "....."]
    return {
        "Warehouse, slip 0.05": _warehouse(slip=0.05),
        "slip 0.1": _warehouse(slip=0.1),
        "slip 0.15": _warehouse(slip=0.15),
        "slip 0.25": _warehouse(slip=0.25),
        "shelves -1": _warehouse(shelf_reward=-1),
        "shelves -1, slip 0.3": _warehouse(shelf_reward=-1, slip=0.3),
        "shelves -30, slip 0.2": _warehouse(shelf_reward=-30, slip=0.2),
        "rewards x 0.1, shelves -10, slip 0.2": _warehouse(slip=0.2, **_rewards(0.1, -100)),
        "own map 6 x 9": _warehouse(desc=hall),
        "own map 6 x 9, slip 0.1": _warehouse(desc=hall, slip=0.1),
        "own map 5 x 5, slip 0.2": _warehouse(desc=spiral, slip=0.2),
        "RandomWarehouse, size 5": _random_warehouse(5, 11),
        "size 7, slip 0.3": _random_warehouse(7, 12, slip=0.3),
        "size 10, slip 0.2": _random_warehouse(10, 14, slip=0.2),
        "size 12, slip 0.1": _random_warehouse(12, 13, slip=0.1),
        "size 12, slip 0.1, rewards x 10": _random_warehouse(
            12, 20, slip=0.1, **_rewards(10, -100)
        ),
        "size 18, slip 0.2": _random_warehouse(18, 15, slip=0.2),
        "size 25": _random_warehouse(25, 16),
        "size 25, slip 0.1, shelves -10": _random_warehouse(25, 17, slip=0.1, shelf_reward=-10),
        "size 30": _random_warehouse(30, 19),
        "size 30, slip 0.1": _random_warehouse(30, 18, slip=0.1),
        "lake 4 x 4, map 11": _lake(4, 11),
        "lake 4 x 4, map 12": _lake(4, 12),
        "lake 5 x 5": _lake(5, 13),
        "lake 5 x 5, rewards x 10": _lake(5, 19, reward_schedule=(10, 0, 0)),
        "lake 6 x 6": _lake(6, 14),
        "lake 6 x 6, rewards x 0.1": _lake(6, 20, reward_schedule=(0.1, 0, 0)),
        "lake 7 x 7": _lake(7, 15),
        "lake 8 x 8": _lake(8, 16),
        "lake 8 x 8, not slippery": _lake(8, 17, is_slippery=False),
        "lake 12 x 12, not slippery": _lake(12, 18, is_slippery=False),
        "slippery cliff": Member("CliffWalkingSlippery-v1", {}),
    }


FIRST_HELD_OUT = 1000
REACHED = 0.9
# Below this score of planning, the discount costs too much for a judgement of learning.
PLANNABLE = 0.95


def _spec(member: Member, algo: str, seed: int) -> Any:
    from rl_yardstick.pipeline.settings import override, read_entry, read_spec

    entry = override(read_entry(algo, member.env_id), {"env_kwargs": member.env_kwargs})
    return read_spec(algo, member.env_id, entry, seed=seed)


@cache
def _evaluator(name: str) -> Any:
    from rl_yardstick.pipeline.evaluation.exact import exact_evaluator

    return exact_evaluator(_spec(family()[name], "qlearning", 0))


def planning_score(name: str, discount: float) -> float:
    """The undiscounted score of the best policy under the discount."""
    from rl_yardstick.mdp import policy_iteration, policy_return

    judge = _evaluator(name)
    plan = policy_iteration(judge.model, discount)
    worth = policy_return(judge.model, plan.policy, judge.horizon).expected_return
    return float(judge.yardstick.score(worth))


def family_score(name: str, algo: str, seed: int) -> float:
    """Train a table in this process; return the exact score of its greedy policy."""
    from rl_yardstick.pipeline.training import make_agent

    spec = _spec(family()[name], algo, seed)
    agent: Any = make_agent(spec, None)
    agent.learn(spec.total_timesteps)
    agent.env.close()
    judge = _evaluator(name)
    return float(judge.yardstick.score(float(judge(agent).returns[0])))


def judge_family(algos: list[str], n_seeds: int) -> int:
    """Print how many seeds of each agent succeed on each member; return the exit code."""
    seeds = range(FIRST_HELD_OUT, FIRST_HELD_OUT + n_seeds)
    reached: dict[str, list[int]] = {algo: [] for algo in algos}
    plannable: list[bool] = []
    print(f"| environment | steps | gamma | planning | {' | '.join(algos)} |")
    print("|---|---|---|---|" + "---|" * len(algos))
    before = time.process_time()
    for name, member in family().items():
        spec = _spec(member, algos[0], 0)
        cells = [f"{spec.hyperparams.n_timesteps:,}"]
        gamma = spec.hyperparams.algorithm["gamma"]
        planned = planning_score(name, gamma)
        plannable.append(planned >= PLANNABLE)
        cells += [f"{gamma:.4f}", f"{planned:.2f}"]
        for algo in algos:
            scores = [family_score(name, algo, seed) for seed in seeds]
            n_reached = sum(score >= REACHED for score in scores)
            reached[algo].append(n_reached)
            low = "" if n_reached == n_seeds else f" (lowest {min(scores):.2f})"
            cells.append(f"{n_reached} of {n_seeds}{low}")
        print(f"| {name} | {' | '.join(cells)} |", flush=True)
    chosen = {"all": [True] * len(plannable), f"planning from {PLANNABLE}": plannable}
    for label, rows in chosen.items():
        of = sum(rows) * n_seeds
        counts = [sum(n for n, row in zip(reached[a], rows, strict=True) if row) for a in algos]
        totals = [f"{count} of {of} ({count / of:.1%})" for count in counts]
        print(f"| {label} | | | | {' | '.join(totals)} |")
    n_runs = len(plannable) * n_seeds
    taken = (time.process_time() - before) / (n_runs * len(algos))
    print(f"\n{taken:.2f} s of processor time a run")
    return int(any(count < 0.95 * of for count in counts))


def main() -> int:
    """Judge the named agents; return the exit code."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawTextHelpFormatter
    )
    parser.add_argument("--seeds", type=int, default=10, metavar="N", help="from 1000 on (10)")
    parser.add_argument("--algos", nargs="+", default=list(TABULAR), metavar="NAME")
    args = parser.parse_args()
    return judge_family(args.algos, args.seeds)


if __name__ == "__main__":
    sys.exit(main())
