"""Makes verdict_bank.npz: final scores of many runs, from which `verdict_errors.py` draws studies.

    nice python benchmarks/verdict_bank.py

An entry is an environment, an agent and a budget of steps. Its runs are those of `python train.py
--env ENVIRONMENT --algo AGENT -n STEPS --seed S`, with the settings in hyperparams/ but without
evaluations during training, for S from 0 to 1499; on CartPole, which takes longer, 0 to 249, and
for networks (`--engine compiled`) 0 to 99. The budgets were chosen by forty runs each, to have
entries of all kinds: agents that always fail, sometimes fail, and never fail. No run is left out.

The score is that of `compare.py`: 1 is the optimum, 0 the best random or constant policy. It is
exact, but for CartPole, where 100 episodes are sampled. An array of the file has the scores of
an entry in the order of seeds, as float32 rounded to five decimals; lower scores than -1 count as
-1.
"""

from __future__ import annotations

import argparse
import os
from concurrent.futures import ProcessPoolExecutor
from pathlib import Path

os.environ.update(OMP_NUM_THREADS="1", NUMBA_NUM_THREADS="1")

import numpy as np
from numpy.typing import NDArray

from rl_yardstick.agents import ALGORITHMS
from rl_yardstick.commands.train import build_parser, spec_from_flags
from rl_yardstick.pipeline.environments import make_envs
from rl_yardstick.pipeline.evaluation.exact import exact_evaluator
from rl_yardstick.pipeline.evaluation.sampled import SampledEvaluator
from rl_yardstick.pipeline.training import make_agent

BANK = Path(__file__).with_name("verdict_bank.npz")
N_RUNS, N_NETWORKS = 1500, 100
FEWER = {"CartPole-v1": 250}
LOWEST, DECIMALS = -1.0, 5

# Agents by environment, with budgets in thousands of steps.
ENTRIES = {
    "Warehouse-v0": (
        "qlearning 8 10 30; sarsa 10 13; double_qlearning 30; n_step_sarsa 13; dyna_q 2 3"
    ),
    "MineMaze-v0": (
        "qlearning 2 3; sarsa 10 20; expected_sarsa 3; double_qlearning 10 30; n_step_sarsa 30"
    ),
    "FrozenLake-v1": (
        "qlearning 5 20 60; sarsa 5 20; expected_sarsa 20; double_qlearning 5 20; "
        "n_step_sarsa 20; monte_carlo 20; dyna_q 5 20; dqn 10"
    ),
    "FrozenLake8x8-v1": "qlearning 100; sarsa 100; expected_sarsa 100; double_qlearning 100",
    "CliffWalking-v1": (
        "qlearning 13 15; sarsa 13; expected_sarsa 13; double_qlearning 15; n_step_sarsa 10; "
        "dyna_q 3"
    ),
    "Taxi-v4": "qlearning 60; sarsa 60 120; n_step_sarsa 40 60",
    "DynaMaze-v0": "qlearning 5; sarsa 5; n_step_sarsa 2 5; dyna_q 1",
    "WindyGridworld-v0": "sarsa 20; n_step_sarsa 5 10",
    "CartPole-v1": "qlearning 100; sarsa 100; n_step_sarsa 100; ppo 10",
}


def scores_of(env_id: str, algo: str, n_steps: int, most: int) -> NDArray[np.float32]:
    """The scores of an entry, in the order of seeds."""
    typed = f"--env {env_id} --algo {algo} -n {n_steps} --seed 0 --eval-episodes 100".split()
    if ALGORITHMS[algo].family == "library":
        typed += ["--engine", "compiled", "--device", "cpu"]
    first = spec_from_flags(build_parser().parse_args(typed))
    n_runs = N_NETWORKS if ALGORITHMS[algo].family == "library" else FEWER.get(env_id, N_RUNS)
    eval_env, exact = make_envs(first, first.n_eval_envs), exact_evaluator(first)
    scores: list[float] = []
    for seed in range(min(n_runs, most)):
        spec = first.changed(seed=seed)
        model = make_agent(spec, None)
        model.learn(n_steps, log_interval=None)  # type: ignore[arg-type]
        found = exact(model) if exact else SampledEvaluator(spec, eval_env).at_the_end(model)
        assert found.yardstick is not None
        scores.append(max(found.yardstick.score(found.mean_return), LOWEST))
    return np.round(scores, DECIMALS).astype(np.float32)


def main() -> None:
    """Make the file, and print a line for each entry."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").partition("\n")[0])
    parser.add_argument("--most", type=int, default=N_RUNS, help="runs of each entry, at most")
    parser.add_argument("--processes", type=int, default=2)
    parser.add_argument("-o", "--output", type=Path, default=BANK)
    args = parser.parse_args()
    entries = [
        (env_id, algo, 1000 * int(budget))
        for env_id, agents in ENTRIES.items()
        for algo, *budgets in map(str.split, agents.split("; "))
        for budget in budgets
    ]
    made = {}
    with ProcessPoolExecutor(args.processes) as pool:
        futures = [pool.submit(scores_of, *entry, args.most) for entry in entries]
        for entry, future in zip(entries, futures, strict=True):
            scores = made["|".join(map(str, entry))] = future.result()
            lowest, median, highest = np.quantile(scores, (0, 0.5, 1))
            print(
                f"{'|'.join(map(str, entry)):44}{len(scores):5} runs, mean {scores.mean():7.4f}, "
                f"deviation {scores.std():.4f}, {lowest:.3f} to {highest:.3f}, median {median:.3f}",
                flush=True,
            )
    np.savez_compressed(args.output, allow_pickle=False, **made)


if __name__ == "__main__":
    main()
