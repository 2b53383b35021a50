"""Studies on bandits: batches where they may be, equal to their runs; verdicts on regret."""

import dataclasses
import io
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from rich.console import Console

from agents.bandits.batch import run_batch
from experiments.analysis import analyse
from experiments.bandit_results import (
    STATISTICS_FILE,
    read_run,
    run_regret,
    stacked_statistics,
)
from experiments.pull_statistics import PullStatistics
from experiments.study_files import read_study
from experiments.study_plan import plan
from experiments.study_spec import AgentSpec, EnvironmentSpec, StudySpec
from pipeline.runs import PULLS_FILE, Run
from pipeline.training import train
from report.conclusions import conclusion
from report.terminal_tables import print_analysis

STUDIES = sorted((Path(__file__).parents[2] / "studies").glob("bandit-*.yml"))
COINS = (0.2, 0.5, 0.75)
SEGMENTS = EnvironmentSpec("segments", "SegmentBandit-v0", {"n_timesteps": 200})


def study_of(agents, environments=(SEGMENTS,), n_seeds=5):
    specs = [
        AgentSpec(label, settings["algo"], {k: v for k, v in settings.items() if k != "algo"})
        for label, settings in agents.items()
    ]
    specs = [replace(spec, tuned=False) for spec in specs]
    return StudySpec("s", "S", tuple(specs), environments, n_seeds=n_seeds, metric="regret")


# --- batches where they may be, and runs else -----------------------------------------------------


def planned_as(settings, environment=SEGMENTS):
    runs = plan(study_of({"it": settings}, (environment,), n_seeds=3), Path("nowhere"))
    assert [run.seed for run in runs] == ([0] if runs[0].is_batch else [0, 1, 2])
    assert {run.n_runs for run in runs} == {3 if runs[0].is_batch else 1}
    return runs[0].is_batch


@pytest.mark.parametrize(
    ("settings", "expected"),
    [
        ({"algo": "ucb"}, True),
        ({"algo": "thompson", "ignore_context": True}, True),
        ({"algo": "linucb", "n_timesteps": 1000}, True),
        ({"algo": "ucb", "n_timesteps": 1001}, False),  # more than an episode
        ({"algo": "ucb", "n_timesteps": None, "n_episodes": 1}, False),
        ({"algo": "ucb", "n_envs": 2}, False),
        ({"algo": "ucb", "env_wrapper": "gymnasium.wrappers.RecordEpisodeStatistics"}, False),
        ({"algo": "ucb", "callback": "stable_baselines3.common.callbacks.BaseCallback"}, False),
        ({"algo": "mabwiser_ucb1"}, False),
        ({"algo": "qlearning", "gamma": 0.0}, False),
        ({"algo": "dqn", "policy": "MlpPolicy"}, False),
    ],
)
def test_what_goes_as_a_batch(settings, expected):
    settings = {key: value for key, value in settings.items() if value is not None}
    environment = SEGMENTS
    if "n_episodes" in settings:
        environment = replace(SEGMENTS, settings={})
    assert planned_as(settings, environment) == expected


def test_the_episode_is_that_of_the_environment():
    longer = {"n_timesteps": 3000, "env_kwargs": {"pulls": 3000}}
    assert planned_as({"algo": "ucb"}, EnvironmentSpec("long", "BernoulliBandit-v0", longer))


@pytest.mark.parametrize("path", STUDIES, ids=lambda path: path.stem)
def test_every_study_goes_in_batches(path):
    study = read_study(path)
    runs = plan(study, Path("nowhere"))
    assert len(runs) == len(study.agents) * len(study.environments)
    assert all(run.is_batch and run.n_runs == study.n_seeds for run in runs)
    quick = plan(read_study(path).quickened(), Path("nowhere"))
    assert all(run.is_batch and run.n_runs == study.quick.seeds for run in quick)


AGENTS = {
    "ucb": {"algo": "ucb"},
    "thompson": {"algo": "thompson"},
    "linucb": {"algo": "linucb"},
    "gradient": {"algo": "gradient_bandit", "learning_rate": 0.1},
}


@pytest.fixture(scope="module")
def batches(tmp_path_factory, do_study):
    """A small study, done."""
    return do_study(study_of(AGENTS), tmp_path_factory.mktemp("batches"))


def trained(spec, folder):
    """The same settings as a run of its own, as train.py does it."""
    run = Run(folder, "SegmentBandit-v0")
    run.params_path.mkdir(parents=True)
    train(replace(spec, verbose=0), Console(quiet=True), {}, "", run)
    return folder


