"""Evaluations repeat, count successes, and leave the training alone."""

import numpy as np
import pytest
import torch as th
from rich.console import Console
from stable_baselines3.common.env_util import make_vec_env
from stable_baselines3.common.vec_env import VecNormalize

from agents import load_algorithm
from pipeline.evaluation.sampled import Evaluation, evaluate, evaluation_seed
from pipeline.models.load import load_model
from pipeline.settings.hyperparams import split
from pipeline.train_spec import TrainSpec
from pipeline.training import train


def agent(name="random", env_id="FrozenLake-v1", **kwargs):
    algorithm = load_algorithm(name)
    return algorithm(next(iter(algorithm.policy_aliases)), env_id, seed=0, **kwargs)


def figures(evaluation):
    return evaluation.returns.tolist(), evaluation.lengths.tolist()


# --- figures -------------------------------------------------------------------------------------


def test_figures_worked_by_hand():
    evaluation = Evaluation(
        np.array([1.0, 3.0]), np.array([10, 20]), successes=np.array([True, False])
    )
    assert evaluation.summary() == {
        "mean_return": 2.0,
        "std_return": 1.0,
        "mean_length": 15.0,
        "success_rate": 0.5,
        "exact": False,
        "n_episodes": 2,
    }
    unknown = Evaluation(evaluation.returns, evaluation.lengths, None)
    assert unknown.summary() == {**evaluation.summary(), "success_rate": None}
    kinds = {name: type(value) for name, value in evaluation.summary().items()}
    assert set(kinds.values()) == {float, int, bool}


# --- seeds ---------------------------------------------------------------------------------------


@pytest.mark.parametrize("n_envs", [1, 4])
def test_the_same_seed_gives_the_same_episodes(n_envs):
    model = agent("qlearning").learn(2000)
    env = make_vec_env("FrozenLake-v1", n_envs)
    first = evaluate(model, env, 12, seed=5)
    assert len(first.returns) == 12
    # Whatever was played meanwhile.
    other = evaluate(model, env, 12, seed=6)
    assert figures(evaluate(model, env, 12, seed=5)) == figures(first)
    assert figures(evaluate(model, make_vec_env("FrozenLake-v1", n_envs), 12, seed=5)) == figures(
        first
    )
    assert figures(other) != figures(first)


def test_seeds_of_all_purposes_lie_apart():
    """From each other's and from training's, whose environments count up from the run's seed."""
    n_seeds, n_envs = 500, 100
    seeds = {
        (seed, purpose): evaluation_seed(seed, purpose)
        for seed in range(n_seeds)
        for purpose in (1, 2, 3)
    }
    assert all(0 <= seed < 2**31 for seed in seeds.values())
    assert len(set(seeds.values())) == len(seeds)
    for seed in range(n_seeds):
        starts = sorted([seed, *(seeds[seed, purpose] for purpose in (1, 2, 3))])
        assert min(np.diff(starts)) > n_envs
    assert seeds == {key: evaluation_seed(*key) for key in seeds}


def test_seeds_lead_to_other_episodes():
    model = agent("qlearning").learn(2000)
    env = make_vec_env("FrozenLake-v1", 1)
    starts = [0, *(evaluation_seed(0, purpose) for purpose in (1, 2, 3))]
    played = [figures(evaluate(model, env, 20, seed=seed)) for seed in starts]
    assert all(played[i] != played[j] for i in range(4) for j in range(i))


# --- what is played ------------------------------------------------------------------------------


def test_deterministic_play_is_the_policys_best():
    model = agent("qlearning", exploration_initial_eps=1.0)
    model.policy.q_tables.zero_()
    model.policy.q_tables[..., 2] = 1.0
    env = make_vec_env("FrozenLake-v1", 1, env_kwargs={"is_slippery": False})
    # Always to the right: along the upper edge until the time limit.
    best = evaluate(model, env, 5, seed=0)
    assert best.lengths.tolist() == [100] * 5
    exploring = evaluate(model, env, 5, seed=0, deterministic=False)
    assert exploring.lengths.tolist() != best.lengths.tolist()


def test_returns_are_those_of_the_environment_itself():
    env = VecNormalize(make_vec_env("CartPole-v1", 2), training=False, norm_reward=True)
    evaluation = evaluate(agent("angle", "CartPole-v1"), env, 6, seed=0)
    assert evaluation.returns.tolist() == evaluation.lengths.tolist()
    assert evaluation.returns.dtype == np.float64


# --- successes -----------------------------------------------------------------------------------


