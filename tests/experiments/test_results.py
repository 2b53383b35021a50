"""From run folders to tables, judgements, sentences and files, on runs written by hand."""

import math
import re
from pathlib import Path

import numpy as np
import pytest

from rl_yardstick.commands.terminal import TextConsole
from rl_yardstick.experiments.analysis import analyse
from rl_yardstick.experiments.plan import plan
from rl_yardstick.experiments.results import (
    RUN_COLUMNS,
    mixed_versions,
    read_episodes,
    read_results,
    values_over_seeds,
)
from rl_yardstick.experiments.study import AgentSpec, EnvironmentSpec, StudySpec
from rl_yardstick.pipeline.run import FINISHED
from rl_yardstick.report.documents import write_tables
from rl_yardstick.report.figures import write_figures
from rl_yardstick.report.series import episodes_table, study_series
from rl_yardstick.report.terminal import print_analysis, print_episodes_table
from rl_yardstick.report.words import places_without_a_run

HOUSE = EnvironmentSpec("Warehouse-v0", "Warehouse-v0", {"n_timesteps": 100})
POLE = EnvironmentSpec("CartPole-v1", "CartPole-v1", {"n_timesteps": 100})


def study_of(n_seeds=4, environments=(HOUSE,), agents=("qlearning", "sarsa"), **fields):
    specs = tuple(AgentSpec(name, name) for name in agents)
    return StudySpec("study", "A study", specs, tuple(environments), n_seeds, **fields)


def write_run(planned, evaluations, episodes=((10, 1.0),) * 10, **info):
    """A run folder: evaluations as (step, return), episodes as (length, return).

    The optimum of the warehouse is 100, and the best constant policy earns 0.
    """
    folder = planned.path
    folder.mkdir(parents=True)
    rows = [f"{r},{length},{n + 1}.0" for n, (length, r) in enumerate(episodes)]
    text = "\n".join(['#{"t_start": 0, "env_id": "x"}', "r,l,t", *rows, ""])
    (folder / "0.monitor.csv").write_text(text)
    final, is_known = None, planned.spec.env_id == HOUSE.env_id
    if evaluations:
        steps, values = zip(*evaluations, strict=True)
        results = np.array(values, dtype=float)[:, None]
        np.savez(folder / "evaluations.npz", timesteps=steps, results=results, ep_lengths=results)
        final = {"mean_return": values[-1], "std_return": 0.0, "mean_length": 10.0}
        final |= {"success_rate": 1.0, "exact": is_known}
        if is_known:
            final |= {"optimum": 100.0, "baseline": 0.0}
            final |= {"gap": 100.0 - values[-1], "score": values[-1] / 100}
            final |= {"acts_by": "epsilon 0.1", "stochastic_return": values[-1] - 5}
            final |= {"discount": 0.9, "discounted_return": values[-1] / 2}
            final |= {"discounted_optimum": 50.0}
    record = {"final": final, "best_mean_return": max((v for _, v in evaluations), default=None)}
    record |= {"best_timesteps": 50 if evaluations else 0, "n_timesteps": 100, "engine": "compiled"}
    record |= {"seconds": 9.5, "cpu_seconds": 2.5}
    planned.run.record(planned.spec, FINISHED, **record | info)


def results_of(study, root, finals):
    """A study whose runs end as ``finals`` says by agent and seed; None for one that is missing."""
    planned = plan(study, root)
    for run in planned:
        final = finals[run.agent][run.seed - study.first_seed]
        if final is not None:
            write_run(run, [(50, final / 2), (100, final)])
    return read_results(study, planned, root)


def read_one(root, evaluations, episodes):
    study = study_of(n_seeds=1, agents=("qlearning",))
    (planned,) = plan(study, root)
    write_run(planned, evaluations, episodes)
    return read_results(study, [planned], root)


def test_a_row_for_each_run(tmp_path):
    episodes = [(10, 1.0)] * 5 + [(25, 3.0)] * 2
    results = read_one(tmp_path, [(20, 10.0), (60, 96.0), (100, 90.0)], episodes)
    (row,) = results.summary.to_dict("records")
    assert tuple(row) == RUN_COLUMNS
    expected = {"agent": "qlearning", "environment": "Warehouse-v0", "seed": 0, "algo": "qlearning"}
    expected |= {"env_id": "Warehouse-v0", "path": str(results.planned[0].path)}
    expected |= {"final": 90.0, "gap": 10.0, "score": 0.9, "optimum": 100.0, "baseline": 0.0}
    expected |= {"final_std": 0.0, "final_length": 10.0, "success_rate": 1.0, "exact": True}
    expected |= {"best": 96.0, "best_timesteps": 50, "n_episodes": 7, "n_timesteps": 100}
    expected |= {"seconds": 9.5, "cpu_seconds": 2.5, "threshold": 95.0}
    # 0.95 of the way from 0 to 100, reached at the second evaluation, when 5 episodes were
    # over; the third falls below it again.
    expected |= {"steps_to_threshold": 60.0, "episodes_to_threshold": 5}
    expected |= {"steps_to_stay": math.inf, "episodes_to_stay": math.inf}
    # Two trapezoids of width 40, of mean heights 53 and 93.
    expected |= {"area": pytest.approx(73.0), "training": pytest.approx(11 / 7)}
    expected |= {"last_episodes": pytest.approx(11 / 7), "engine": "compiled"}
    assert {name: row[name] for name in expected} == expected


