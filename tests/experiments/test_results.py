"""From run folders to tables, judgements, sentences and figures, on runs written by hand."""

import json
import math
import re
from dataclasses import replace
from pathlib import Path

import numpy as np
import pandas as pd
import pytest
from PIL import Image

from commands.terminal import TextConsole
from experiments.analysis import analyse
from experiments.launching import EarlyResults
from experiments.plan import plan
from experiments.results import (
    CURVE_COLUMNS,
    RUN_COLUMNS,
    curves_by_agent,
    mean_curve,
    read_results,
    threshold_of,
    values_over_seeds,
)
from experiments.study import AgentSpec, EnvironmentSpec, StudySpec
from pipeline.runs import FINISHED
from report.conclusions import conclusion, places_without_a_run
from report.documents import write_tables
from report.figures import write_figures
from report.series import episodes_table, study_series
from report.terminal import print_analysis, print_episodes_table
from report.words import enumeration, interval, number

OPTIMUM, BASELINE = 100.0, 0.0
ENVIRONMENT = EnvironmentSpec("Warehouse-v0", "Warehouse-v0", {"n_timesteps": 100})
UNKNOWN = EnvironmentSpec("CartPole-v1", "CartPole-v1", {"n_timesteps": 100})


def study_of(n_seeds=4, environments=(ENVIRONMENT,), agents=("qlearning", "sarsa"), **fields):
    specs = tuple(AgentSpec(name, name) for name in agents)
    return StudySpec("study", "A study", specs, tuple(environments), n_seeds, **fields)


def write_run(planned, evaluations, episodes=((10, 1.0),) * 10, known=True, **info):
    """A run folder: evaluations as (step, return), episodes as (length, return)."""
    run = planned.run
    run.params_path.mkdir(parents=True)
    rows = [f"{r},{length},{n + 1}.0" for n, (length, r) in enumerate(episodes)]
    text = "\n".join(['#{"t_start": 0, "env_id": "x"}', "r,l,t", *rows, ""])
    (run.path / "0.monitor.csv").write_text(text)
    final = None
    if evaluations:
        steps, values = zip(*evaluations, strict=True)
        results = np.array(values, dtype=float)[:, None]
        np.savez(run.evaluations_path, timesteps=steps, results=results, ep_lengths=results)
        final = {"mean_return": values[-1], "std_return": 0.0, "mean_length": 10.0}
        final |= {"success_rate": 1.0, "exact": known}
        if known:
            final |= {"optimum": OPTIMUM, "baseline": BASELINE}
            final |= {"gap": OPTIMUM - values[-1], "score": values[-1] / OPTIMUM}
    record = {
        "state": FINISHED,
        "spec": planned.spec.as_data(),
        "final": final,
        "best_mean_return": max(v for _, v in evaluations) if evaluations else None,
        "best_timesteps": 50 if evaluations else 0,
        "n_timesteps": 100,
        "seconds": 9.5,
        "cpu_seconds": 2.5,
        "engine": "compiled",
    }
    run.info_path.write_text(json.dumps(record | info))
    run.model_path.touch()


def results_of(study, root, finals, **options):
    """A study whose runs end as ``finals`` says by agent and seed; None for one that is missing."""
    planned = plan(study, root)
    for run in planned:
        final = finals[run.agent][run.seed - study.first_seed]
        if final is not None:
            known = run.spec.env_id == ENVIRONMENT.env_id
            write_run(run, [(50, final / 2), (100, final)], known=known, **options)
    return read_results(study, planned, root)


def said(results):
    return everything_said(analyse(results))


def everything_said(analysis):
    """All sentences in one text."""
    found = [conclusion(analysis.study, place).everything for place in analysis.environments]
    return " ".join([*(text for texts in found for text in texts), *places_without_a_run(analysis)])


