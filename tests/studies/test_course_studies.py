"""The study files: each can be run, and those on tables show what they should, on fewer seeds.

Figures of the course material were measured with programs written after the course's own code, over
the number of seeds named beside them. A mean over our seeds must lie within four standard errors of
theirs, both samples counted, unless said otherwise. Five rows of the warehouse are compared in
``tests/agents/test_known_results.py`` already.
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
STUDIES = [
    path for path in sorted((ROOT / "studies").glob("*.yml")) if not path.name.startswith("bandit-")
]
GUIDE = (ROOT / "docs" / "course.md").read_text()


def study(name):
    return read_study(ROOT / "studies" / f"{name}.yml")


def shrunk(whole, agents=None, environments=None, **changes):
    """A part of a study, by the beginnings of labels."""

    def chosen(entries, beginnings):
        return tuple(e for e in entries if beginnings is None or e.label.startswith(beginnings))

    return replace(
        whole,
        agents=chosen(whole.agents, agents),
        environments=chosen(whole.environments, environments),
        **changes,
    )


def training_returns(results, agent):
    """Returns of the training episodes, shape (n_seeds, n_episodes)."""
    runs = [one.path for one in results.planned if one.agent == agent]
    assert len(runs) == results.study.n_seeds
    return np.array([read_episodes(one).returns for one in runs])


def assert_mean(values, expected, spread, n_expected):
    """Four standard errors; ``spread`` is the standard deviation over seeds."""
    error = spread * math.sqrt(1 / n_expected + 1 / len(values))
    assert np.mean(values) == pytest.approx(expected, abs=4 * error)


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
            algorithm = load_algorithm(one.spec.algo)
            assert (
                constructor_arguments(one.spec, algorithm, False).keys()
                >= one.spec.algorithm.keys()
            )
    short = plan(whole.quickened(), tmp_path)
    assert len(short) < len(planned)


def test_the_guide_gives_the_command_of_each_study():
    named = set(re.findall(r"python compare.py studies/([\w-]+\.yml)\n", GUIDE))
    assert named == {path.name for path in STUDIES}
    assert set(re.findall(r"studies/([\w-]+\.yml)", GUIDE)) == named


# Mean and standard deviation over 100 seeds of the mean return of 500 episodes, by the last one.
SLIDES = {
    "Q-learning": {500: (20.9, 3.0), 1500: (39.5, 19), 2500: (117, 47), 4500: (300, 86)},
    "SARSA": {500: (20.5, 2.6), 1500: (27.5, 11), 2500: (64, 34), 4500: (222, 67)},
}


@pytest.mark.parametrize("name", SLIDES)
def test_the_table_of_the_slides(do_study, tmp_path, name):
    agent = f"{name} as printed"
    part = shrunk(study("cartpole-qlearning-vs-sarsa"), (agent,), n_seeds=4, eval_freq=-1)
    returns = training_returns(do_study(part, tmp_path), agent)
    assert returns.shape == (4, 5000)
    for end, (expected, spread) in SLIDES[name].items():
        assert_mean(returns[:, end - 500 : end].mean(axis=1), expected, spread, 100)


def test_the_warehouse_with_the_rewards_of_the_text(do_study, tmp_path):
    part = shrunk(study("warehouse-qlearning"), "as printed", "shelf -100", n_seeds=10)
    results = do_study(part, tmp_path)
    returns = training_returns(results, "as printed")
    # Over 30 seeds; the figures after +- are standard deviations of a seed's mean.
    for part_of, expected, spread in (
        (returns[:, :1], -7885, 1408),
        (returns[:, :100], -431, 22),
        (returns[:, 200:300], -9, 9),
        (returns[:, -100:], -7, 11),
    ):
        assert_mean(part_of.mean(axis=1), expected, spread, 30)
    assert set(results.summary["final"]) == {79.0}


def test_the_8x8_lake_with_decaying_noise(do_study, tmp_path):
    part = shrunk(study("frozenlake8x8-qlearning"), "as printed", "at most 99", n_seeds=20)
    results = do_study(part, tmp_path)
    returns = training_returns(results, "as printed")
    assert_mean(returns.mean(axis=1), 0.106, 0.070, 200)
    assert_mean(returns[:, -1000:].mean(axis=1), 0.203, 0.120, 200)
    assert results.summary["optimum"].iloc[0] == pytest.approx(0.6353, abs=5e-5)
    assert (results.summary["final"] < 0.6353).all()


def test_values_of_the_small_grid(do_study, tmp_path):
    part = shrunk(study("small-grid"), ("qlearning", "sarsa"), n_seeds=3)
    results = do_study(part, tmp_path)
    corner = {agent.label: [] for agent in part.agents}
    for one in results.planned:
        model = load_algorithm(one.agent).load(one.run.model_path(one.spec))
        corner[one.agent].append(model.policy.q_table[0].max())
    assert corner["qlearning"] == pytest.approx([0.95**5] * 3, abs=1e-9)
    assert np.mean(corner["sarsa"]) < 0.95**5 - 0.02
    assert set(results.summary["optimum"]) == {1.0}
