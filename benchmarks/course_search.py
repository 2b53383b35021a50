"""A course's search for learning rate, discount and epsilon, and how often it is fooled.

    python benchmarks/course_search.py      # ten searches of each kind: three minutes
    python benchmarks/course_search.py 5    # fewer

Q-learning on the warehouse is searched for by a grid and by a TPE study of as many trials, each
judging a setting by one seed or by five, from the file that ``tune.py`` takes:
``studies/search/warehouse.yml``. What each finds is run again on the seeds 1000 to 1019, as are the
shipped settings. The discount changes what the agent learns; scores are of the undiscounted return
of the greedy policy, computed exactly: 1 is the optimum, 0 the best random or constant policy.
"""

from __future__ import annotations

import os
import sys
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass, field
from functools import cache
from itertools import product
from pathlib import Path
from typing import Any

os.environ.setdefault("OMP_NUM_THREADS", "1")

import numpy as np

from agents import load_algorithm
from pipeline.agent_settings import resolved_spec
from pipeline.environments import make_training_env
from pipeline.evaluation.exact import ExactEvaluator, exact_evaluator
from pipeline.preparation import algorithm_kwargs
from pipeline.settings.hyperparams import override, read_hyperparams, split
from pipeline.train_spec import TrainSpec
from tuning.search_spaces import read_search_space

ROOT = Path(__file__).resolve().parent.parent
ENV, ALGO = "Warehouse-v0", "qlearning"
SPACE = read_search_space(ALGO, ENV, ROOT / "studies" / "search" / "warehouse.yml")
POINTS = 3  # of each of three settings
N_SEARCHES = 10
HELD_OUT = range(1000, 1020)
# Below the last digit that is shown.
NOTHING = 0.0005

Judge = Callable[[Mapping[str, Any]], float]


@dataclass(frozen=True)
class World:
    """Where Q-learning is searched for.

    Attributes:
        name: what the table calls it.
        n_timesteps: of each run.
        env_kwargs: of the environment.
    """

    name: str
    n_timesteps: int
    env_kwargs: dict[str, Any] = field(default_factory=dict)

    def entry(self, settings: Mapping[str, Any]) -> dict[str, Any]:
        """The hyperparameters of a run."""
        fixed = {"policy": "QTablePolicy", "exploration_decay": "constant"}
        return {**fixed, **settings, **self._run}

    def shipped(self) -> dict[str, Any]:
        """Those that are shipped."""
        return override(read_hyperparams(ALGO, ENV), self._run)

    @property
    def _run(self) -> dict[str, Any]:
        return {"n_timesteps": self.n_timesteps, "env_kwargs": self.env_kwargs}


WORLDS = (
    World("as it is, 100,000 steps", 100_000),
    World("as it is, 10,000 steps", 10_000),
    World("slip 0.1, 100,000 steps", 100_000, {"slip": 0.1}),
)


class Scores:
    """Scores of runs, each of which is done once."""

    def __init__(self) -> None:
        self._known: dict[tuple[str, int], float] = {}

    def mean(self, entry: Mapping[str, Any], seeds: Iterable[int]) -> float:
        """The mean score over seeds."""
        return float(np.mean([self._of(entry, seed) for seed in seeds]))

    def _of(self, entry: Mapping[str, Any], seed: int) -> float:
        key = (repr(sorted(entry.items())), seed)
        if key not in self._known:
            self._known[key] = score(entry, seed)
        return self._known[key]


def score(entry: Mapping[str, Any], seed: int) -> float:
    """Train with one seed; the score of the final policy."""
    spec = resolved_spec(entry, algo=ALGO, env_id=ENV, seed=seed)
    raw = spec.saved_hyperparams
    algorithm: Any = load_algorithm(ALGO)
    env = make_training_env(spec, None)
    agent = algorithm(env=env, device="cpu", seed=seed, **algorithm_kwargs(spec))
    agent.learn(raw["n_timesteps"])
    env.close()
    evaluator = _evaluator(float(raw["env_kwargs"].get("slip", 0.0)))
    yardstick = evaluator.yardstick
    gained = float(evaluator(agent).returns[0]) - yardstick.baseline
    return gained / (yardstick.optimum - yardstick.baseline)


@cache
def _evaluator(slip: float) -> ExactEvaluator:
    raw = {"policy": "QTablePolicy", "n_timesteps": 1, "env_kwargs": {"slip": slip}}
    found = exact_evaluator(TrainSpec(ALGO, ENV, split(raw), raw, seed=0))
    assert found is not None
    return found


def by_grid(judge: Judge, seed: int) -> tuple[dict[str, Any], float]:
    """The best point of the grid, in an order of chance since many are equal; and its score."""
    grid = SPACE.grid(POINTS)
    points = [dict(zip(grid, values, strict=True)) for values in product(*grid.values())]
    order = np.random.default_rng(seed).permutation(len(points))
    settings = [SPACE.at(points[place]) for place in order]
    found = [judge(each) for each in settings]
    best = int(np.argmax(found))
    return settings[best], found[best]


def by_tpe(judge: Judge, seed: int) -> tuple[dict[str, Any], float]:
    """The best of as many trials of a TPE study, the first where several are equal."""
    import optuna

    optuna.logging.set_verbosity(optuna.logging.WARNING)
    sampler = optuna.samplers.TPESampler(seed=seed, n_startup_trials=10)
    study = optuna.create_study(direction="maximize", sampler=sampler)
    study.optimize(lambda trial: judge(SPACE.suggest(trial)), n_trials=POINTS**3)
    return SPACE.at(study.best_params), study.best_value


def compare(world: World, n_searches: int) -> None:
    """Print a row for each kind of search."""
    scores = Scores()
    shipped = scores.mean(world.shipped(), HELD_OUT)
    for name, search in (("grid", by_grid), ("TPE", by_tpe)):
        for n_seeds in (1, 5):
            found, there = [], []
            for number in range(n_searches):
                seeds = range(number * n_seeds, (number + 1) * n_seeds)
                settings, in_sample = search(
                    lambda chosen, seeds=seeds: scores.mean(world.entry(chosen), seeds),  # type: ignore[misc]
                    number,
                )
                found.append(in_sample)
                there.append(scores.mean(world.entry(settings), HELD_OUT))
            optimism = np.mean(found) - np.mean(there)
            fooled = sum(each < shipped - NOTHING for each in there)
            print(
                f"| {world.name} | {name} | {n_seeds} | {np.mean(found):.3f} "
                f"| {np.mean(there):.3f} | {min(there):.3f} | {shipped:.3f} | {optimism:+.3f} "
                f"| {fooled} of {n_searches} |",
                flush=True,
            )


def main() -> None:
    """Print the table."""
    n_searches = int(sys.argv[1]) if sys.argv[1:] else N_SEARCHES
    print("| warehouse | search | seeds | found | on others | worst | shipped | optimism | worse |")
    print("|---|---|---|---|---|---|---|---|---|")
    for world in WORLDS:
        compare(world, n_searches)


if __name__ == "__main__":
    main()