def test_a_row_for_each_run(tmp_path):
    study = study_of(n_seeds=1, agents=("qlearning",))
    (planned,) = plan(study, tmp_path)
    episodes = [(10, 1.0)] * 5 + [(25, 3.0)] * 2
    write_run(planned, [(20, 10.0), (60, 96.0), (100, 90.0)], episodes)
    results = read_results(study, [planned], tmp_path)
    assert list(results.summary.columns) == list(RUN_COLUMNS)
    row = results.summary.iloc[0]
    assert (row["agent"], row["environment"], row["seed"]) == ("qlearning", "Warehouse-v0", 0)
    assert (row["algo"], row["env_id"]) == ("qlearning", "Warehouse-v0")
    assert (row["final"], row["gap"], row["score"]) == (90.0, 10.0, 0.9)
    assert (row["optimum"], row["baseline"], row["best"]) == (OPTIMUM, BASELINE, 96.0)
    # 0.95 of the way from 0 to 100, reached at the second evaluation; 6 episodes were over then.
    assert (row["threshold"], row["steps_to_threshold"]) == (95.0, 60.0)
    assert row["episodes_to_threshold"] == 5
    # The third falls below it again.
    assert row["steps_to_stay"] == row["episodes_to_stay"] == math.inf
    # Two trapezoids of width 40, of mean heights 53 and 93.
    assert row["area"] == pytest.approx(73.0)
    assert row["training"] == pytest.approx(11 / 7)
    assert (row["n_episodes"], row["n_timesteps"], row["cpu_seconds"]) == (7, 100, 2.5)
    assert row["path"] == str(planned.path)


def test_the_columns_of_the_files_that_others_read():
    """Once written down here: whoever reads the files reads them by these names."""
    assert RUN_COLUMNS == (
        "agent",
        "algo",
        "environment",
        "env_id",
        "seed",
        "final",
        "final_std",
        "final_length",
        "success_rate",
        "exact",
        "optimum",
        "optimum_at_least",
        "baseline",
        "gap",
        "score",
        "best",
        "best_timesteps",
        "area",
        "training",
        "last_episodes",
        "regret",
        "threshold",
        "steps_to_threshold",
        "steps_to_stay",
        "episodes_to_threshold",
        "episodes_to_stay",
        "n_timesteps",
        "n_episodes",
        "seconds",
        "cpu_seconds",
        "engine",
        "path",
    )
    assert CURVE_COLUMNS == (
        "agent",
        "environment",
        "seed",
        "kind",
        "step",
        "episode",
        "seconds",
        "value",
    )


def test_learning_curves_by_step_episode_and_time(tmp_path):
    study = study_of(n_seeds=1, agents=("qlearning",))
    (planned,) = plan(study, tmp_path)
    write_run(planned, [(20, 10.0), (60, 96.0)], [(10, float(n)) for n in range(6)])
    curves = read_results(study, [planned], tmp_path).curves
    assert list(curves.columns) == list(CURVE_COLUMNS)
    assert curves.index.tolist() == list(range(len(curves)))
    evaluations = curves[curves["kind"] == "evaluation"]
    assert evaluations[["step", "episode", "seconds", "value"]].to_numpy().tolist() == [
        [20, 2, 2, 10],
        [60, 6, 6, 96],
    ]
    training = curves[curves["kind"] == "training"]
    assert training["step"].tolist() == [10, 20, 30, 40, 50, 60]
    assert training["value"].tolist() == [0, 1, 2, 3, 4, 5]


def test_runs_that_were_read_early_are_not_read_again(tmp_path):
    study = study_of(n_seeds=2, agents=("qlearning",))
    first, second = plan(study, tmp_path)
    write_run(first, [(20, 10.0)], [(10, 1.0)])
    early = EarlyResults(study)
    early.read(first)
    early.read(second)  # it is not there
    write_run(second, [(20, 12.0)], [(10, 1.0)])
    expected = read_results(study, [first, second], tmp_path)
    (first.path / "evaluations.npz").write_bytes(b"damaged since")
    found = read_results(study, [first, second], tmp_path, read=early.of)
    pd.testing.assert_frame_equal(found.summary, expected.summary)
    pd.testing.assert_frame_equal(found.curves, expected.curves)
    damaged = EarlyResults(study)
    damaged.read(first)  # that is said at the end
    left_out = read_results(study, [first, second], tmp_path, read=damaged.of).left_out
    assert [one.planned for one in left_out] == [first]


