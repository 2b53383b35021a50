"""Evaluation in compiled code plays the episodes that evaluation in Python plays."""

from functools import partial

import numpy as np
import pytest
import torch as th
from gymnasium.wrappers import RecordEpisodeStatistics
from stable_baselines3.common.env_util import make_vec_env

from agents import load_algorithm
from agents.compiled.greedy_play import play_episodes
from agents.compiled.worlds import compile_envs
from agents.networks.network_worlds import NetworkEnvStates, network_world
from agents.networks.q_learning import choose_greedily
from envs.wrappers import DiscretizeObservation
from pipeline.evaluation.sampled import SampledEvaluator, compiled_copy, evaluate, evaluate_compiled

CART, CAR = "CartPole-v1", "MountainCar-v0"
WIDTHS = {"low": [-2.4, -3.0, -0.21, -3.0], "high": [2.4, 3.0, 0.21, 3.0]}
IN_BINS = partial(DiscretizeObservation, bins=[1, 6, 12, 6], **WIDTHS)
SMALL = {"policy": "MlpPolicy", "policy_kwargs": {"net_arch": [16]}}


def environments(env_id, wrapper=None, n=5):
    return make_vec_env(env_id, n, wrapper_class=wrapper)


def trained(algo, env_id, wrapper, n_timesteps, **settings):
    env = environments(env_id, wrapper, 1)
    model = load_algorithm(algo)(env=env, seed=1, engine="compiled", **settings)
    return model.learn(n_timesteps)


def both(model, env_id, wrapper, plays):
    """The evaluations, on environments of their own in each way."""
    compiled, plain = environments(env_id, wrapper), environments(env_id, wrapper)
    copy = compiled_copy(compiled)
    ours = [evaluate_compiled(model, copy, *play) for play in plays]
    return zip(ours, [evaluate(model, plain, *play) for play in plays], strict=True)


@pytest.mark.parametrize(
    ("algo", "env_id", "wrapper", "n_timesteps", "settings"),
    [
        ("qlearning", CART, IN_BINS, 30_000, {}),
        ("double_qlearning", CART, IN_BINS, 30_000, {}),
        ("semi_gradient_sarsa", CAR, None, 20_000, {}),
        ("reinforce", CART, None, 5000, WIDTHS),
    ],
)
def test_tables_and_tiles_play_the_same_bits(algo, env_id, wrapper, n_timesteps, settings):
    model = trained(algo, env_id, wrapper, n_timesteps, **settings)
    # More than one go, and further episodes that go on from where the generators were left.
    plays = [(5, 1), (23, None), (2, None), (5, 0)]
    for ours, plain in both(model, env_id, wrapper, plays):
        np.testing.assert_array_equal(ours.returns, plain.returns)
        np.testing.assert_array_equal(ours.lengths, plain.lengths)
        assert (ours.returns.dtype, ours.lengths.dtype) == (plain.returns.dtype, np.int64)
        assert ours.successes is plain.successes is None


@pytest.mark.parametrize(
    ("algo", "env_id", "settings"), [("ppo", CART, {"n_steps": 256}), ("dqn", CAR, {})]
)
def test_networks_agree_with_the_library(algo, env_id, settings):
    model = trained(algo, env_id, None, 3000, **SMALL, **settings)
    ((ours, plain), (more, plain_more)) = both(model, env_id, None, [(60, 1), (7, None)])
    np.testing.assert_array_equal(ours.returns, plain.returns)
    np.testing.assert_array_equal(more.lengths, plain_more.lengths)


def test_networks_choose_the_librarys_action_wherever_two_are_told_apart():
    model = trained("ppo", CART, None, 2048, policy="MlpPolicy", n_steps=256)
    _, seen = network_world(environments(CART))
    network = model.greedy_player(seen).network
    shown = np.random.default_rng(0).normal(size=(5000, 4)).astype(np.float32)
    chosen = np.zeros(len(shown), np.int64)
    for i, vector in enumerate(shown):
        network.held.single.vectors[0] = vector
        chosen[i] = choose_greedily(network, 0.0, 0.0)
    with th.no_grad():
        logits = model.policy.get_distribution(th.from_numpy(shown)).distribution.logits.numpy()
    ends = np.sort(logits, axis=1)
    is_clear = ends[:, -1] - ends[:, -2] > 1e-5
    assert is_clear.mean() > 0.99
    np.testing.assert_array_equal(chosen[is_clear], logits.argmax(axis=1)[is_clear])


def test_a_network_is_played_as_it_is_now():
    model = trained("dqn", CART, None, 200, **SMALL)
    env = environments(CART)
    copy = compiled_copy(env)
    for bias in ([9.0, 0.0], [0.0, 9.0]):
        with th.no_grad():
            model.q_net.q_net[-1].bias[:] = th.tensor(bias)
        ours = evaluate_compiled(model, copy, 5, 3)
        np.testing.assert_array_equal(
            ours.returns, evaluate(model, environments(CART), 5, 3).returns
        )
        assert ours.mean_return < 12


def test_what_is_not_compiled_is_played_in_python():
    assert compiled_copy(environments("Acrobot-v1")) is None
    assert compiled_copy(environments(CART, RecordEpisodeStatistics)) is None
    assert compiled_copy(environments("FrozenLake-v1")) is None, "there, evaluation is exact"
    assert compiled_copy(environments(CART)) is not None


def test_many_steps_take_more_than_one_go(monkeypatch):
    model = trained("qlearning", CART, IN_BINS, 5000)
    env = environments(CART, IN_BINS)
    states = NetworkEnvStates(env, compile_envs(env), network_world(env)[1])

    def played():
        env.seed(4)
        player = model.greedy_player(states.seen)
        return play_episodes(
            compile_envs(env), player, states, env.reset(), np.array([3, 1, 0, 2, 1])
        )

    at_once = played()
    monkeypatch.setattr("agents.compiled.greedy_play.STEPS_AT_ONCE", 7)
    in_parts = played()
    assert np.bincount(at_once.envs).tolist() == [3, 1, 0, 2, 1]
    np.testing.assert_array_equal(in_parts.returns, at_once.returns)
    np.testing.assert_array_equal(in_parts.envs, at_once.envs)


@pytest.mark.parametrize(("engine", "expected"), [("compiled", True), ("interpreted", False)])
def test_an_agent_is_evaluated_by_the_engine_that_trained_it(engine, expected, monkeypatch):
    from pipeline.evaluation import sampled

    env = environments(CART, IN_BINS, 1)
    model = load_algorithm("qlearning")(env=env, seed=1, engine=engine).learn(100)
    used = []
    for name in ("evaluate_compiled", "evaluate"):
        found = getattr(sampled, name)
        monkeypatch.setattr(
            sampled, name, lambda *given, found=found, name=name: used.append(name) or found(*given)
        )
    evaluator = SampledEvaluator.__new__(SampledEvaluator)
    vars(evaluator).update(env=environments(CART, IN_BINS), seed=0, n_steps=0, yardstick=None)
    evaluator._evaluate(model, (5,), 0.1, 1e9, purpose=1)
    assert used == ["evaluate_compiled" if expected else "evaluate"]
