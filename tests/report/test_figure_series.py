"""The numbers that figures on paper and on the page share, worked out by hand."""

from dataclasses import replace

import numpy as np
import pandas as pd
import pytest

from experiments.bandits import pull_statistics
from experiments.study import AgentSpec
from report.series import (
    arm_series,
    best_of,
    grids,
    learning_curves,
    linear_up_to,
    mean_regret,
    regret_of_runs,
    run_series,
    sweeps,
)


def curve_rows(agent, kind, seed, values, steps=(10, 20)):
    return [
        {
            "agent": agent,
            "environment": "lake",
            "kind": kind,
            "seed": seed,
            "step": step,
            "episode": step / 10,
            "seconds": step / 100,
            "value": value,
        }
        for step, value in zip(steps, values, strict=True)
    ]


@pytest.fixture
def lake(made_up):
    """Two agents on a lake; by rank the second of the study comes first."""
    agents = (made_up.agent("b", 90.0), made_up.agent("a", 40.0))
    environment = made_up.environment(agents)
    analysis = made_up.analysis([environment], ["a", "b"], n_seeds=3)
    rows = [
        *curve_rows("a", "evaluation", 0, (1, 5)),
        *curve_rows("a", "evaluation", 1, (3, 7)),
        *curve_rows("b", "evaluation", 0, (2, 8)),
        *curve_rows("b", "training", 0, (-5000, 9)),
    ]
    summary = pd.DataFrame(
        {
            "agent": ["a", "a", "b", "b"],
            "environment": ["lake"] * 4,
            "seed": [0, 2, 0, 1],
            "final": [4.0, 6.0, 8.0, np.nan],
        }
    )
    return replace(analysis.results, curves=pd.DataFrame(rows), summary=summary), environment


def test_mean_curves_the_best_agent_first(lake):
    curves = learning_curves(*lake)
    assert list(curves) == ["evaluation", "training"]
    by_step = curves["evaluation"].by_axis["step"]
    assert list(by_step) == ["b", "a"]
    assert (by_step["a"].x.tolist(), by_step["a"].y.tolist()) == ([10, 20], [2, 6])
    assert (by_step["b"].y.tolist()) == [2, 8]
    assert (by_step["a"].low < by_step["a"].y).all()
    assert (by_step["a"].high > by_step["a"].y).all()
    assert curves["evaluation"].by_axis["episode"]["a"].x.tolist() == [1, 2]
    assert curves["evaluation"].by_axis["seconds"]["a"].x.tolist() == [0.1, 0.2]
    assert list(curves["training"].by_axis["step"]) == ["b"]


def test_each_kind_of_curve_has_a_scale_of_its_own(lake):
    curves = learning_curves(*lake)
    assert curves["evaluation"].linear_up_to is None
    assert curves["training"].linear_up_to == 100  # the optimum


def test_a_clock_that_was_set_back_costs_the_curve_by_time_alone(lake):
    results, environment = lake
    results.curves.loc[results.curves["agent"] == "b", "seconds"] = [0.2, 0.1] * 2
    by_axis = learning_curves(results, environment)["evaluation"].by_axis
    assert list(by_axis["step"]) == ["b", "a"]
    assert list(by_axis["seconds"]) == ["a"]


def test_runs_with_a_figure_by_seed(lake):
    first, second = run_series(*lake)
    assert (first.agent, second.agent) == ("b", "a")
    assert (first.seeds.tolist(), first.values.tolist()) == ([0], [8])
    assert (second.seeds.tolist(), second.values.tolist()) == ([0, 2], [4, 6])
    assert (first.mean.point, second.mean.point) == (90, 40)


def swept(label, value, group="sarsa", name="alpha"):
    return AgentSpec(label, "sarsa", tuned=False, group=group, swept={name: value})