def test_training_is_summed_up_in_blocks_of_episodes(tmp_path):
    study = study_of(n_seeds=1, agents=("qlearning",))
    (planned,) = plan(study, tmp_path)
    write_run(planned, [(20, 1.0)], [(1, float(n)) for n in range(250)])
    curves = read_results(study, [planned], tmp_path).curves
    training = curves[curves["kind"] == "training"]
    assert len(training) == 84
    assert training["value"].iloc[[0, 1, -1]].tolist() == [1.0, 4.0, 249.0]
    assert training["episode"].iloc[[0, 1, -1]].tolist() == [3, 6, 250]


@pytest.mark.parametrize(
    ("environment", "stated", "expected"),
    [(ENVIRONMENT, None, 95.0), (UNKNOWN, None, 475.0), (ENVIRONMENT, 7.0, 7.0)],
)
def test_what_counts_as_solved(tmp_path, environment, stated, expected):
    study = study_of(environments=[environment], threshold=stated)
    results = results_of(study, tmp_path, {"qlearning": [90] * 4, "sarsa": [5] * 4})
    assert set(results.summary["threshold"]) == {expected}
    reached = set(results.summary["steps_to_threshold"])
    assert reached == ({50.0, math.inf} if stated else {math.inf})


def test_ranks_estimates_and_pairs(tmp_path):
    finals = {"qlearning": [10, 11, 12, 13, 14], "sarsa": [90, 91, 92, 91, 91]}
    results = results_of(study_of(n_seeds=5), tmp_path, finals)
    (environment,) = analyse(results).environments
    assert [agent.agent for agent in environment.agents] == ["sarsa", "qlearning"]
    assert (environment.optimum, environment.baseline, environment.exact) == (100, 0, True)
    assert environment.margin == pytest.approx(2.0)
    best = environment.agents[0]
    assert best.metric.mean.point == pytest.approx(91.0)
    assert best.score.mean.point == pytest.approx(0.91)
    assert best.area.point == pytest.approx(0.75 * 91)
    assert best.success_rate.point == 1.0
    assert best.seconds.point == 2.5
    (pair,) = environment.pairs
    assert (pair.first, pair.second, pair.verdict) == ("sarsa", "qlearning", "better")
    assert pair.difference.point == pytest.approx(79)
    assert values_over_seeds(results, "Warehouse-v0", "final")["qlearning"].tolist() == [
        *(10, 11, 12, 13, 14)
    ]


