"""Agents that explore by optimism: what is seldom tried looks good to them."""

import gymnasium as gym
import numpy as np
import pytest
from stable_baselines3.common.env_util import make_vec_env

import envs  # noqa: F401  # registers the environments
from agents import load_algorithm
from agents.compiled.worlds import ENV, PROGRESS
from agents.tabular.optimism import optimistic_update
from agents.tabular.updates import learn_from_all
from envs.known_models import time_limit, transition_model
from mdp import finite_horizon_optimum, policy_return
from tests.agents.test_engine import assert_engines_agree, make
from tests.agents.test_temporal_difference import Spaces

DEEP_SEA, RIVER = ("DeepSea-v0", {"size": 10}), ("RiverSwim-v0", {})


def test_one_update_by_hand():
    """Twice the same step: state 0, action 1, reward 2, then state 1; H = 3, bonus 6 / sqrt(N)."""
    model = load_algorithm("qlearning_ucb")(
        env=Spaces(2, 2), gamma=0.5, value_bound=10.0, bonus_scale=6.0, horizon=3.0
    )
    table = model.policy.q_tables.numpy()[0]
    assert (table == 10).all()
    table[1] = [4.0, 8.0]
    agent, env = model.compiled_agent(model.rng), np.zeros(1, dtype=ENV)[0]
    for name, value in {"action": 1, "reward": 2.0, "next_obs": 1}.items():
        env[name] = value
    # The first target replaces what was there: 2 + 6 + 0.5 * 8.
    assert optimistic_update(agent, env) == 2.0
    assert table[0].tolist() == [10.0, 12.0]
    # The second weighs 4/5, and the state that follows counts for 10 at most, though it shows 30.
    table[1, 0] = 30.0
    target = 2 + 6 / np.sqrt(2) + 0.5 * 10
    assert optimistic_update(agent, env) == target - 12
    assert table[0, 1] == pytest.approx(12 + 0.8 * (target - 12), rel=1e-15)
    # The third weighs 4/6; nothing follows.
    env["terminated"], before = True, table[0, 1]
    assert optimistic_update(agent, env) == 2 + 6 / np.sqrt(3) - before
    assert table[0, 1] == pytest.approx(before + 4 / 6 * (2 + 6 / np.sqrt(3) - before), rel=1e-15)
    assert model.policy.visit_counts[0].tolist() == [[0, 3], [0, 0]]


def test_without_a_horizon_it_is_the_mean_of_the_targets():
    model = load_algorithm("qlearning_ucb")(
        env=Spaces(1, 1), gamma=0.9, bonus_scale=0.0, horizon=0.0
    )
    agent = model.compiled_agent(model.rng)
    rewards = [4.0, 1.0, 7.0, -2.0]
    for reward in rewards:
        env = np.zeros(1, dtype=ENV)[0]
        env["reward"], env["terminated"] = reward, True
        optimistic_update(agent, env)
    assert model.policy.q_table[0, 0] == pytest.approx(np.mean(rewards))


def test_the_mean_error_of_several_environments():
    model = load_algorithm("qlearning_ucb")(env=Spaces(2, 2), bonus_scale=0.0, value_bound=1.0)
    envs_, progress = np.zeros(2, dtype=ENV), np.zeros(1, dtype=PROGRESS)
    envs_["terminated"], envs_["reward"], envs_["action"] = True, [4.0, 8.0], [0, 1]
    workspace = model._make_workspace(model.rng, 2)
    for name in ENV.names:
        workspace.envs[name] = envs_[name]
    learn_from_all(*workspace.arrays[:2], progress, *workspace.arrays[3:])
    assert progress["mean_td_error"] == (3 + 7) / 2


def worth(agent, env_id, kwargs):
    """What the greedy policy earns, and what the best one does, exactly."""
    env = gym.make(env_id, **kwargs)
    model, horizon = transition_model(env), time_limit(env)
    actions = agent.policy.q_table.argmax(axis=1)
    optimum = finite_horizon_optimum(model, horizon).start_value
    return policy_return(model, actions, horizon).expected_return, optimum


def trained(name, env_id, env_kwargs, n_steps, seed, **settings):
    env = make_vec_env(env_id, seed=seed, env_kwargs=env_kwargs)
    return load_algorithm(name)(env=env, seed=seed, **settings).learn(n_steps)


@pytest.mark.parametrize(
    ("place", "n_steps", "bound"), [(DEEP_SEA, 10_000, 1.0), (RIVER, 10_000, 100.0)]
)
def test_it_finds_what_epsilon_greedy_never_sees(place, n_steps, bound):
    """On each of ten seeds the optimum, and next to nothing.

    Where time is short one would not swim on at the end, which is worth .02 % and no table can say.
    """
    for seed in range(10):
        found, optimum = worth(
            trained("qlearning_ucb", *place, n_steps, seed, value_bound=bound), *place
        )
        assert found == pytest.approx(optimum, rel=3e-4)
        greedy, _ = worth(trained("qlearning", *place, n_steps, seed), *place)
        assert greedy < 0.04 * optimum


@pytest.mark.parametrize("n_envs", [1, 3])
def test_both_engines_end_in_the_same_bits(n_envs):
    def make_model(engine):
        return make(
            "qlearning_ucb", "FrozenLake-v1", n_envs, engine=engine, value_bound=1.0, horizon=30.0
        )

    assert_engines_agree(make_model, lambda model: model.learn(3000))


@pytest.mark.parametrize(
    ("arguments", "complaint"),
    [
        ({"gamma": 1.5}, "gamma must lie between 0 and 1"),
        ({"gamma": 1.0}, "value_bound has to be given where gamma is 1"),
        ({"gamma": 1.0, "value_bound": 1.0}, "horizon has to be given where gamma is 1"),
        ({"value_bound": float("inf")}, "value_bound must be finite, not inf"),
        ({"bonus_scale": -1.0}, "bonus_scale must be at least 0, not -1"),
        ({"bonus_scale": float("nan")}, "bonus_scale must be at least 0, not nan"),
        ({"horizon": -1.0}, "horizon must be at least 0"),
        ({"horizon": float("inf")}, "horizon must be finite, not inf"),
    ],
)
def test_wrong_arguments(arguments, complaint):
    with pytest.raises(ValueError, match=complaint):
        load_algorithm("qlearning_ucb")(env="FrozenLake-v1", **arguments)


@pytest.mark.parametrize("name", ["learning_rate", "exploration", "initial_q"])
def test_there_is_nothing_else_to_set(name):
    with pytest.raises(TypeError, match=f"no argument '{name}'"):
        load_algorithm("qlearning_ucb")(env="FrozenLake-v1", **{name: 0.5})