BY_OBSERVATION = {
    "mean_return": -12.5, "optimum": -11.5, "baseline": -12.0, "gap": 1.0, "score": -1.0,
    "exact": True, "full_optimum": -3.0, "memory_optimum": -3.0, "memory_optimum_at_least": -3.0,
    "measured_by": "observation",
}  # fmt: skip


def test_where_an_agent_remembers_all_have_its_scale(tmp_path):
    places = [EnvironmentSpec("ShortCorridor-v0", "ShortCorridor-v0")]
    study = study_of(n_seeds=1, agents=("qlearning", "ppo_lstm"), environments=places)
    planned = plan(study, tmp_path)
    for run in planned:
        own = {"optimum": -3.0, "measured_by": "memory", "gap": 9.5, "score": -0.5 / 9}
        is_lstm = run.agent == "ppo_lstm"
        write_run(run, [(100, -12.5)], final=BY_OBSERVATION | (own if is_lstm else {}))
    results = read_results(study, planned, tmp_path)
    for row in results.summary.to_dict("records"):
        found = (row["measured_by"], row["optimum"], row["gap"], row["score"])
        assert found == ("memory", -3.0, 9.5, pytest.approx(-0.5 / 9))
        assert row["full_optimum"] == -3
        assert row["threshold"] == pytest.approx(-12 + 0.95 * 9)
    (found,) = analyse(results).environments
    assert (found.optimum, found.full_optimum, found.measured_by) == (-3, -3, "memory")
    assert not found.optima


def test_a_curve_ends_at_the_final_policy(tmp_path):
    """The evaluation at the last step comes before the last update."""
    study = study_of(n_seeds=1, agents=("qlearning",))
    (run,) = plan(study, tmp_path)
    write_run(run, [(50, 10.0), (100, 96.0)], final={"mean_return": 90.0})
    results = read_results(study, [run], tmp_path)
    assert results.curves.query("kind == 'evaluation'")["value"].tolist() == [10.0, 90.0]
    assert results.summary["area"].tolist() == [50.0]


def test_the_columns_of_the_files_are_documented():
    """What the files hold is recorded in ``tests/golden``."""
    text = (Path(__file__).parents[2] / "docs" / "compare.md").read_text()
    table = text.partition("columns of `summary.csv`")[2].partition("\n\n`")[0]
    rows = [line.split("|")[1] for line in table.splitlines() if line.startswith("| `")]
    assert re.findall(r"`(\w+)`", " ".join(rows)) == list(RUN_COLUMNS)


def test_learning_curves_by_step_episode_and_time(tmp_path):
    curves = read_one(tmp_path, [(20, 10.0), (60, 96.0)], [(10, n) for n in range(6)]).curves
    columns = ["kind", "step", "episode", "seconds", "value"]
    assert curves[columns].to_numpy().tolist() == [
        ["evaluation", 20, 2, 2, 10],
        ["evaluation", 60, 6, 6, 96],
        *(["training", 10 * n + 10, n + 1, n + 1, n] for n in range(6)),
    ]
    # Long trainings are summed up in blocks of episodes.
    curves = read_one(tmp_path / "long", [(20, 1.0)], [(1, float(n)) for n in range(250)]).curves
    training = curves[curves["kind"] == "training"]
    assert training["value"].iloc[[0, 1, -1]].tolist() == [1.0, 4.0, 249.0]
    assert training["episode"].iloc[[0, 1, -1]].tolist() == [3, 6, 250]


def test_environments_that_end_together_are_written_one_after_the_other(tmp_path):
    for number, seconds in enumerate((0.5, 0.2, 0.9)):
        (tmp_path / f"{number}.monitor.csv").write_text(f"#\nr,l,t\n1,4,{seconds}\n2,4,{2}\n")
    episodes = read_episodes(tmp_path)
    assert episodes.steps.tolist() == [12, 12, 12, 24, 24, 24]
    assert episodes.seconds.tolist() == [0.5, 0.5, 0.9, 2, 2, 2]


# What somebody has made of a file of a run, and what is said of it.
DAMAGE = {
    "evaluations.npz": (b"PK", "evaluations.npz is damaged"),
    "0.monitor.csv": (b"#\nr,l\n1,2\n", "0.monitor.csv is damaged"),
    "run.json": (None, "run.json is damaged"),
}


@pytest.mark.parametrize("name", DAMAGE)
def test_a_run_with_files_that_cannot_be_read_is_left_out(name, tmp_path):
    results = results_of(study_of(), tmp_path, {"qlearning": [90] * 4, "sarsa": [80] * 4})
    first = results.planned[0]
    content, reason = DAMAGE[name]
    if content is None:
        first.run.record(first.spec, FINISHED, final=3)
    else:
        (first.path / name).write_bytes(content)
    found = read_results(study_of(), results.planned, tmp_path)
    assert (len(found.summary), len(found.finished)) == (7, 7)
    ((path, told),) = found.left_out.items()
    assert path == first.path
    assert reason in told