VERDICTS = {
    "better": (
        {"qlearning": [10, 11, 12, 13, 14], "sarsa": [90, 91, 92, 91, 91]},
        "sarsa is better than qlearning (by 79 [",
    ),
    "better but for a failure": (
        {"qlearning": [80, 80, 80, 80, 80, 80, 80], "sarsa": [90, 90, 90, 90, 90, 90, 10]},
        "qlearning is undecided against sarsa (difference -10 [",
    ),
    "better with a failure": (
        {"qlearning": [80] * 12, "sarsa": [90] * 11 + [10]},
        "sarsa is better than qlearning (by 10; 1 of 12 runs of sarsa failed).",
    ),
    "equivalent": (
        {"qlearning": [90, 91, 90, 91, 90], "sarsa": [90.1, 91, 90, 91, 90]},
        # 1 - (0.9 * 0.05 / 2) ** (1 / 5): one look of an open number, two agents.
        (
            "sarsa and qlearning are equivalent in the typical run within 2; 0 of 5 runs each "
            "failed, up to 53% could."
        ),
    ),
    "equivalent but for a failure": (
        {"qlearning": [90] * 11 + [0], "sarsa": [90] * 12},
        (
            "sarsa and qlearning are equivalent in the typical run within 2; 0 of 12 runs of sarsa "
            "failed (up to 27% could) and 1 of 12 runs of qlearning failed (up to 39% could)."
        ),
    ),
    "failures alone": (
        # The typical run is 0.1 worse, and one in three fails.
        {"qlearning": [90.0] * 12 + [0] * 6, "sarsa": [90.1, 89.9] * 9},
        "qlearning fails more often than sarsa (6 of 18 runs against 0 of 18).",
    ),
    "too few": (
        {"qlearning": [10, 11, 12, 13], "sarsa": [90, 91, 92, 91]},
        (
            "Undecided: 4 seeds cannot tell 2 agents apart, whatever they score; it takes 5 or "
            "more. sarsa has the highest mean so far: return of the final policy 91 [90"
        ),
    ),
    "none has learnt": (
        {"qlearning": [0, 0, 0, 1], "sarsa": [0, -5, 0, 90]},
        (
            "None of the agents has learnt: no typical run is better than the best random or "
            "constant policy's 0; the highest mean return of the final policy is 21.25 ["
        ),
    ),
    "undecided": (
        {"qlearning": [10, 80, 40, 60, 50], "sarsa": [70, 30, 90, 40, 60]},
        "sarsa is undecided against qlearning (difference 10 [",
    ),
    "the optimum": (
        {"qlearning": [100] * 4, "sarsa": [50, 51, 52, 53]},
        "qlearning has the highest mean so far: return of the final policy 100, the optimum.",
    ),
    "all the best": (
        {"qlearning": [90] * 4, "sarsa": [90] * 4},
        "qlearning and sarsa have the highest mean so far: return of the final policy 90, score",
    ),
    "a missing run": (
        {"qlearning": [90, None, 90, 91], "sarsa": [50, 51, 52, 53]},
        "1 of 4 runs of qlearning is missing.",
    ),
    "two missing runs": (
        {"qlearning": [90, None, None, 91], "sarsa": [50, 51, 52, 53]},
        "2 of 4 runs of qlearning are missing.",
    ),
    "no run": (
        {"qlearning": [None] * 4, "sarsa": [50, 51, 52, 53]},
        "No run of qlearning has finished.",
    ),
    "speed": (
        {"qlearning": [100] * 4, "sarsa": [195] * 4},
        (
            "sarsa reaches a score of 0.95 and keeps it to the end in 4 of 4 runs, the median one "
            "from step 50 on; qlearning in 4 of 4 runs, the median one from step 100 on."
        ),
    ),
    "too slow": (
        {"qlearning": [100] * 4, "sarsa": [5] * 4},
        "in 4 of 4 runs, the median one from step 100 on; sarsa in none.",
    ),
}


@pytest.mark.parametrize("case", VERDICTS)
def test_sentences(tmp_path, case):
    finals, sentence = VERDICTS[case]
    results = results_of(study_of(n_seeds=len(finals["sarsa"])), tmp_path, finals)
    assert sentence in said(results)


def test_more_seeds_are_asked_for_where_they_would_help(tmp_path):
    results = results_of(study_of(n_seeds=5), tmp_path, VERDICTS["undecided"][0])
    assert re.search(r"; about [\d,]+ seeds are needed to decide\)\.", said(results))


def test_agents_of_which_every_two_are_equivalent_make_one_sentence(tmp_path):
    agents = ("qlearning", "sarsa", "expected_sarsa", "double_qlearning")
    # The margin is 2: the first and the last lie further apart than that, all others do not.
    finals = dict(zip(agents, ([90.0] * 8, [91.5] * 8, [91.5] * 8, [93.0] * 8), strict=True))
    text = said(results_of(study_of(agents=agents, n_seeds=8), tmp_path, finals))
    same = "are equivalent in the typical run within 2; 0 of 8 runs each failed"
    assert f"double_qlearning, sarsa and expected_sarsa {same}" in text
    assert f"sarsa, expected_sarsa and qlearning {same}" in text
    assert "and expected_sarsa are best, and equivalent: return of the final policy 93" in text
    assert text.count("equivalent in") == 2
    assert "double_qlearning is better than qlearning (by 3)" in text


