"""Pulls of bandits: figures worked the plain way, batches, the shipped studies."""

import dataclasses
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from rl_yardstick.agents.bandits.runs import run_batch
from rl_yardstick.experiments import bandits
from rl_yardstick.experiments import study as studies
from rl_yardstick.experiments.analysis import analyse
from rl_yardstick.experiments.plan import plan
from rl_yardstick.experiments.study import AgentSpec, EnvironmentSpec, StudySpec
from rl_yardstick.pipeline.run import PULLS_FILE, Run
from rl_yardstick.pipeline.training import train
from rl_yardstick.report.series import auer_bound

COINS = (0.2, 0.5, 0.75)


def pulls_in(folder):
    with np.load(folder / PULLS_FILE) as file:
        return dict(file)


def test_every_figure_at_every_point_the_plain_way():
    """Three runs of so many pulls that the points thin out."""
    by_cell = np.array([[0, 8, 2], [4, 0, 1]])  # the regret of each arm in each of two contexts
    rng = np.random.default_rng(0)
    arms, contexts = rng.integers(3, size=(3, 450)), rng.integers(2, size=(3, 450))
    regrets = by_cell[contexts, arms].astype(np.float64)
    rewards = rng.integers(-3, 9, size=(3, 450)).astype(np.float64)
    found = bandits.pull_statistics(arms, rewards, regrets, contexts, 3, 2)
    before = 0
    for i, pull in enumerate(found.pulls.tolist()):
        block, sums = slice(before, pull), regrets[:, :pull].sum(axis=1)
        assert found.reward[i] == pytest.approx(rewards[:, block].mean())
        assert found.regret[i] == pytest.approx(regrets[:, block].mean())
        assert found.optimal[i] == pytest.approx((regrets[:, block] == 0).mean())
        assert found.cumulative_regret[i] == pytest.approx(sums.mean())
        assert found.cumulative_regret_sem[i] == pytest.approx(sums.std(ddof=1) / np.sqrt(3))
        quantiles = np.quantile(sums, bandits.QUANTILES)
        assert found.cumulative_regret_quantiles[:, i] == pytest.approx(quantiles)
        simple = 0.0
        for run, context in np.ndindex(3, 2):
            here = contexts[run, :pull] == context
            most = np.bincount(arms[run, :pull][here], minlength=3).argmax()
            simple += by_cell[context, most] * here.mean()
        assert found.simple_regret[i] == pytest.approx(simple / 3)
        before = pull
    assert 200 < len(found.pulls) <= bandits.MAX_POINTS
    assert found.total_reward.tolist() == rewards.sum(axis=1).tolist()
    assert found.total_regret.tolist() == regrets.sum(axis=1).tolist()
    for context in range(2):
        counts = np.bincount(arms[contexts == context], minlength=3)
        assert found.shares[context] == pytest.approx(counts / counts.sum())


SEGMENTS = EnvironmentSpec("segments", "SegmentBandit-v0", {"n_timesteps": 200})
ONE_EPISODE = replace(SEGMENTS, settings={"n_episodes": 1})


def study_of(agents, environments=(SEGMENTS,), n_seeds=5):
    specs = [AgentSpec(label, algo, more, tuned=False) for label, (algo, more) in agents.items()]
    return StudySpec("s", "S", tuple(specs), environments, n_seeds=n_seeds, metric="regret")


@pytest.mark.parametrize(
    ("algo", "settings", "environment", "is_batch"),
    [
        ("ucb", {}, SEGMENTS, True),
        ("ucb", {"n_timesteps": 1001}, SEGMENTS, False),  # more than an episode
        ("ucb", {}, ONE_EPISODE, False),
        ("ucb", {"n_envs": 2}, SEGMENTS, False),
        ("ucb", {"env_wrapper": "gymnasium.wrappers.RecordEpisodeStatistics"}, SEGMENTS, False),
        ("dqn", {"policy": "MlpPolicy"}, SEGMENTS, False),
    ],
)
def test_what_goes_as_a_batch(algo, settings, environment, is_batch):
    runs = plan(study_of({"it": (algo, settings)}, (environment,), n_seeds=3), Path("nowhere"))
    assert [run.seed for run in runs] == ([0] if is_batch else [0, 1, 2])
    assert {(run.is_batch, run.n_runs) for run in runs} == {(is_batch, 3 if is_batch else 1)}


