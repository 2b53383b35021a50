"""Planning on random warehouses with slip 0.1, and exact evaluation; processor seconds."""

from __future__ import annotations

from functools import partial
from itertools import cycle
from pathlib import Path
from typing import Any

from rl_yardstick.agents import load_algorithm
from rl_yardstick.envs.warehouse import RandomWarehouseEnv
from rl_yardstick.mdp import policy_iteration, value_iteration
from rl_yardstick.pipeline.environments import make_envs, make_training_env
from rl_yardstick.pipeline.evaluation.exact import exact_evaluator
from rl_yardstick.pipeline.evaluation.sampled import evaluate
from rl_yardstick.pipeline.spec import TrainSpec
from timing import Benchmark, Contender, Rows, seconds

DISCOUNTS = (0.9, 0.99, 0.999, 1.0)
STEPS = 200_000
EPISODES = 100


def evaluations(env_id: str, *, greedily: bool) -> dict[str, Contender]:
    """Evaluations of Q-learning after 200,000 steps: by episodes, and exactly.

    Two agents take turns, because the evaluator caches the value of the last policy.
    """
    spec = TrainSpec(algo="qlearning", env_id=env_id, n_timesteps=STEPS, seed=0, noise_std=None)
    evaluator = exact_evaluator(spec)
    assert evaluator is not None
    algorithm: Any = load_algorithm("qlearning")
    agents = [
        algorithm(env=make_training_env(spec, None), seed=seed, exploration_final_eps=0.1)
        for seed in range(2)
    ]
    for agent in agents:
        agent.learn(STEPS)
    env = make_envs(spec, 1)
    turns = cycle(agents)
    return {
        f"{EPISODES} episodes": seconds(
            lambda: evaluate(next(turns), env, EPISODES, 0, greedily), 2
        ),
        "exact": seconds(lambda: evaluator(next(turns), greedily), 50),
    }


def rows(folder: Path) -> Rows:
    """Policy iteration solves each linear system directly; value iteration sweeps."""
    model = RandomWarehouseEnv(size=300, slip=0.1).transition_model()
    made: Rows = {}
    for discount in DISCOUNTS:
        made[f"300 x 300, discount {discount:g}"] = {
            "policy iteration": seconds(partial(policy_iteration, model, discount)),
            "value iteration": seconds(partial(value_iteration, model, discount)),
        }
    del made["300 x 300, discount 1"]["policy iteration"]
    for env_id in ("Warehouse-v0", "FrozenLake-v1"):
        for name, greedily in (("greedy", True), ("epsilon 0.1", False)):
            made[f"evaluating, {env_id}, {name}"] = evaluations(env_id, greedily=greedily)
    return made


BENCHMARK = Benchmark("seconds", rounds=3, rows=rows, is_speed=False, warms_up=True)
