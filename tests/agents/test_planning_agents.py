"""Agents that plan: the known optima, zips that bring plans back, and time kept track of."""

import re

import gymnasium as gym
import numpy as np
import pytest
from stable_baselines3.common.env_util import make_vec_env
from stable_baselines3.common.evaluation import evaluate_policy

import envs  # noqa: F401
from agents.planning import Optimal, PolicyIteration, ValueIteration
from envs.known_models import time_limit, transition_model
from mdp import finite_horizon_optimum, policy_return, value_iteration


def planned(algorithm, env_id, gamma=None, **kwargs):
    env = make_vec_env(env_id, 1, seed=0, env_kwargs=kwargs)
    return algorithm(env=env, gamma=gamma, seed=0).learn(1)


@pytest.mark.parametrize(
    ("env_id", "kwargs", "by_values", "optimum"),
    [
        ("Warehouse-v0", {}, 79, 79),
        ("MineMaze-v0", {}, 91, 91),
        ("FrozenLake-v1", {}, 0.7402, 0.7442),
        ("FrozenLake8x8-v1", {}, 0.8630, 0.9132),
        ("CliffWalking-v1", {"max_episode_steps": 200}, -13, -13),
    ],
)
def test_the_known_returns(env_id, kwargs, by_values, optimum):
    env = gym.make(env_id, **kwargs)
    model, horizon = transition_model(env), time_limit(env)
    for algorithm, expected in ((ValueIteration, by_values), (Optimal, optimum)):
        agent = planned(algorithm, env_id, **kwargs)
        steps = np.arange(horizon)[:, None]
        policy = agent.policy.actions_after(np.arange(model.n_states)[None], steps)
        result = policy_return(model, policy, horizon).expected_return
        assert result == pytest.approx(expected, abs=5e-5)


WITH_A_MODEL = {
    "Warehouse-v0": {"slip": 0.2},
    "MineMaze-v0": {},
    "FrozenLake-v1": {},
    "CliffWalking-v1": {},
    "Taxi-v4": {},
    "RandomWalk-v0": {},
    "WindyGridworld-v0": {},
    "DynaMaze-v0": {},
    "GamblersProblem-v0": {},
    "MaximizationBias-v0": {},
    "RiverSwim-v0": {},
    "DeepSea-v0": {},
}


@pytest.mark.parametrize("gamma", [0.9, 1.0])
@pytest.mark.parametrize("env_id", WITH_A_MODEL)
def test_plans_by_values_and_by_policies_are_worth_the_same(env_id, gamma):
    """From each state, also where ties let the two choose other actions."""
    kwargs = WITH_A_MODEL[env_id]
    model = transition_model(gym.make(env_id, **kwargs))
    try:
        optimum = value_iteration(model, gamma).values[model.reachable]
    except ValueError as refusal:  # an undiscounted optimum that is not finite
        with pytest.raises(ValueError, match=re.escape(str(refusal))):
            planned(PolicyIteration, env_id, gamma=gamma, **kwargs)
        return
    for algorithm in (ValueIteration, PolicyIteration):
        actions = planned(algorithm, env_id, gamma=gamma, **kwargs).policy.actions.numpy()[0]
        # Where one action is allowed, the optimum is what the policy is worth.
        alone = np.eye(model.n_actions, dtype=bool)[actions[: model.n_states]]
        worth = value_iteration(model, gamma, mask=alone).values[model.reachable]
        np.testing.assert_allclose(worth, optimum, atol=1e-8, rtol=1e-9)


@pytest.mark.parametrize("algorithm", [ValueIteration, PolicyIteration, Optimal])
def test_zip_brings_the_plan_back(algorithm, tmp_path):
    agent = planned(algorithm, "FrozenLake-v1")
    agent.save(tmp_path / "agent")
    loaded = algorithm.load(tmp_path / "agent")
    assert loaded.policy.actions.equal(agent.policy.actions)
    assert int(loaded.policy.horizon) == int(agent.policy.horizon)


def test_predict_keeps_the_time_of_each_episode_apart():
    agent = planned(Optimal, "FrozenLake-v1")
    plan = finite_horizon_optimum(transition_model(gym.make("FrozenLake-v1")), 100)
    # A state whose best action changes towards the end of the time.
    changing = np.flatnonzero((plan.policy != plan.policy[0]).any(axis=0))
    assert len(changing) > 0
    state = None
    starts = np.ones(2, dtype=bool)
    for step in range(100):
        obs = np.array([changing[0], changing[0]])
        # The second episode begins anew at each call.
        starts = np.array([step == 0, True])
        actions, state = agent.predict(obs, state, starts)
        assert actions.tolist() == [plan.policy[step][changing[0]], plan.policy[0][changing[0]]]


def test_training_plays_the_optimal_return():
    env = make_vec_env("Warehouse-v0", 1, seed=0)
    agent = Optimal(env=env, seed=0).learn(220)
    assert [episode["r"] for episode in agent.ep_info_buffer] == [79.0] * 10
    assert evaluate_policy(agent, env, 3)[0] == 79


def test_an_unknown_model_is_refused():
    agent = ValueIteration(env=gym.wrappers.TransformReward(gym.make("FrozenLake-v1"), float))
    with pytest.raises(ValueError, match="transition model is known"):
        agent.learn(1)


def test_the_optimum_needs_a_time_limit():
    with pytest.raises(ValueError, match="needs a time limit"):
        Optimal(env=gym.make("CliffWalking-v1")).learn(1)
