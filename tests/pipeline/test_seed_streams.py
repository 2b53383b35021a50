"""Which seeds a run uses, and that runs for tuning share none with runs for judgement."""

from dataclasses import replace
from pathlib import Path

import pytest
from gymnasium.utils import seeding

from agents import load_algorithm
from pipeline.agent_settings import resolved_spec, without_auto
from pipeline.environments import make_evaluation_env, make_training_env
from pipeline.evaluation.sampled import evaluate, evaluation_seed
from pipeline.settings import hyperparams
from pipeline.settings.hyperparams import TUNED_ON, read_hyperparams, split
from pipeline.settings.yaml import read_yaml
from pipeline.train_spec import TrainSpec

PURPOSES = (1, 2, 3, 4)  # in training, at its end, of the page's film, of films of training
FILES = sorted((Path(hyperparams.__file__).parents[2] / "hyperparams").glob("*.yml"))
TUNED, JUDGED = range(10), range(1000, 1010)


def spec_of(algo, env_id, seed=0, **changes):
    raw = {**read_hyperparams(algo, env_id), **changes}
    return resolved_spec(raw, algo=algo, env_id=env_id, seed=seed)


def seeds_of_run(n_envs, seed, n_eval_envs=TrainSpec.n_eval_envs):
    """All seeds of environments, of action spaces and of the agent."""
    starts = [evaluation_seed(seed, purpose) for purpose in PURPOSES]
    evaluations = (range(start, start + n_eval_envs) for start in starts)
    return set(range(seed, seed + n_envs)).union(*evaluations)


@pytest.fixture
def seeds_taken(monkeypatch):
    """The seeds of generators that Gymnasium makes, for environments and for spaces."""
    taken, make = set(), seeding.np_random

    def watched(seed=None):
        taken.update([] if seed is None else [seed])
        return make(seed)

    monkeypatch.setattr(seeding, "np_random", watched)
    return taken


@pytest.mark.parametrize("algo", ["qlearning", "ppo"])
def test_a_run_takes_the_seeds_that_are_said(algo, seeds_taken):
    spec = replace(spec_of(algo, "FrozenLake-v1", 7, n_envs=3, n_timesteps=12), n_eval_envs=2)
    settings = {"n_steps": 4, "batch_size": 4} if algo == "ppo" else {}
    env = make_training_env(spec, None)
    agent = load_algorithm(algo)(
        "QTablePolicy" if algo == "qlearning" else "MlpPolicy", env, seed=7, **settings
    ).learn(12)
    assert seeds_taken == {7, 8, 9}
    seeds_taken.clear()
    evaluation = make_evaluation_env(spec, spec.n_eval_envs)
    evaluate(agent, evaluation, 4, evaluation_seed(7, 1))
    assert seeds_taken == {evaluation_seed(7, 1), evaluation_seed(7, 1) + 1}
    assert {7, 8, 9} | seeds_taken <= seeds_of_run(3, 7, spec.n_eval_envs)


def test_tuning_and_judgement_share_no_stream():
    """With every shipped entry, and with any two of them: runs of one study may be of several."""
    entries = [entry for path in FILES for key, entry in read_yaml(path).items() if key != TUNED_ON]
    numbers = {split(without_auto(entry)).n_envs for entry in entries}
    assert numbers == {1, 4, 8, 16, 32}
    tuned, judged = (
        set().union(*(seeds_of_run(n_envs, seed) for n_envs in numbers for seed in seeds))
        for seeds in (TUNED, JUDGED)
    )
    assert not tuned & judged


def test_neighbouring_runs_share_seeds_of_environments_where_there_are_several():
    """So they are not quite independent: docs/statistics.md says how much that matters."""
    assert len(seeds_of_run(8, 0) & seeds_of_run(8, 1)) == 7
    assert not seeds_of_run(8, 0) & seeds_of_run(8, 8)
    assert not seeds_of_run(1, 0) & seeds_of_run(1, 1)