def bracketed_results(tmp_path, ends, finals):
    """Runs on CartPole whose optimum lies between two ends, and whose baseline is 20."""
    study = study_of(environments=[UNKNOWN])
    planned = plan(study, tmp_path)
    low, high = ends
    for run in planned:
        value = finals[run.agent][run.seed]
        figures = {"optimum": high, "optimum_at_least": low, "baseline": 20.0}
        figures |= {"gap": high - value, "score": (value - 20) / (high - 20)}
        final = {"mean_return": value, "std_return": 1.0, "mean_length": 10.0, "exact": False}
        write_run(run, [(50, value / 2), (100, value)], known=False, final=final | figures)
    return read_results(study, planned, tmp_path)


def test_what_is_within_reach_goes_by_the_lower_end_of_a_bracket(tmp_path):
    finals = {"qlearning": [400.0] * 4, "sarsa": [30.0] * 4}
    results = bracketed_results(tmp_path, (420.0, 520.0), finals)
    (environment,) = analyse(results).environments
    assert (environment.optimum, environment.optimum_at_least) == (520, 420)
    assert environment.margin == pytest.approx(0.02 * 400)
    assert environment.threshold == 475, "the environment's own"
    assert environment.agents[0].score.mean.point == pytest.approx(380 / 500)
    assert set(results.summary["optimum_at_least"]) == {420.0}
    text = said(results)
    assert (
        "return of the final policy 400, score 0.76; the optimum is 420 to 520 (bracketed)" in text
    )
    assert "MORE THAN" not in text


def test_more_than_any_policy_can_reach_stands_in_the_conclusions(tmp_path):
    finals = {"qlearning": [530.0, 531.0, 530.0, 531.0], "sarsa": [500.0] * 4}
    text = said(bracketed_results(tmp_path, (420.0, 520.0), finals))
    assert "qlearning has MORE THAN ANY POLICY CAN REACH, 520: the environment is not" in text


def test_agents_that_play_other_environments_are_not_compared_in_silence(tmp_path):
    results = bracketed_results(
        tmp_path, (420.0, 520.0), {"qlearning": [400.0] * 4, "sarsa": [400.0] * 4}
    )
    assert "SAME ENVIRONMENT" not in said(results)
    results.summary.loc[results.summary["agent"] == "sarsa", "optimum"] = 700.0
    told = "NOT PLAY THE SAME ENVIRONMENT: the optimum is 520 for qlearning and 700 for sarsa."
    assert told in said(results)


@pytest.mark.parametrize(
    ("env_id", "ends", "threshold"),
    [
        ("Pendulum-v1", {"optimum": -100.0, "optimum_at_least": -200.0}, -1200 + 0.95 * 1000),
        ("CartPole-v1", {"optimum": 500.0, "optimum_at_least": 499.0}, 475.0),
        ("FrozenLake-v1", {"optimum": 0.5}, -1200 + 0.95 * 1200.5),
    ],
)
def test_what_counts_as_solved_beside_a_bracket(env_id, ends, threshold):
    final = {**ends, "baseline": -1200.0}
    assert threshold_of(study_of(), env_id, final) == pytest.approx(threshold)


def test_an_environment_without_a_known_optimum(tmp_path):
    study = study_of(environments=[UNKNOWN])
    results = results_of(study, tmp_path, {"qlearning": [480] * 4, "sarsa": [100, 120, 99, 98]})
    text = said(results)
    assert "qlearning has the highest mean so far: return of the final policy 480." in text
    assert "optimum" not in text
    assert "qlearning reaches a return of 475 and keeps it to the end in 4 of 4 runs, the" in text
    assert "failed" not in text
    (environment,) = analyse(results).environments
    assert (environment.optimum, environment.margin, environment.exact) == (None, 0.0, False)
    assert environment.agents[0].score is None


def test_scores_over_environments(tmp_path):
    second = replace(ENVIRONMENT, label="again")
    study = study_of(environments=[ENVIRONMENT, second])
    finals = {"qlearning": [10, 11, 12, 13], "sarsa": [90, 91, 92, 91]}
    overall = analyse(results_of(study, tmp_path, finals)).overall
    assert list(overall.scores) == ["sarsa", "qlearning"]
    assert overall.improvement["sarsa", "qlearning"].point == 1.0
    assert overall.improvement["qlearning", "sarsa"].point == 0.0
    profile = overall.profiles["sarsa"].point
    assert (profile[0], profile[50], profile[100]) == (1.0, 1.0, 0.0)


