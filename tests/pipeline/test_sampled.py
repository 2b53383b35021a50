"""Sampled evaluation: it repeats, leaves training alone, takes its share, and has a yardstick."""

from functools import partial

import gymnasium as gym
import numpy as np
import pytest
import torch as th
from gymnasium.envs.registration import EnvSpec
from stable_baselines3.common.env_util import make_vec_env

from rl_yardstick.agents import load_algorithm
from rl_yardstick.agents.compiled import engine
from rl_yardstick.envs.wrappers import DiscretizeObservation
from rl_yardstick.pipeline.environments import make_envs, make_training_env
from rl_yardstick.pipeline.evaluation import sampled
from rl_yardstick.pipeline.evaluation.sampled import evaluate, evaluation_seed
from rl_yardstick.pipeline.evaluation.yardstick import Evaluation, Yardstick
from rl_yardstick.pipeline.models import load
from tests.pipeline.short_runs import CART, LAKE, Steady, agent_of, run_of, spec_of

PURPOSES = (1, 2, 3, 4)  # in training, at its end, of the page's film, of films of training


def figures(evaluation):
    return evaluation.returns.tolist(), evaluation.lengths.tolist()


def episodes(*returns, yardstick):
    return Evaluation(np.array(returns), np.full(len(returns), 10), None, yardstick=yardstick)


def test_the_same_seed_gives_the_same_episodes_whatever_was_played_meanwhile():
    n_envs, model = 4, agent_of("qlearning", LAKE).learn(2000)
    env = make_vec_env(LAKE, n_envs)
    first, more = (figures(evaluate(model, env, 12, seed)) for seed in (5, None))
    others = [figures(evaluate(model, env, 12, evaluation_seed(0, p))) for p in PURPOSES]
    assert len(first[0]) == 12
    for again in (env, make_vec_env(LAKE, n_envs)):
        assert [figures(evaluate(model, again, 12, seed)) for seed in (5, None)] == [first, more]
    different = [first, more, *others]
    assert all(a != b for i, a in enumerate(different) for b in different[:i])


def test_seeds_of_all_purposes_lie_apart_and_tuning_and_judgement_share_no_stream():
    starts = [[seed, *(evaluation_seed(seed, p) for p in PURPOSES)] for seed in range(500)]
    evaluations = [start for row in starts for start in row[1:]]
    assert all(0 <= seed < 2**31 for seed in evaluations)
    assert len(set(evaluations)) == len(evaluations)
    assert all(min(np.diff(sorted(row))) > 100 for row in starts)  # environments

    def seeds_of_runs(seeds):
        """Of agents and evaluations, and of environments of any two entries."""
        first = [evaluation_seed(seed, p) for seed in seeds for p in PURPOSES]
        begun = [start + i for start in first for i in range(10)]
        environments = (range(seeds.start * n, seeds.stop * n) for n in range(1, 33))
        return {*seeds, *begun}.union(*environments)

    assert not seeds_of_runs(range(10)) & seeds_of_runs(range(1000, 1010))


def steady(monkeypatch, returns, length, n_timesteps):
    """The spec of a run on episodes of one length."""
    monkeypatch.setitem(gym.registry, "Steady-v0", EnvSpec("Steady-v0", Steady))
    entry = {"env_kwargs": {"returns": returns, "length": length}, "n_timesteps": n_timesteps}
    return spec_of("random", "Steady-v0", entry, n_eval_envs=1)


# Of so few steps of training, 2,000 steps of evaluation are allowed.
@pytest.mark.parametrize(
    ("returns", "length", "n_episodes"),
    [
        ([1.0], 1, 10),
        ([0.0, 9.0], 1, 100),
        ([0.0, 9.0], 50, 25),  # the next 25 would make it 2,500 steps
        ([0.0, 9.0], 900, 5),  # five there are in any case
    ],
)
def test_the_last_evaluation_ends_when_it_is_sure_or_dear(monkeypatch, returns, length, n_episodes):
    spec = steady(monkeypatch, returns, length, 3000)
    evaluator = sampled.SampledEvaluator(spec, make_envs(spec, 1))
    found = evaluator.at_the_end(agent_of("random", make_training_env(spec, None)))
    assert len(found.returns) == n_episodes
    assert evaluator.n_steps == n_episodes * length


def test_evaluations_are_too_dear_before_an_episode_has_ended(tmp_path, monkeypatch):
    """The last one is then the only point of the curve, and the best."""
    run, outcome = run_of(steady(monkeypatch, [1.0, 5.0], 900, 1000), tmp_path)
    assert (outcome.evaluation_steps, outcome.evaluation.best_timesteps) == (4500, 1000)
    with np.load(run.path / "evaluations.npz") as evaluations:
        assert evaluations["timesteps"].tolist() == [1000]
        assert evaluations["results"].tolist() == [outcome.final.returns.tolist()]