def test_successes_are_counted_where_the_environment_tells_them():
    env_kwargs = {"slip": 0.3, "shelf_reward": -1, "max_episode_steps": 40}
    model = agent("qlearning", "envs:Warehouse-v0", learning_rate=0.3).learn(60_000)
    env = make_vec_env("envs:Warehouse-v0", 4, env_kwargs=env_kwargs)
    evaluation = evaluate(model, env, 200, seed=0)
    # Each move costs 1, and the last one brings 100 if it succeeds.
    failed = evaluation.returns == -evaluation.lengths
    np.testing.assert_array_equal(evaluation.successes, ~failed)
    np.testing.assert_array_equal(evaluation.returns[~failed], 101.0 - evaluation.lengths[~failed])
    assert (evaluation.lengths[failed] == 40).all()
    assert 0.05 < evaluation.success_rate < 0.95
    assert evaluation.success_rate == evaluation.successes.mean()


@pytest.mark.parametrize(("action", "success"), [(3, 1.0), (2, 0.0)])
def test_always_and_never(action, success):
    model = agent("qlearning", "envs:Warehouse-v0")
    model.policy.q_tables.zero_()
    model.policy.q_tables[..., action] = 1.0
    kwargs = {"desc": ["S" + "." * 98 + "G"], "max_episode_steps": 99}
    env = make_vec_env("envs:Warehouse-v0", 2, env_kwargs=kwargs)
    evaluation = evaluate(model, env, 4, seed=0)
    assert evaluation.success_rate == success
    assert evaluation.successes.dtype == bool


def test_an_environment_that_does_not_tell_has_no_success_rate():
    evaluation = evaluate(agent("random"), make_vec_env("FrozenLake-v1", 1), 5, seed=0)
    assert evaluation.successes is None
    assert evaluation.success_rate is None


# --- training is not disturbed -------------------------------------------------------------------

TINY = {
    "qlearning": {"policy": "QTablePolicy"},
    "sarsa": {"policy": "QTablePolicy", "n_envs": 3},
    "dqn": {
        "policy": "MlpPolicy",
        "policy_kwargs": {"net_arch": [8]},
        "buffer_size": 500,
        "learning_starts": 50,
        "batch_size": 8,
    },
    "ppo": {
        "policy": "MlpPolicy",
        "policy_kwargs": {"net_arch": [8]},
        "n_steps": 32,
        "batch_size": 32,
        "n_epochs": 2,
        "n_envs": 2,
        "normalize": True,
    },
}


def trained(name, folder, eval_freq):
    env_id = "CartPole-v1" if name == "ppo" else "FrozenLake-v1"
    entry = {"n_timesteps": 400, **TINY[name]}
    spec = TrainSpec(
        name,
        env_id,
        split(entry),
        entry,
        seed=0,
        eval_freq=eval_freq,
        eval_episodes=3,
        log_folder=folder,
        device="cpu",
    )
    outcome = train(spec, Console(quiet=True), {}, "")
    return outcome, load_model(name, outcome.run.model_path, device="cpu")


@pytest.mark.parametrize("name", TINY)
def test_training_is_the_same_with_and_without_evaluations(name, tmp_path):
    evaluated, with_evaluations = trained(name, tmp_path, eval_freq=40)
    unevaluated, without = trained(name, tmp_path, eval_freq=-1)
    assert len(np.load(evaluated.run.evaluations_path)["timesteps"]) >= 10
    assert not unevaluated.run.evaluations_path.exists()
    assert (evaluated.final is None, unevaluated.final is None) == (False, True)
    parameters = with_evaluations.policy.state_dict()
    assert len(parameters) > 0
    for key, value in without.policy.state_dict().items():
        assert th.equal(parameters[key], value), key
    rows = [
        [
            [line.rsplit(",", 1)[0] for line in path.read_text().splitlines()[2:]]
            for path in sorted(outcome.run.path.glob("*.monitor.csv"))
        ]
        for outcome in (evaluated, unevaluated)
    ]
    assert rows[0] == rows[1]
    assert sum(map(len, rows[0])) > 5
    if name == "ppo":
        statistics = [
            VecNormalize.load(str(outcome.run.vecnormalize_path), make_vec_env("CartPole-v1", 1))
            for outcome in (evaluated, unevaluated)
        ]
        np.testing.assert_array_equal(statistics[0].obs_rms.mean, statistics[1].obs_rms.mean)
        np.testing.assert_array_equal(statistics[0].ret_rms.var, statistics[1].ret_rms.var)
