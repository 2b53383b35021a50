"""The study files: each can be run, and those on tables show what they should, on fewer seeds.

Figures of the course material were measured with programs written after the course's own code, over
the number of seeds named beside them. A mean over our seeds must lie within four standard errors of
theirs, both samples counted, unless said otherwise.
"""

import math
import re
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from rl_yardstick.agents import load_algorithm
from rl_yardstick.experiments.plan import plan
from rl_yardstick.experiments.results import read_episodes
from rl_yardstick.experiments.study import read_study
from rl_yardstick.pipeline.components import constructor_arguments

ROOT = Path(__file__).parents[2]
# Bandits have a guide of their own.
FILES = sorted((ROOT / "studies").glob("*.yml"))
STUDIES = [path for path in FILES if not path.name.startswith("bandit-")]
GUIDE = "".join((ROOT / "docs" / name).read_text() for name in ("courses.md", "tutorials.md"))


def shrunk(name, agents, environments="", **changes):
    """A part of a study, by the beginnings of labels."""
    whole = read_study(ROOT / "studies" / f"{name}.yml")
    kept = {
        kind: tuple(each for each in getattr(whole, kind) if each.label.startswith(labels))
        for kind, labels in (("agents", agents), ("environments", environments))
    }
    return replace(whole, **kept, **changes)


@pytest.mark.parametrize("path", STUDIES, ids=lambda path: path.stem)
def test_a_study_reads_plans_and_fits(path, tmp_path):
    whole = read_study(path)
    assert whole.title != path.stem
    assert len(whole.description) > 100
    assert whole.n_seeds >= 5
    planned = plan(whole, tmp_path)
    assert len(planned) == len(whole.agents) * len(whole.environments) * whole.n_seeds
    assert len({one.path for one in planned}) == len(planned)
    for one in planned:
        if one.seed == 0:
            arguments = constructor_arguments(one.spec, load_algorithm(one.spec.algo), False)
            assert arguments.keys() >= one.spec.algorithm.keys()
    assert len(plan(whole.quickened(), tmp_path)) < len(planned)


def test_the_guide_gives_the_command_of_each_study():
    named = set(re.findall(r"python compare.py studies/([\w-]+\.yml)\n", GUIDE))
    assert named == {path.name for path in STUDIES}
    assert set(re.findall(r"studies/([\w-]+\.yml)", GUIDE)) == named


# A study, agent and environment, seeds here and there; the optimum, and whether it is reached; the
# mean return of episodes from one to another, and its standard deviation over seeds.
SLIDES, LAKE = "cartpole-qlearning-vs-sarsa", "frozenlake8x8-qlearning"
RETURNS = [
    (SLIDES, "Q-learning as printed", "", 4, 100, None, None,
     [(0, 500, 20.9, 3.0), (1000, 1500, 39.5, 19), (2000, 2500, 117, 47), (4000, 4500, 300, 86)]),
    (SLIDES, "SARSA as printed", "", 4, 100, None, None,
     [(0, 500, 20.5, 2.6), (1000, 1500, 27.5, 11), (2000, 2500, 64, 34), (4000, 4500, 222, 67)]),
    ("warehouse-qlearning", "as printed", "shelf -100", 10, 30, 79.0, True,
     [(0, 1, -7885, 1408), (0, 100, -431, 22), (200, 300, -9, 9), (-100, None, -7, 11)]),
    (LAKE, "as printed", "at most 99", 20, 200, 0.6353, False,
     [(0, None, 0.106, 0.070), (-1000, None, 0.203, 0.120)]),
]  # fmt: skip


@pytest.mark.parametrize("case", RETURNS, ids=lambda case: " ".join(case[:2]))
def test_training_returns_what_the_course_says(do_study, tmp_path, case):
    name, agent, world, n_seeds, n_expected, optimum, is_reached, parts = case
    evaluated = {} if optimum else {"eval_freq": -1}
    results = do_study(shrunk(name, agent, world, n_seeds=n_seeds, **evaluated), tmp_path)
    returns = np.array([read_episodes(one.path).returns for one in results.planned])
    assert len(returns) == n_seeds
    for first, last, expected, spread in parts:
        error = spread * math.sqrt(1 / n_expected + 1 / n_seeds)
        found = returns[:, first:last].mean(axis=1)
        assert np.mean(found) == pytest.approx(expected, abs=4 * error)
    if optimum:
        assert results.summary["optimum"].to_numpy() == pytest.approx(optimum, abs=5e-5)
        assert (results.summary["final"] == results.summary["optimum"]).all() == is_reached
        assert is_reached or (results.summary["final"] < optimum).all()


def test_values_of_the_small_grid(do_study, tmp_path):
    part = shrunk("small-grid", ("qlearning", "sarsa"), n_seeds=3)
    results = do_study(part, tmp_path)
    corner = {agent.label: [] for agent in part.agents}
    for one in results.planned:
        model = load_algorithm(one.agent).load(one.run.model_path(one.spec))
        corner[one.agent].append(model.policy.q_table[0].max())
    assert corner["qlearning"] == pytest.approx([0.95**5] * 3, abs=1e-9)
    assert np.mean(corner["sarsa"]) < 0.95**5 - 0.02
    assert set(results.summary["optimum"]) == {1.0}