def everything(results, tmp_path):
    """All that is made of results; the text in the terminal."""
    analysis = analyse(results)
    console = TextConsole(record=True, width=300, quiet=False, file=(tmp_path / "out").open("w"))
    print_analysis(console, analysis)
    blocks = episodes_table(results, 4)
    print_episodes_table(console, blocks, 4)
    write_tables(results)
    write_figures(study_series(analysis), blocks)
    console.file.close()
    return console.export_text()


MISFORTUNES = {
    "an agent without a run": (UNKNOWN, {"qlearning": [None] * 2, "sarsa": [5, 6]}),
    "one run in all": (UNKNOWN, {"qlearning": [None] * 2, "sarsa": [5, None]}),
    "no shared seed": (ENVIRONMENT, {"qlearning": [None, 4], "sarsa": [5, None]}),
}


@pytest.mark.parametrize("case", MISFORTUNES)
def test_failures_do_not_stop_the_analysis(tmp_path, case):
    environment, finals = MISFORTUNES[case]
    study = study_of(n_seeds=2, environments=[environment])
    text = everything(results_of(study, tmp_path, finals), tmp_path)
    assert environment.label in text
    assert "No run of qlearning" in text or "is missing" in text


def test_an_environment_without_a_run_is_named(tmp_path):
    study = study_of(n_seeds=2, environments=[ENVIRONMENT, UNKNOWN])
    planned = plan(study, tmp_path)
    for run in planned:
        if run.environment == ENVIRONMENT.label:
            write_run(run, [(50, 3.0), (100, 4.0)])
    results = read_results(study, planned, tmp_path)
    everything(results, tmp_path)
    assert said(results).endswith("On CartPole-v1, no run has finished.")
    assert analyse(results).overall is None


def test_a_study_without_a_run(tmp_path):
    study = study_of()
    results = read_results(study, plan(study, tmp_path), tmp_path)
    assert len(results.summary) == len(results.curves) == 0
    assert analyse(results).environments == ()


def test_one_seed_decides_nothing(tmp_path):
    study = study_of(n_seeds=1)
    text = everything(results_of(study, tmp_path, {"qlearning": [9], "sarsa": [80]}), tmp_path)
    assert "sarsa has the highest mean so far" in text
    assert "better" not in text
    assert "Undecided: 1 seed cannot tell 2 agents apart" in " ".join(text.split())


def test_runs_without_evaluations(tmp_path):
    study = study_of(n_seeds=2)
    planned = plan(study, tmp_path)
    for run in planned:
        write_run(run, [])
    results = read_results(study, planned, tmp_path)
    text = everything(results, tmp_path)
    assert "No run has a figure for the return of the final policy" in text
    trained = replace(results, study=replace(study, metric="training"))
    assert "have the highest mean so far: mean return of all training episodes 1." in said(trained)


def test_runs_without_an_episode(tmp_path):
    study = study_of(n_seeds=2)
    planned = plan(study, tmp_path)
    for run in planned:
        write_run(run, [(50, 1.0), (100, 3.0)], episodes=())
    results = read_results(study, planned, tmp_path)
    everything(results, tmp_path)
    assert results.summary["n_episodes"].tolist() == [0] * 4
    assert results.summary["final"].tolist() == [3.0] * 4


def test_curves_that_share_no_point_are_left_out(tmp_path):
    """One run ended after 2 episodes; the other is summed up in blocks of 3."""
    study = study_of(n_seeds=2, agents=("qlearning",))
    planned = plan(study, tmp_path)
    write_run(planned[0], [(50, 1.0), (100, 3.0)], [(50, 1.0)] * 2)
    write_run(planned[1], [(50, 1.0), (100, 3.0)], [(1, 1.0)] * 250)
    results = read_results(study, planned, tmp_path)
    curves = curves_by_agent(results, "Warehouse-v0")
    assert mean_curve(curves["qlearning", "training"], "episode") is None
    points, band = mean_curve(curves["qlearning", "evaluation"], "step")
    assert (points.tolist(), band.point.tolist()) == ([50, 100], [1, 3])
    everything(results, tmp_path)