@pytest.mark.parametrize(("late", "best"), [(9.0, [100, 50]), (-9.0, [50, 5])])
def test_the_last_evaluation_may_be_the_best(tmp_path, monkeypatch, late, best):
    spec = steady(monkeypatch, [1.0] * 20 + [late] * 100, 1, 100)
    spec = spec.changed(eval_freq=50, eval_episodes=5, final_episodes=50)
    run, outcome = run_of(spec, tmp_path)
    record = run.recorded()
    assert [record["best_timesteps"], record["best_episodes"]] == best
    assert record["best_mean_return"] == max(1.0, outcome.final.mean_return)
    with np.load(run.path / "evaluations.npz") as evaluations:
        assert evaluations["results"].tolist() == [[1.0] * 5] * 2
    assert load(spec, run.best_model_path, None).num_timesteps == best[0]


def test_evaluations_are_left_out_while_they_are_too_dear(tmp_path, monkeypatch):
    """Five episodes are 75 steps, and half of 300 are allowed over the whole training."""
    monkeypatch.setattr(sampled, "STEPS_IN_ANY_CASE", 0)  # in so short a training
    run, _ = run_of(steady(monkeypatch, [1.0, 5.0], 15, 1500), tmp_path)
    with np.load(run.path / "evaluations.npz") as evaluations:
        assert evaluations["timesteps"].tolist() == [750, 1500]
        assert evaluations["results"].shape == (2, 5)


POLE = Yardstick(optimum=500.0, baseline=20.0, at_least=480.0)


def test_the_upper_end_measures_and_the_lower_stands_beside_it():
    figures = episodes(260.0, 260.0, yardstick=POLE).summary()
    assert (figures["optimum"], figures["optimum_at_least"]) == (500, 480)
    assert (figures["gap"], figures["gap_at_least"]) == (240, 220)
    assert (figures["score"], figures["score_at_most"]) == (0.5, pytest.approx(240 / 460))
    assert not figures["exact"]
    known = episodes(80.0, yardstick=Yardstick(100.0, 60.0)).summary()
    assert known["score"] == 0.5
    assert not {"optimum_at_least", "gap_at_least", "score_at_most"} & known.keys()
    guessed = sampled.bracketed_yardstick(spec_of("random", "Acrobot-v1"))
    assert guessed == Yardstick(-38.0, -498.625, -60.408, is_proven=False)
    assert episodes(-40.0, yardstick=guessed).summary()["optimum_is_proven"] is False


WIDTHS = {"low": [-2.4, -3.0, -0.21, -3.0], "high": [2.4, 3.0, 0.21, 3.0]}
IN_BINS = partial(DiscretizeObservation, bins=[1, 6, 12, 6], **WIDTHS)
SMALL = {"policy": "MlpPolicy", "policy_kwargs": {"net_arch": [16]}}


@pytest.mark.parametrize(
    ("algo", "env_id", "wrapper", "settings"),
    [
        ("double_qlearning", CART, IN_BINS, {}),
        ("reinforce", CART, None, WIDTHS),
        ("dqn", "MountainCar-v0", None, SMALL),
    ],
)
def test_compiled_play_is_the_same_to_the_bit(monkeypatch, algo, env_id, wrapper, settings):
    """Of tables, tiles and networks with numbers of all kinds."""
    env, ours, plain = (make_vec_env(env_id, n, wrapper_class=wrapper) for n in (1, 5, 5))
    model = load_algorithm(algo)(env=env, seed=1, **settings)
    generator = th.Generator().manual_seed(0)
    for numbers in model.policy.state_dict().values():
        if numbers.is_floating_point():
            numbers.add_(th.randn(numbers.shape, generator=generator, dtype=numbers.dtype))
    copy = engine.compiled_copy(ours)
    # More than one go, and further episodes that go on from where the generators were left.
    for i, play in enumerate([(5, 1), (23, None), (2, None), (5, 0)]):
        if i == 2:
            monkeypatch.setattr(engine, "STEPS_AT_ONCE", 7)
        found = sampled.evaluate_compiled(model, copy, *play)
        expected = evaluate(model, plain, *play)
        assert figures(found) == figures(expected)
        assert (found.returns.dtype, found.lengths.dtype) == (expected.returns.dtype, np.int64)
        assert found.successes is expected.successes is None
    # Where evaluation is exact, or nothing is compiled, there is no copy.
    copies = [engine.compiled_copy(make_vec_env(name, 1)) for name in (LAKE, "Acrobot-v1")]
    assert copies == [None] * 2