def test_a_batch_is_its_runs(tmp_path, do_study):
    """Those of each rule are compared with the agents, pull by pull."""
    study = study_of({"it": ("thompson", {})})
    batches, (planned,) = do_study(study, tmp_path), plan(study, tmp_path)
    folders = [tmp_path / str(seed) for seed in range(5)]
    for seed, folder in enumerate(folders):  # as train.py does each
        folder.mkdir()
        with Run(folder) as run:
            train(planned.spec.changed(seed=seed), run)
    rows = batches.summary
    assert rows["seed"].tolist() == [0, 1, 2, 3, 4]
    pulls = [pulls_in(folder) for folder in folders]
    assert rows["regret"].tolist() == [float(np.cumsum(each["regrets"][0])[-1]) for each in pulls]
    rewards = [each["rewards"].sum() for each in pulls]
    assert rows["training"].tolist() == rows["last_episodes"].tolist() == rewards
    assert len(set(rows["regret"])) > 1
    # What is told of runs that were done one by one is the same too, but for what a batch adds.
    ours = batches.pulls["it", "segments"]
    theirs = bandits.stacked_statistics(planned.spec, folders)
    for field in dataclasses.fields(bandits.PullStatistics):
        if field.name not in {"estimates", "estimates_std", "moments", "posteriors"}:
            one, other = getattr(ours, field.name), getattr(theirs, field.name)
            assert np.array_equal(one, other, equal_nan=True), field.name
    result = run_batch("thompson", {}, "SegmentBandit-v0", {}, range(5), 200)
    assert np.array_equal(ours.posteriors, result.posteriors[0])
    assert ours.moments.tolist() == [10, 100, 200]
    assert ours.estimates == pytest.approx(np.nanmean(result.estimates, axis=0))
    info = planned.recorded()
    assert (info["engine"], info["n_runs"], info["n_timesteps"]) == ("compiled batch", 5, 200)


def test_runs_beside_batches(tmp_path, do_study):
    """An agent of the library goes run by run, and its regret is counted over as many pulls."""
    ppo = {"policy": "MlpPolicy", "n_steps": 64, "batch_size": 64, "n_envs": 2}
    agents = {"ucb": ("ucb", {}), "ppo": ("ppo", ppo)}
    study = study_of(agents, (replace(SEGMENTS, settings={"n_timesteps": 100}),), n_seeds=3)
    results = do_study(study, tmp_path / "whole")
    found = results.pulls["ppo", "segments"]
    assert len(found.total_regret) == len(results.pulls["ucb", "segments"].total_regret) == 3
    assert found.pulls[-1] == results.pulls["ucb", "segments"].pulls[-1] == 100
    runs = [run for run in results.planned if run.agent == "ppo"]
    for run, regret in zip(runs, found.total_regret, strict=True):
        regrets = pulls_in(run.path)["regrets"]
        assert regrets.shape == (2, 64)
        in_time = regrets.T.ravel()[:100]
        assert np.array_equal(bandits.read_run(run.path, 100)["regrets"], in_time)
        assert bandits.run_regret(run) == pytest.approx(regret) == pytest.approx(in_time.sum())


@pytest.mark.parametrize(
    ("name", "expected"),
    [
        ("bernoulli", {"Thompson": 14.8, "UCB1": 82.0, "epsilon 0.1": 275.5, "random": 2666.7}),
        # The mean of LinUCB with alpha 0.2, 155, has a spread of 228 over runs.
        ("segments", {"Thompson by segment": 37, "Thompson, blind": 443, "LinUCB alpha=1": 31.0}),
    ],
)
def test_regret_of_ten_thousand_pulls(do_study, tmp_path, name, expected):
    """What is expected was measured over 5,000 to 40,000 runs by programs apart from this one.

    How well agents do is tested with the agents; here that a label stands for its agent.
    """
    study = studies.read_study(studies.find_study(f"bandit-{name}"))
    kept = tuple(spec for spec in study.agents if spec.label in expected)
    place = study.environments[0]
    study = replace(study, agents=kept, environments=(place,), n_seeds=30)
    results = do_study(study, tmp_path)
    found = {label: results.pulls[label, place.label] for label in expected}
    for label, statistics in found.items():
        # Four standard errors, and the last digit.
        within = 4 * statistics.total_regret.std() / 30**0.5 + 1
        assert statistics.total_regret.mean() == pytest.approx(expected[label], abs=within), label
        assert statistics.pulls[-1] == 10_000
    if name == "bernoulli":
        assert (found["UCB1"].cumulative_regret <= auer_bound(COINS, found["UCB1"].pulls)).all()
        # Less regret is better.
        (environment,) = analyse(results).environments
        assert [agent.agent for agent in environment.agents] == list(expected)
        assert environment.agents[0].regret == environment.agents[0].metric.mean
        assert {pair.word for pair in environment.pairs} == {"better"}
