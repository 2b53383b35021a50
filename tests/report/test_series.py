"""The numbers that figures on paper and on the page share, worked out by hand."""

import math
from dataclasses import replace

import numpy as np
import pandas as pd
import pytest
from scipy import integrate

from rl_yardstick.experiments.analysis import analyse
from rl_yardstick.experiments.bandits import pull_statistics
from rl_yardstick.experiments.study import AgentSpec, EnvironmentSpec, StudySpec
from rl_yardstick.report.series import (
    auer_bound,
    best_of_normals,
    grids,
    lai_robbins_slope,
    learning_curves,
    mean_regret,
    regret_of_runs,
    study_series,
    sweeps,
)
from rl_yardstick.report.words import with_best_mean
from tests.report import made_up


def curve_rows(agent, kind, seed, values):
    steps = pd.DataFrame({"step": [10, 20], "episode": [1, 2], "seconds": [0.1, 0.2]})
    return steps.assign(agent=agent, environment="lake", kind=kind, seed=seed, value=values)


@pytest.fixture
def lake():
    """Two agents on a lake; by rank the second of the study comes first."""
    environment = made_up.environment((made_up.agent("b", 90.0), made_up.agent("a", 40.0)))
    analysis = made_up.analysis([environment], ["a", "b"], n_seeds=3)
    rows = [
        curve_rows("a", "evaluation", 0, [1, 5]),
        curve_rows("a", "evaluation", 1, [3, 7]),
        curve_rows("b", "evaluation", 0, [2, 8]),
        curve_rows("b", "training", 0, [-10_000, 9]),
    ]
    summary = pd.DataFrame(
        [("a", 0, 4.0), ("a", 2, 6.0), ("b", 0, 8.0), ("b", 1, np.nan)],
        columns=["agent", "seed", "final"],
    ).assign(environment="lake")
    return replace(analysis.results, curves=pd.concat(rows), summary=summary), environment


def test_mean_curves_the_best_agent_first(lake):
    curves = learning_curves(*lake)
    assert list(curves) == ["evaluation", "training"]
    shown = {
        by: {name: (curve.x.tolist(), curve.y.tolist()) for name, curve in of_agents.items()}
        for by, of_agents in curves["evaluation"].by_axis.items()
    }
    assert list(shown["step"]) == ["b", "a"]
    assert shown == {
        "step": {"b": ([10, 20], [2, 8]), "a": ([10, 20], [2, 6])},
        "episode": {"b": ([1, 2], [2, 8]), "a": ([1, 2], [2, 6])},
        "seconds": {"b": ([0.1, 0.2], [2, 8]), "a": ([0.1, 0.2], [2, 6])},
    }
    of_two = curves["evaluation"].by_axis["step"]["a"]
    assert (of_two.low < of_two.y).all()
    assert (of_two.high > of_two.y).all()
    assert list(curves["training"].by_axis["step"]) == ["b"]
    # Each kind has a scale of its own; that of the other is the optimum.
    assert (curves["evaluation"].linear_up_to, curves["training"].linear_up_to) == (None, 100)
    variant = replace(lake[1], agents=(made_up.agent("b", 90.0, changes=("random starts",)),))
    found = learning_curves(lake[0], variant)
    assert (found["evaluation"].on_variant, found["training"].on_variant) == ((), ("b",))


def swept(label, value, group="sarsa", name="alpha"):
    return AgentSpec(label, "sarsa", tuned=False, group=group, swept={name: value})


def test_a_sweep_goes_in_the_order_of_its_values():
    values = {"a": 0.9, "b": 0.1, "c": 0.5}
    agents = [made_up.agent(label, 10 * value) for label, value in values.items()]
    specs = [swept(*item, name="learning_rate") for item in values.items()]
    found = sweeps(specs, made_up.environment(agents))
    assert (found["sarsa"].parameter, found["sarsa"].labels) == ("α", ("b", "c", "a"))
    curve = found["sarsa"].means
    assert curve.x.tolist() == [0.1, 0.5, 0.9]
    assert curve.y.tolist() == [1, 5, 9]
    assert curve.low == pytest.approx([0.9, 4.9, 8.9])
    assert curve.high == pytest.approx([1.2, 5.2, 9.2])


def test_two_parameters_make_a_grid():
    """One agent has no run, and two are the best."""
    means = {(0.1, "a"): 10.0, (0.1, "b"): 30.0, (0.5, "a"): 30.0}
    specs = [
        AgentSpec(f"{rate} {kind}", "sarsa", group="sarsa", swept={"gamma": rate, "kind": kind})
        for rate in (0.1, 0.5)
        for kind in "ab"
    ]
    agents = [made_up.agent(f"{rate} {kind}", mean) for (rate, kind), mean in means.items()]
    environment = made_up.environment(sorted(agents, key=lambda a: -a.metric.mean.point))
    assert sweeps(specs, environment) == {}
    (grid,) = grids(specs, environment).values()
    assert (grid.parameters, grid.down, grid.across) == (("γ", "kind"), ["0.1", "0.5"], ["a", "b"])
    np.testing.assert_equal(grid.means, [[10, 30], [30, np.nan]])
    assert grid.labels == [["0.1 a", "0.1 b"], ["0.5 a", ""]]
    np.testing.assert_equal(grid.shares(is_cost=False), [[0, 1], [1, np.nan]])
    np.testing.assert_equal(grid.shares(is_cost=True), [[1, 0], [0, np.nan]])
    assert with_best_mean(environment, [spec.label for spec in specs]) == ["0.1 b", "0.5 a"]
    assert grids(specs[:2], environment) == {}  # a single row is none