def test_ranks_estimates_and_pairs(tmp_path):
    finals = {"qlearning": [10, 11, 12, 13, 14], "sarsa": [90, 91, 92, 91, 91]}
    results = results_of(study_of(n_seeds=5), tmp_path, finals)
    (environment,) = analyse(results).environments
    assert [agent.agent for agent in environment.agents] == ["sarsa", "qlearning"]
    assert (environment.optimum, environment.baseline, environment.exact) == (100, 0, True)
    assert environment.margin == 0.02
    best = environment.agents[0]
    figures = [best.metric.mean, best.score, best.success_rate, best.seconds]
    assert [figure.point for figure in figures] == pytest.approx([91, 0.91, 1, 2.5])
    assert (best.stochastic.point, best.discounted.point) == pytest.approx((86, 45.5))
    assert (best.acts_by, best.discount, best.discounted_optimum) == ("epsilon 0.1", 0.9, 50)
    (pair,) = environment.pairs
    assert (pair.first, pair.second, pair.text) == ("sarsa", "qlearning", "better")
    assert pair.difference == pytest.approx(0.79)
    found = values_over_seeds(results, "Warehouse-v0", "final")
    assert {name: values.tolist() for name, values in found.items()} == finals


def test_missing_runs_and_failures_are_counted(tmp_path):
    finals = {"qlearning": [90] * 11 + [0, None], "sarsa": [90] * 13}
    (environment,) = analyse(results_of(study_of(n_seeds=13), tmp_path, finals)).environments
    n_missing = {agent.agent: agent.n_missing for agent in environment.agents}
    n_failed = {agent.agent: (agent.runs.failed, agent.runs.n) for agent in environment.agents}
    assert n_missing == {"qlearning": 1, "sarsa": 0}
    assert n_failed == {"qlearning": (1, 12), "sarsa": (0, 13)}
    (pair,) = environment.pairs
    assert pair.word == "undecided"  # by their means


def test_what_is_within_reach_goes_by_the_lower_end_of_a_bracket(tmp_path):
    """On CartPole, with an optimum between 420 and 520, and a baseline of 20."""
    study = study_of(environments=[POLE])
    planned = plan(study, tmp_path)
    for run in planned:
        value = {"qlearning": 400.0, "sarsa": 530.0}[run.agent]
        final = {"mean_return": value, "std_return": 1.0, "mean_length": 10.0, "exact": False}
        final |= {"optimum": 520.0, "optimum_at_least": 420.0, "baseline": 20.0}
        final |= {"gap": 520 - value, "score": (value - 20) / 500}
        write_run(run, [(50, value / 2), (100, value)], final=final)
    (environment,) = analyse(read_results(study, planned, tmp_path)).environments
    assert (environment.optimum, environment.optimum_at_least) == (520, 420)
    assert environment.threshold == 475, "the environment's own"
    assert environment.agents[1].score.point == pytest.approx(380 / 500)
    assert environment.impossible == ("sarsa",)
    assert (environment.optimum_is_proven, environment.optima) == (True, {})


SOME = [(50, 1.0), (100, 3.0)]


def test_missing_runs_do_not_stop_the_analysis(tmp_path):
    def analysed(*places, **seeds):
        """After these runs on the first environment."""
        study = study_of(n_seeds=2, environments=places)
        planned = plan(study, tmp_path)
        for run in planned:
            if run.environment == HOUSE.label and run.seed == seeds.get(run.agent):
                write_run(run, SOME, episodes=())
        found = analyse(read_results(study, planned, tmp_path))
        assert found.overall is None
        return found

    def told(analysis):
        table = episodes_table(analysis.results, 4)
        with (tmp_path / "out").open("w") as file:
            console = TextConsole(record=True, width=300, quiet=False, file=file)
            print_analysis(console, analysis)
            print_episodes_table(console, table, 4)
        write_tables(analysis.results)
        assert set(analysis.results.summary["n_episodes"]) == {0}
        return " ".join([*console.export_text().split(), *places_without_a_run(analysis)])

    assert analysed(HOUSE).environments == ()
    apart = analysed(HOUSE, qlearning=1, sarsa=0)
    assert "is missing" in told(apart)
    write_figures(study_series(apart))
    whole = analysed(HOUSE, POLE, qlearning=0, sarsa=1)
    assert "On CartPole-v1, no run has finished." in told(whole)


def test_versions_that_differ_are_named():
    infos = [{"versions": {"torch": "2.1", "numpy": "2.0"}}] * 2
    assert mixed_versions(infos) == mixed_versions([]) == mixed_versions([{}]) == ""
    infos = [*infos, {"versions": {"torch": "2.2", "numpy": "2.0"}, "n_runs": 9}]
    expected = "runs were done with different versions: torch 2.1 (2 runs), 2.2 (9 runs)"
    assert mixed_versions(infos) == expected