def test_a_sweep_goes_in_the_order_of_its_values(made_up):
    values = {"a": 0.9, "b": 0.1, "c": 0.5}
    agents = [made_up.agent(label, 10 * value) for label, value in values.items()]
    specs = [swept(*item, name="learning_rate") for item in values.items()]
    found = sweeps(specs, made_up.environment(agents))
    assert list(found) == ["sarsa"]
    assert (found["sarsa"].parameter, found["sarsa"].labels) == ("α", ("b", "c", "a"))
    curve = found["sarsa"].means
    assert curve.x.tolist() == [0.1, 0.5, 0.9]
    assert curve.y.tolist() == [1, 5, 9]
    assert curve.low == pytest.approx([0.9, 4.9, 8.9])
    assert curve.high == pytest.approx([1.2, 5.2, 9.2])


@pytest.mark.parametrize(
    "specs",
    [
        [swept("a", 1), swept("b", 2)],  # two values make no line
        [swept("a", 1), swept("b", 2), swept("c", 3, group="dqn")],
        [swept("a", 1), swept("b", 2), swept("c", 3, name="gamma")],
        [swept("a", 1), swept("b", 2), swept("c", "lin_0.5")],  # not a number
        [swept("a", 1), swept("b", 2), swept("absent", 3)],  # without a run
        [swept("a", 1), swept("b", 2), AgentSpec("c", "sarsa", swept={"alpha": 1, "gamma": 2})],
    ],
)
def test_what_makes_no_sweep(made_up, specs):
    agents = [made_up.agent(label, 1.0) for label in "abc"]
    assert sweeps(specs, made_up.environment(agents)) == {}


def test_each_parameter_has_a_sweep(made_up):
    specs = [swept(f"a{n}", n) for n in range(3)] + [swept(f"g{n}", n, "dqn") for n in range(4)]
    environment = made_up.environment([made_up.agent(spec.label, 1.0) for spec in specs])
    found = sweeps(specs, environment)
    assert {name: sweep.means.x.tolist() for name, sweep in found.items()} == {
        "sarsa": [0, 1, 2],
        "dqn": [0, 1, 2, 3],
    }


def test_two_parameters_make_a_grid(made_up):
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
    assert best_of(environment, [spec.label for spec in specs]) == ["0.1 b", "0.5 a"]
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


def test_arms_of_agents_that_estimate_them_and_of_others():
    means = np.array([[0.2, 0.5]])
    knows = pulls_of(true_means=means, estimates=np.array([[[0.1, 0.4]], [[0.3, 0.6]]]))
    arms = arm_series({"knows": knows, "does not": pulls_of(true_means=means)})
    assert arms is not None
    assert arms.names == ["arm 0", "arm 1"]
    assert arms.means.tolist() == [0.2, 0.5]
    assert {agent: shares.tolist() for agent, shares in arms.shares.items()} == {
        "knows": [3 / 8, 5 / 8],
        "does not": [3 / 8, 5 / 8],
    }
    assert list(arms.estimates) == ["knows"]
    mean, std = arms.estimates["knows"]
    assert mean == pytest.approx([0.2, 0.5])
    assert std == pytest.approx([0.1, 0.1])
    assert arm_series({}) is None


@pytest.mark.parametrize(
    ("curves", "optimum", "expected"),
    [
        ([[-5000.0, -50.0, 70.0]], 79.0, 79.0),  # early returns dwarf the optimum
        ([[-500.0, -50.0, 70.0]], 79.0, None),
        ([[-300.0, 1.0, 2.0, 2.0]], None, 2.0),  # the end of the curve stands for the optimum
        ([[np.nan, 1.0], [np.nan]], None, None),
        ([], 79.0, None),
        ([[-9.0, 0.0]], 0.1, None),  # returns below one are never dwarfed by those below ten
    ],
)
def test_where_an_axis_ceases_to_be_linear(curves, optimum, expected):
    assert linear_up_to([np.array(curve) for curve in curves], optimum) == expected