# Arm 0 costs .3 a pull and arm 1 nothing; two runs of four pulls.
ARMS = np.array([[0, 1, 1, 0], [1, 1, 0, 1]], dtype=np.int16)
REGRETS = np.where(ARMS == 0, 0.3, 0.0)


def pulls_of(**known):
    return pull_statistics(ARMS, np.ones((2, 4), dtype=np.float32), REGRETS, None, 2, **known)


def test_regret_as_a_mean_and_as_a_spread_of_runs():
    """The sums are .3 .3 .3 .6 and 0 0 .3 .3."""
    mean, runs = mean_regret(pulls_of()), regret_of_runs(pulls_of())
    assert mean.x.tolist() == runs.x.tolist() == [1, 2, 3, 4]
    assert mean.y == pytest.approx([0.15, 0.15, 0.3, 0.45])
    assert mean.low == pytest.approx(mean.y - 1.96 * np.array([0.15, 0.15, 0, 0.15]))
    assert mean.high == pytest.approx(mean.y + 1.96 * np.array([0.15, 0.15, 0, 0.15]))
    assert runs.y == pytest.approx([0.15, 0.15, 0.3, 0.45])
    assert (runs.low[0], runs.high[0]) == pytest.approx((0.015, 0.285))


COINS = (0.2, 0.5, 0.75)


def test_auers_bound_and_the_slope_of_lai_and_robbins():
    """(8 / .55 + 8 / .25) ln n + (1 + pi^2 / 3) (.55 + .25), which is 432.1 at 10,000."""
    assert float(auer_bound(COINS, 10_000)) == pytest.approx(432.1, abs=0.05)
    at_once = 0.8 * (1 + math.pi**2 / 3)
    assert auer_bound(COINS, [1, math.e]) == pytest.approx([at_once, at_once + 8 / 0.55 + 8 / 0.25])
    assert lai_robbins_slope(COINS) == pytest.approx(2.564, abs=0.0005)
    # By hand for a pair: .25 / (.5 ln(.5 / .75) + .5 ln(.5 / .25)).
    by_hand = 0.25 / (0.5 * math.log(2 / 3) + 0.5 * math.log(2))
    assert lai_robbins_slope((0.5, 0.75)) == pytest.approx(by_hand)


def test_best_of_normals():
    """Closed forms for two and three; 1.5388 for the testbed's ten."""
    by_hand = [0, 1 / math.sqrt(math.pi), 1.5 / math.sqrt(math.pi)]
    assert [best_of_normals(n) for n in (1, 2, 3)] == pytest.approx(by_hand, abs=1e-9)
    assert best_of_normals(10) == pytest.approx(1.5388, abs=5e-5)


@pytest.fixture(scope="module")
def beliefs(tmp_path_factory, do_study):
    """By name, of agents that know contexts, that do not, and that take rewards as Gaussian."""
    asked = {
        "SegmentBandit-v0": {"knows": {}, "blind": {"ignore_context": True}},
        "BernoulliBandit-v0": {"normal": {"likelihood": "gaussian"}, "coins": {}},
    }
    found = {}
    for env_id, settings in asked.items():
        agents = [AgentSpec(name, "thompson", settings[name], tuned=False) for name in settings]
        places = [EnvironmentSpec(env_id, env_id, {"n_timesteps": 400})]
        study = StudySpec("s", "S", tuple(agents), tuple(places), n_seeds=3, metric="regret")
        series = study_series(analyse(do_study(study, tmp_path_factory.mktemp("study"))))
        found |= {belief.agent: belief for belief in series.environments[0].pulls.beliefs}
    return found


def test_beliefs_are_densities(beliefs):
    for agent, ends in (("normal", [0.2 - 2, 0.75 + 2]), ("coins", [0, 1])):
        found = beliefs[agent]
        assert found.points[[0, -1]] == pytest.approx(ends)
        for y in found.densities[0, 0]:
            assert integrate.trapezoid(y, found.points) == pytest.approx(1, abs=0.02)
        assert found.true_means[0][2] == 0.75
    assert beliefs["knows"].moments.tolist() == [10, 100, 400]
    assert beliefs["knows"].densities.shape[:3] == (3, 2, 3)
    assert beliefs["knows"].true_means == [[0.10, 0.25, 0.05], [0.12, 0.06, 0.05]]
    # What an agent believes of an arm over all contexts has no one true mean.
    assert beliefs["blind"].true_means == [[None] * 3]