def test_the_mean_curve_of_runs(tmp_path):
    results = results_of(study_of(n_seeds=2), tmp_path, {"qlearning": [10, 20], "sarsa": [5, None]})
    curves = curves_by_agent(results, "Warehouse-v0")
    points, band = mean_curve(curves["qlearning", "evaluation"], "step")
    assert points.tolist() == [50, 100]
    assert band.point.tolist() == [7.5, 15.0]
    assert (band.low <= band.point).all()
    assert (band.point <= band.high).all()


def test_files_of_comma_separated_values(tmp_path):
    results = results_of(study_of(), tmp_path, VERDICTS["too slow"][0])
    summary, curves = write_tables(results)
    table = pd.read_csv(summary)
    assert list(table.columns) == list(RUN_COLUMNS)
    assert len(table) == 8
    assert table["steps_to_threshold"].tolist() == [100, math.inf] * 4
    assert table["exact"].tolist() == [True] * 8
    table = pd.read_csv(curves)
    assert list(table.columns) == list(CURVE_COLUMNS)
    assert table["kind"].value_counts().to_dict() == {"training": 80, "evaluation": 16}


def test_the_documented_columns_are_those_written():
    text = (Path(__file__).parents[2] / "docs" / "compare.md").read_text()
    table = text.partition("columns of `summary.csv`")[2].partition("\n\n`")[0]
    rows = [line.split("|")[1] for line in table.splitlines() if line.startswith("| `")]
    assert re.findall(r"`(\w+)`", " ".join(rows)) == list(RUN_COLUMNS)


def test_the_table_per_block_of_episodes(tmp_path):
    study = study_of(n_seeds=2, agents=("qlearning",))
    planned = plan(study, tmp_path)
    write_run(planned[0], [(100, 1.0)], [(1, r) for r in (1.0, 2.0, 3.0, 4.0)])
    write_run(planned[1], [(100, 1.0)], [(1, r) for r in (5.0, 6.0, 7.0)])
    table = episodes_table(read_results(study, planned, tmp_path), 2)
    assert table.to_dict("list") == {
        "environment": ["Warehouse-v0"] * 2,
        "agent": ["qlearning"] * 2,
        "episode": [2, 4],
        "average": [3.5, pytest.approx(14 / 3)],
        "minimum": [1.0, 3.0],
        "maximum": [6.0, 7.0],
    }


def test_figures_as_png_and_svg_whose_text_is_text(tmp_path):
    results = results_of(study_of(), tmp_path, VERDICTS["better"][0])
    paths = write_figures(study_series(analyse(results)), episodes_table(results, 5))
    names = ["episodes", "intervals", "learning_curves"]
    assert sorted(path.name for path in paths) == sorted(
        f"Warehouse-v0_{name}.{suffix}" for name in names for suffix in ("png", "svg")
    )
    for path in paths:
        if path.suffix == ".png":
            with Image.open(path) as picture:
                assert picture.size[0] == 1950  # 6.5 inches of 300 dots
                assert min(picture.size) > 500
            continue
        texts = re.findall(r"<text [^>]*>([^<]*)</text>", path.read_text())
        assert "qlearning" in " ".join(texts)
        if "curves" in path.name:
            assert {
                "optimum",
                "best random or constant policy",
                "environment steps",
                "return",
            } <= set(texts)


def test_labels_with_brackets_stay_as_they_are(tmp_path):
    agents = tuple(AgentSpec(f"[{word}]", "qlearning") for word in ("red", "/b"))
    study = replace(study_of(n_seeds=2), agents=agents)
    results = results_of(study, tmp_path, {"[red]": [1, 2], "[/b]": [2, 3]})
    text = everything(results, tmp_path)
    rows = [line for line in text.splitlines() if "│" in line or "┃" in line]
    assert any("[red]" in row and "[/b]" in row for row in rows)
    assert sum("[red]" in row for row in rows) == sum("[/b]" in row for row in rows) == 2