@pytest.mark.parametrize("label", AGENTS)
def test_a_batch_is_its_runs(batches, label, tmp_path):
    planned = next(run for run in batches.planned if run.agent == label)
    folders = [trained(replace(planned.spec, seed=seed), tmp_path / str(seed)) for seed in range(5)]
    rows = batches.summary[batches.summary["agent"] == label]
    assert rows["seed"].tolist() == [0, 1, 2, 3, 4]
    regrets = [np.load(folder / PULLS_FILE)["regrets"][0] for folder in folders]
    assert rows["regret"].tolist() == [float(np.cumsum(regret)[-1]) for regret in regrets]
    rewards = [np.load(folder / PULLS_FILE)["rewards"].sum() for folder in folders]
    assert rows["training"].tolist() == rows["last_episodes"].tolist() == rewards
    assert len(set(rows["regret"])) > 1

    # What is told of runs that were done one by one is the same too.
    ours, theirs = batches.pulls[label, "segments"], stacked_statistics(planned.spec, folders)
    known = {"estimates", "estimates_std", "moments", "posteriors"}
    for field in dataclasses.fields(PullStatistics):
        if field.name not in known:
            one, other = getattr(ours, field.name), getattr(theirs, field.name)
            assert np.array_equal(one, other, equal_nan=True), field.name


def test_statistics_are_those_of_the_batch(batches):
    planned = next(run for run in batches.planned if run.agent == "thompson")
    result = run_batch("thompson", {}, "SegmentBandit-v0", {}, range(5), 200)
    found = batches.pulls["thompson", "segments"]
    assert found.total_regret.tolist() == np.cumsum(result.regrets, axis=1)[:, -1].tolist()
    assert np.array_equal(found.posteriors, result.posteriors[0])
    assert found.moments.tolist() == [10, 100, 200]
    assert found.estimates == pytest.approx(np.nanmean(result.estimates, axis=0))
    assert np.array_equal(PullStatistics.load(planned.path / STATISTICS_FILE).pulls, found.pulls)
    info = planned.run.read_info()
    assert (info["engine"], info["n_runs"], info["n_timesteps"]) == ("compiled batch", 5, 200)


def test_what_has_no_compiled_copy_goes_one_by_one(tmp_path, monkeypatch, do_study):
    from agents.compiled.compile_envs import NotCompilable

    def refuse(*args):
        raise NotCompilable("of a reason")

    expected = do_study(study_of({"ucb": {"algo": "ucb"}}, n_seeds=2), tmp_path / "one")
    monkeypatch.setattr("experiments.bandit_batches.run_batch", refuse)
    found = do_study(study_of({"ucb": {"algo": "ucb"}}, n_seeds=2), tmp_path / "two")
    assert found.summary["engine"].unique().tolist() == ["one by one: of a reason"]
    assert found.summary["regret"].tolist() == expected.summary["regret"].tolist()


def test_a_batch_that_is_there_is_not_done_again_and_a_longer_one_is(tmp_path, do_study):
    study = study_of({"ucb": {"algo": "ucb"}}, n_seeds=3)
    first = do_study(study, tmp_path)
    (planned,) = plan(study, tmp_path)
    assert planned.is_finished
    before = (planned.path / STATISTICS_FILE).stat().st_mtime_ns
    do_study(study, tmp_path)
    assert (planned.path / STATISTICS_FILE).stat().st_mtime_ns == before

    more = do_study(replace(study, n_seeds=6), tmp_path)
    assert more.summary["regret"].tolist()[:3] == first.summary["regret"].tolist()
    assert len(more.summary) == 6
    assert [path.name for path in (tmp_path / "runs" / "ucb").iterdir()] == ["segments_1"]
    assert list((tmp_path / ".drafts").iterdir()) == []

    other = replace(SEGMENTS, settings={"n_timesteps": 200, "env_kwargs": {"batch_size": 20}})
    (changed,) = plan(replace(study, n_seeds=6, environments=(other,)), tmp_path)
    assert changed.path == planned.path
    assert not changed.is_finished


