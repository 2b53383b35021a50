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
from typing import Any

TABULAR = ("qlearning", "sarsa", "expected_sarsa", "double_qlearning")


def family() -> dict[str, tuple[str, dict[str, Any]]]:
    """The environments and their arguments, by their names in the table."""
    from gymnasium.envs.toy_text.frozen_lake import generate_random_map

    hall = ["G....#...", ".###.#.#.", ".#.....#.", ".#.###.##", "...#....S", ".#...##.."]
    spiral = ["S....", ".###.", ".#G..", ".####", "....."]
    tenth = {"shelf_reward": -10.0, "step_reward": -0.1, "goal_reward": 10.0}
    tenfold = {"shelf_reward": -1000, "step_reward": -10, "goal_reward": 1000}
    warehouses: dict[str, dict[str, Any]] = {
        "Warehouse, slip 0.05": {"slip": 0.05},
        "slip 0.1": {"slip": 0.1},
        "slip 0.15": {"slip": 0.15},
        "slip 0.25": {"slip": 0.25},
        "shelves -1": {"shelf_reward": -1},
        "shelves -1, slip 0.3": {"shelf_reward": -1, "slip": 0.3},
        "shelves -30, slip 0.2": {"shelf_reward": -30, "slip": 0.2},
        "rewards x 0.1, shelves -10, slip 0.2": {"slip": 0.2, **tenth},
        "own map 6 x 9": {"desc": hall},
        "own map 6 x 9, slip 0.1": {"desc": hall, "slip": 0.1},
        "own map 5 x 5, slip 0.2": {"desc": spiral, "slip": 0.2},
    }
    random: dict[str, tuple[int, int, dict[str, Any]]] = {  # size, seed of the map
        "RandomWarehouse, size 5": (5, 11, {}),
        "size 7, slip 0.3": (7, 12, {"slip": 0.3}),
        "size 10, slip 0.2": (10, 14, {"slip": 0.2}),
        "size 12, slip 0.1": (12, 13, {"slip": 0.1}),
        "size 12, slip 0.1, rewards x 10": (12, 20, {"slip": 0.1, **tenfold}),
        "size 18, slip 0.2": (18, 15, {"slip": 0.2}),
        "size 25": (25, 16, {}),
        "size 25, slip 0.1, shelves -10": (25, 17, {"slip": 0.1, "shelf_reward": -10}),
        "size 30": (30, 19, {}),
        "size 30, slip 0.1": (30, 18, {"slip": 0.1}),
    }
    lakes: dict[str, tuple[int, int, dict[str, Any]]] = {
        "lake 4 x 4, map 11": (4, 11, {}),
        "lake 4 x 4, map 12": (4, 12, {}),
        "lake 5 x 5": (5, 13, {}),
        "lake 5 x 5, rewards x 10": (5, 19, {"reward_schedule": (10, 0, 0)}),
        "lake 6 x 6": (6, 14, {}),
        "lake 6 x 6, rewards x 0.1": (6, 20, {"reward_schedule": (0.1, 0, 0)}),
        "lake 7 x 7": (7, 15, {}),
        "lake 8 x 8": (8, 16, {}),
        "lake 8 x 8, not slippery": (8, 17, {"is_slippery": False}),
        "lake 12 x 12, not slippery": (12, 18, {"is_slippery": False}),
    }
    found = {name: ("Warehouse-v0", kwargs) for name, kwargs in warehouses.items()}
    for name, (size, seed, more) in random.items():
        found[name] = "RandomWarehouse-v0", {"size": size, "map_seed": seed, **more}
    for name, (size, seed, more) in lakes.items():
        rows = generate_random_map(size=size, seed=seed)
        found[name] = "FrozenLake-v1", {"desc": rows, **more}
    return {**found, "slippery cliff": ("CliffWalkingSlippery-v1", {})}


FIRST_HELD_OUT = 1000
REACHED = 0.9
# Below this score of planning, the discount costs too much for a judgement of learning.
PLANNABLE = 0.95


def _spec(env_id: str, env_kwargs: dict[str, Any], algo: str, seed: int) -> Any:
    from rl_yardstick.pipeline.settings import override, read_entry, read_spec

    entry = override(read_entry(algo, env_id), {"env_kwargs": env_kwargs})
    return read_spec(algo, env_id, entry, seed=seed)


def judge_family(algos: list[str], n_seeds: int) -> int:
    """Print how many seeds of each agent succeed on each member; return the exit code."""
    from rl_yardstick.mdp import policy_iteration, policy_return
    from rl_yardstick.pipeline.evaluation.exact import exact_evaluator
    from rl_yardstick.pipeline.training import make_agent

    seeds = range(FIRST_HELD_OUT, FIRST_HELD_OUT + n_seeds)
    reached: dict[str, list[int]] = {algo: [] for algo in algos}
    plannable: list[bool] = []
    print(f"| environment | steps | gamma | planning | {' | '.join(algos)} |")
    print("|---|---|---|---|" + "---|" * len(algos))
    before = time.process_time()
    for name, member in family().items():
        spec = _spec(*member, algos[0], 0)
        judge = exact_evaluator(_spec(*member, "qlearning", 0))
        assert judge is not None
        gamma = spec.hyperparams["gamma"]
        plan = policy_iteration(judge.model, gamma)
        worth = policy_return(judge.model, plan.policy, judge.horizon).expected_return
        planned = float(judge.yardstick.score(worth))
        plannable.append(planned >= PLANNABLE)
        cells = [f"{spec.hyperparams['n_timesteps']:,}", f"{gamma:.4f}", f"{planned:.2f}"]
        for algo in algos:
            scores = []
            for seed in seeds:
                spec = _spec(*member, algo, seed)
                agent: Any = make_agent(spec, None)
                agent.learn(spec.total_timesteps)
                agent.env.close()
                scores.append(float(judge.yardstick.score(float(judge(agent).returns[0]))))
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