@pytest.mark.parametrize(
    ("value", "text"),
    [
        (0.0, "0"),
        (0.74423, "0.7442"),
        (79.0, "79"),
        (-27427.4, "-27,427"),
        (999.96, "1000"),
        (0.00001, "0"),
        (-0.00001, "0"),
        (math.inf, "never"),
        (math.nan, "-"),
        (None, "-"),
    ],
)
def test_numbers(value, text):
    assert number(value) == text


def test_enumerations_and_intervals():
    from verdicts import Estimate

    assert enumeration(["a"]) == "a"
    assert enumeration(["a", "b"]) == "a and b"
    assert enumeration(["a", "b", "c"]) == "a, b and c"
    assert interval(Estimate(1.0, 0.5, 1.5, 3)) == "1 [0.5, 1.5]"
    assert interval(Estimate(1.0, 1.0, 1.0, 3)) == "1"
    assert interval(Estimate(1.0, math.nan, math.nan, 1)) == "1"


@pytest.mark.parametrize("first_seed", [0, 1000])
def test_agents_that_were_trained_on_a_variant_are_known_and_told_of(tmp_path, first_seed):
    shaped = {"n_timesteps": 100, "train_env_kwargs": {"shelf_reward": -10}}
    agents = (AgentSpec("plain", "qlearning"), AgentSpec("shaped", "sarsa", shaped))
    study = StudySpec("study", "A study", agents, (ENVIRONMENT,), 2, metric="last_episodes")
    study = replace(study, first_seed=first_seed)
    results = results_of(study, tmp_path, {"plain": [90.0, 91.0], "shaped": [80.0, 81.0]})
    told = []
    analysis = analyse(results, told.append)
    assert {a.agent: a.on_variant for a in analysis.environments[0].agents} == {
        "plain": False,
        "shaped": True,
    }
    assert [a.marked for a in analysis.environments[0].agents] == ["plain", "shaped †"]
    told_of = "shaped was trained on a variant of the environment"
    assert told_of in everything_said(analysis)
    curves = study_series(analysis, told.append).environments[0].curves
    assert curves["training"].on_variant == ("shaped",)
    assert curves["evaluation"].on_variant == ()
    assert told == ["Warehouse-v0", "all environments", "Warehouse-v0"]


def test_agents_that_do_not_learn_are_told_apart_by_what_they_are(tmp_path):
    agents = ("optimal", "value_iteration", "qlearning")
    finals = {"optimal": [100] * 2, "value_iteration": [90] * 2, "qlearning": [100] * 2}
    results = results_of(study_of(agents=agents, n_seeds=2), tmp_path, finals)
    text = said(results)
    assert "optimal is better than value_iteration (by 10)." in text
    assert "All other pairs are undecided: 2 seeds cannot tell 3 agents apart" in text
    assert set(analyse(results).environments[0].failures) == {"qlearning"}
    # Returns of sampled episodes depend on chance, whoever plays.
    sampled = results.summary.assign(exact=False)
    assert "better" not in said(replace(results, summary=sampled))


def test_speed_is_told_where_it_is_shown(tmp_path):
    planned = plan(study_of(n_seeds=6), tmp_path)
    for run in planned:
        quick = run.agent == "sarsa"
        curve = [(step, 100.0 if quick or step > 70 else 0.0) for step in range(10, 101, 10)]
        # A first crossing that is lost again.
        curve[0] = (10, 100.0)
        write_run(run, curve, known=True)
    text = said(read_results(study_of(n_seeds=6), planned, tmp_path))
    assert "sarsa reaches a score of 0.95 and keeps it to the end in 6 of 6 runs, the" in text
    assert "from step 10 on; qlearning in 6 of 6 runs, the median one from step 80 on." in text
    # At step 10 or before against one after step 70.
    assert "sarsa arrives in fewer steps: qlearning needs at least 7 times as many." in text