def test_runs_beside_batches(tmp_path, do_study):
    """An agent of the library goes run by run, and its regret is counted over as many pulls."""
    agents = {
        "ucb": {"algo": "ucb"},
        "ppo": {"algo": "ppo", "policy": "MlpPolicy", "n_steps": 64, "batch_size": 64, "n_envs": 2},
    }
    short = replace(SEGMENTS, settings={"n_timesteps": 100})
    results = do_study(study_of(agents, (short,), n_seeds=2), tmp_path)
    assert {agent: len(p.total_regret) for (agent, _), p in results.pulls.items()} == {
        "ucb": 2,
        "ppo": 2,
    }
    ppo = results.pulls["ppo", "segments"]
    runs = [run for run in results.planned if run.agent == "ppo"]
    for run, regret in zip(runs, ppo.total_regret, strict=True):
        with np.load(run.path / PULLS_FILE) as arrays:
            assert arrays["regrets"].shape == (2, 64)
            in_time = arrays["regrets"].T.ravel()
        assert np.array_equal(read_run(run.path, 100)["regrets"], in_time[:100])
        assert run_regret(run) == pytest.approx(regret)
        assert regret == pytest.approx(in_time[:100].sum())
    assert ppo.pulls[-1] == 100
    assert results.pulls["ucb", "segments"].pulls[-1] == 100


@pytest.mark.parametrize(
    ("env_id", "env_kwargs", "has_simple"),
    [
        ("BernoulliBandit-v0", {}, True),
        ("GaussianBandit-v0", {}, True),
        ("GaussianBandit-v0", {"means": [0.0, 0.0], "drift_std": 0.1}, False),
        ("LinearBandit-v0", {}, False),
    ],
)
def test_an_arm_is_recommended_where_one_is_the_best(
    env_id, env_kwargs, has_simple, tmp_path, do_study
):
    place = EnvironmentSpec("it", env_id, {"n_timesteps": 30, "env_kwargs": env_kwargs})
    agent = "lin_epsilon_greedy" if env_id.startswith("Linear") else "epsilon_greedy"
    results = do_study(study_of({"it": {"algo": agent}}, (place,), n_seeds=2), tmp_path)
    simple = results.pulls["it", "it"].simple_regret
    assert np.isfinite(simple).all() if has_simple else np.isnan(simple).all()


# --- verdicts on what should be low ---------------------------------------------------------------


def test_seeds_that_begin_later_are_the_same_runs(tmp_path, do_study):
    agents = {"batch": {"algo": "ucb"}, "runs": {"algo": "ucb", "n_envs": 2}}
    whole = do_study(study_of(agents, n_seeds=4), tmp_path / "whole")
    later = replace(study_of(agents, n_seeds=2), first_seed=2)
    part = do_study(later, tmp_path / "part")
    columns = ["agent", "seed", "regret", "training"]
    wanted = whole.summary.loc[whole.summary["seed"] >= 2, columns]
    assert part.summary[columns].equals(wanted.reset_index(drop=True))
    for environment in analyse(part).environments:
        assert [agent.n_missing for agent in environment.agents] == [0, 0]


def test_less_regret_is_better(tmp_path, do_study):
    agents = {
        "random": {"algo": "epsilon_greedy", "exploration_initial_eps": 1.0},
        "Thompson": {"algo": "thompson"},
    }
    place = EnvironmentSpec("coins", "BernoulliBandit-v0", {"n_timesteps": 500})
    results = do_study(study_of(agents, (place,), n_seeds=10), tmp_path)
    analysis = analyse(results)
    (environment,) = analysis.environments
    assert [agent.agent for agent in environment.agents] == ["Thompson", "random"]
    best, worst = environment.agents
    assert best.metric.mean.point < 30
    assert worst.metric.mean.point > 100
    assert best.regret == best.metric.mean
    (pair,) = environment.pairs
    assert (pair.first, pair.second, pair.verdict) == ("Thompson", "random", "better")
    assert pair.swapped().verdict == "worse"
    scores = {name: rows["regret"] for name, rows in results.summary.groupby("agent")}
    gaps = np.subtract.outer(scores["random"].to_numpy(), scores["Thompson"].to_numpy())
    assert pair.difference.point == pytest.approx(np.median(gaps))
    assert pair.probability_of_improvement.point == 1
    said = conclusion(analysis.study, environment)
    assert said.lead.startswith("Thompson is best: regret of a run ")
    assert said.pairs[0].startswith("Thompson is better than random (by 1")

    console = Console(width=120, record=True, file=io.StringIO())
    print_analysis(console, analysis)
    lines = console.export_text().splitlines()
    rows = [line for line in lines if line.startswith("│")]
    assert [row.split("│")[1].strip() for row in rows] == ["Thompson", "random"]
