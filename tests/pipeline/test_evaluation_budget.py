"""Sampled evaluation takes no more than its share, goes by steps, and says how much it took."""

import json
from dataclasses import replace

import gymnasium as gym
import numpy as np
import pytest
from rich.console import Console

from agents import load_algorithm
from pipeline.evaluation import sampled
from pipeline.evaluation.sampled import (
    Evaluation,
    SampledEvaluator,
    allowed_steps,
    evaluate,
    is_sure,
    shares_of,
)
from pipeline.settings.hyperparams import split
from pipeline.train_spec import TrainSpec
from pipeline.training import train

SMALL = {"policy": "MlpPolicy", "n_steps": 50, "batch_size": 50, "n_epochs": 1}


def spec_of(folder, algo="random", env="CartPole-v1", n_timesteps=3000, **fields):
    entry = {"n_timesteps": n_timesteps, **(SMALL if algo == "ppo" else {})}
    fields = {"eval_episodes": None, "final_episodes": None, "pictures": False, **fields}
    return TrainSpec(algo, env, split(entry), entry, seed=0, log_folder=folder, **fields)


def run_of(spec):
    return train(replace(spec, verbose=0), Console(quiet=True), {}, "")


def episodes(*returns, length=10):
    return Evaluation(np.array(returns, float), np.full(len(returns), length), None)


def test_when_a_mean_is_sure():
    assert is_sure(episodes(*[7.0] * 10), 0.01)
    assert not is_sure(episodes(*[7.0] * 5), 0.01), "five may be alike by chance"
    # 9 and 11 in turn: mean 10, standard deviation sqrt(10/9), standard error 1/3.
    assert is_sure(episodes(*[9.0, 11.0] * 5), 0.0334)
    assert not is_sure(episodes(*[9.0, 11.0] * 5), 0.0333)
    assert not is_sure(episodes(*[-1.0, 1.0] * 5), 0.5)


@pytest.mark.parametrize(
    ("algo", "engine_in_use", "plays_compiled", "of_long", "of_short"),
    [
        ("ppo", "library", False, 250_000, 2500),
        ("ppo", "library: it masks actions", False, 250_000, 2500),
        ("a2c", "library", False, 100_000, 2000),
        ("ppo", "compiled", True, 250_000, 2500),
        ("ppo", "compiled", False, 31_250, 2000),
        ("ppo", "compiled but for the environment: none is known", False, 31_250, 2000),
        ("qlearning", "interpreted: asked for", False, 10_000, 2000),
        ("qlearning", "compiled", True, 100_000, 2500),
        ("qlearning", "compiled", False, 2000, 2000),
    ],
)
def test_what_is_allowed(algo, engine_in_use, plays_compiled, of_long, of_short):
    env = gym.make("FrozenLake-v1")
    is_table = algo == "qlearning"
    model = load_algorithm(algo)(env=env, **({} if is_table else {"policy": "MlpPolicy"}))
    model.engine_in_use = engine_in_use
    found = shares_of(model, plays_compiled=plays_compiled)
    assert allowed_steps(1e6, found) == of_long
    assert allowed_steps(5000, found) == of_short
    assert allowed_steps(1, found) == sampled.STEPS_IN_ANY_CASE


def test_short_trainings_are_allowed_more():
    found = [allowed_steps(n, sampled.NETWORK) for n in (2000, 10_000, 20_000, 40_000, 60_000)]
    assert found == [2000, 5000, 10_000, 10_000, 15_000]


def played(monkeypatch, returns, length):
    """An evaluator whose episodes are made up, and a list of how many were asked for."""
    asked, left = [], list(returns)

    def evaluate(model, env, n_episodes, seed):
        asked.append((n_episodes, seed is None))
        return episodes(*[left.pop(0) for _ in range(n_episodes)], length=length)

    monkeypatch.setattr(sampled, "evaluate", evaluate)
    return asked


class Model:
    num_timesteps = 0
    _num_timesteps_at_start = 0
    policy = None


# Of so few steps of training, 2,000 steps of evaluation are allowed.
@pytest.mark.parametrize(
    ("returns", "length", "expected"),
    [
        ([1.0] * 100, 1, [10]),
        ([0.0, 9.0] * 50, 1, [10, 15, 25, 50]),
        ([0.0, 9.0] * 50, 50, [10, 15]),  # the next 25 would make it 2,500 steps
        ([0.0, 9.0] * 50, 190, [5]),  # the evaluation before took 1,900
        ([0.0, 9.0] * 50, 900, [5]),  # five there are in any case
    ],
)
def test_the_last_evaluation_ends_when_it_is_sure_or_dear(
    monkeypatch, tmp_path, returns, length, expected
):
    asked = played(monkeypatch, [*[3.0] * 10, *returns], length)
    evaluator = SampledEvaluator(spec_of(tmp_path), None)
    assert len(evaluator(Model()).returns) == 10
    asked.clear()
    found = evaluator.at_the_end(Model())
    assert [n for n, _ in asked] == expected
    assert [goes_on for _, goes_on in asked] == [False, *[True] * (len(expected) - 1)]
    assert len(found.returns) == sum(expected)
    assert evaluator.n_steps == (10 + sum(expected)) * length


def test_where_no_length_is_known_the_last_evaluation_begins_with_five(monkeypatch, tmp_path):
    asked = played(monkeypatch, [0.0, 9.0] * 50, length=100)
    SampledEvaluator(spec_of(tmp_path), None).at_the_end(Model())
    assert [n for n, _ in asked] == [5, 5]


@pytest.mark.parametrize(
    ("trained_on", "expected"),
    [([], [2000, 20_000, 30_000, 40_000]), ([900, *[200] * 5], [10_000, 20_000, 30_000, 40_000])],
)
def test_evaluations_are_left_out_while_they_are_too_dear(
    monkeypatch, tmp_path, trained_on, expected
):
    asked = played(monkeypatch, [1.0, 5.0] * 500, length=200)
    evaluator, model = SampledEvaluator(spec_of(tmp_path, n_timesteps=40_000), None), Model()
    model.ep_info_buffer = [{"l": length} for length in trained_on]
    done = []
    for step in range(2000, 40_001, 2000):
        model.num_timesteps = step
        if evaluator.can_afford(model, 0):
            evaluator(model)
            done.append(step)
    # Five episodes are 1,000 steps, and half of 8,000 are allowed over the whole training. How long
    # the first takes, training's episodes tell, if there are any.
    assert done == expected
    assert [n for n, _ in asked] == [5] * 4
    assert evaluator.n_steps == 4000


def test_what_is_asked_for_is_done(tmp_path):
    run = run_of(spec_of(tmp_path, eval_episodes=3, final_episodes=3)).run
    evaluations = np.load(run.evaluations_path)
    assert evaluations["results"].shape == (20, 3)
    assert "n_episodes" not in evaluations, "all have as many as there are columns"
    assert json.loads(run.info_path.read_text())["final"]["n_episodes"] == 3
    often = run_of(spec_of(tmp_path, eval_freq=10, n_timesteps=500)).run
    assert len(np.load(often.evaluations_path)["timesteps"]) == 50


def test_a_run_says_what_its_evaluations_took(tmp_path):
    outcome = run_of(spec_of(tmp_path, "ppo", n_timesteps=500))
    assert outcome.evaluation_steps > 0
    info = json.loads(outcome.run.info_path.read_text())
    assert info["evaluation_steps"] == outcome.evaluation_steps
    evaluations = np.load(outcome.run.evaluations_path)
    final, n_columns = info["final"], evaluations["results"].shape[1]
    counts = np.array(evaluations.get("n_episodes", [n_columns] * len(evaluations["timesteps"])))
    during = (evaluations["ep_lengths"].mean(axis=1) * counts).sum()
    assert outcome.evaluation_steps == during + final["mean_length"] * final["n_episodes"]
    assert info["best_episodes"] in counts
    assert outcome.evaluating.cpu_seconds > 0
    # Rows of fewer episodes are repeated, so that all tools read them.
    assert set(n_columns % counts) == {0}
    again = run_of(spec_of(tmp_path, "ppo", n_timesteps=500))
    for name, array in np.load(again.run.evaluations_path).items():
        np.testing.assert_array_equal(array, evaluations[name])


def test_further_episodes_are_others_and_always_the_same(tmp_path):
    from pipeline.environments import make_evaluation_env, make_training_env

    spec = spec_of(tmp_path, env="Blackjack-v1")
    from agents import load_algorithm

    env = make_evaluation_env(spec, 5)
    agent = load_algorithm("random")("RandomPolicy", make_training_env(spec, None), seed=0)
    agent.predict = lambda obs, **_: (np.zeros(len(obs[0]), int), None)  # stick
    first = evaluate(agent, env, 20, 1).returns
    more = evaluate(agent, env, 20, None).returns
    assert not np.array_equal(first, more)
    np.testing.assert_array_equal(evaluate(agent, env, 20, 1).returns, first)
    np.testing.assert_array_equal(evaluate(agent, env, 20, None).returns, more)


# --- the file ------------------------------------------------------------------------------------


def test_the_file_is_not_written_at_each_evaluation(tmp_path, monkeypatch):
    from pipeline import callbacks

    writes = []
    replacing = callbacks.replacing
    monkeypatch.setattr(callbacks, "replacing", lambda path: writes.append(path) or replacing(path))
    monkeypatch.setattr(callbacks, "SECONDS_BETWEEN_WRITES", 1e9)
    outcome = run_of(spec_of(tmp_path, "qlearning", "FrozenLake-v1", 2000))
    assert [path.name for path in writes] == ["evaluations.npz"] * 2, "the first, and at the end"
    assert len(np.load(outcome.run.evaluations_path)["timesteps"]) == 20


def test_what_a_broken_run_has_evaluated_is_there(tmp_path, monkeypatch):
    from pipeline import callbacks

    monkeypatch.setattr(callbacks, "SECONDS_BETWEEN_WRITES", 1e9)
    calls = []

    def broken(self, evaluation):
        calls.append(evaluation)
        if len(calls) == 7:
            raise RuntimeError("broken")

    monkeypatch.setattr(callbacks.EvaluationCallback, "_log", broken)
    with pytest.raises(RuntimeError, match="broken"):
        run_of(spec_of(tmp_path, "qlearning", "FrozenLake-v1", 2000))
    run = next((tmp_path / "qlearning").iterdir())
    assert len(np.load(run / "evaluations.npz")["timesteps"]) == 7
    assert json.loads((run / "run.json").read_text())["state"] == "failed"
