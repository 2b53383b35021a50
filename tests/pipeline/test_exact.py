"""Exact evaluations agree with sampled ones, for every kind of agent whose policy is known."""

import math
from collections import defaultdict

import gymnasium as gym
import numpy as np
import pytest
import torch as th
from gymnasium import spaces

from agents import load_algorithm
from mdp import policy_return, value_iteration
from pipeline.environments import make_evaluation_env, make_training_env
from pipeline.evaluation import policies
from pipeline.evaluation.exact import exact_evaluator
from pipeline.evaluation.policies import policy_matrix
from pipeline.evaluation.sampled import Yardstick, evaluate
from pipeline.settings.hyperparams import split
from pipeline.train_spec import TrainSpec

# Two-sided, of the normal distribution.
WITHIN_999 = 3.2905
N_EPISODES = 20_000

ENVS = {
    "Warehouse": ("Warehouse-v0", {"slip": 0.1, "max_episode_steps": 60, "shelf_reward": -3}),
    "FrozenLake": ("FrozenLake-v1", {}),
    "MineMaze": ("MineMaze-v0", {"random_start": True, "slip": 0.2, "max_episode_steps": 50}),
    "still Warehouse": ("Warehouse-v0", {"max_episode_steps": 100}),
    "still FrozenLake": ("FrozenLake-v1", {"is_slippery": False}),
    "still MineMaze": ("MineMaze-v0", {}),
}
POSITION = {"observation": "position", "max_episode_steps": 60, "slip": 0.1}
SMALL = {"policy_kwargs": {"net_arch": [16]}, "device": "cpu"}
AGENTS = {
    "qlearning": {"learning_rate": 0.5, "exploration_final_eps": 0.3},
    "ppo": {**SMALL, "n_steps": 64, "batch_size": 64, "n_epochs": 2},
    "a2c": SMALL,
    "trpo": {**SMALL, "n_steps": 64, "batch_size": 64},
    "dqn": {**SMALL, "buffer_size": 500, "learning_starts": 50, "exploration_final_eps": 0.2},
    "random": {},
}
BRIEFLY = {"qlearning": 5000, "ppo": 256, "a2c": 100, "trpo": 128, "dqn": 300, "random": 0}


def spec_of(env, **entry):
    env_id, env_kwargs = ENVS.get(env, (env, {}))
    entry = {"n_timesteps": 1, "env_kwargs": env_kwargs, **entry}
    return TrainSpec("qlearning", env_id, split(entry), entry, seed=0)


def briefly_trained(name, spec):
    algorithm = load_algorithm(name)
    env = make_training_env(spec, None)
    policy = next(iter(algorithm.policy_aliases))
    return algorithm(policy, env, seed=0, **AGENTS[name]).learn(BRIEFLY[name])


def sampled_returns(evaluator, policy, n_episodes, seed=0):
    """Returns of many episodes that follow the policy matrix in the model, all at once."""
    model, rng = evaluator.model, np.random.default_rng(seed)
    actions_up_to = policy.cumsum(axis=1)
    outcomes_up_to = model.prob.cumsum(axis=2)
    states = rng.choice(model.n_states, n_episodes, p=model.initial)
    returns, playing = np.zeros(n_episodes), np.arange(n_episodes)
    for _ in range(evaluator.horizon):
        drawn = rng.random((2, len(playing), 1))
        # Rounding may leave a last sum just below 1.
        actions = (actions_up_to[states, :-1] <= drawn[0]).sum(axis=1)
        outcomes = (outcomes_up_to[states, actions, :-1] <= drawn[1]).sum(axis=1)
        at = states, actions, outcomes
        returns[playing] += model.reward[at]
        going_on = ~model.terminated[at]
        states, playing = model.next_state[at][going_on], playing[going_on]
    return returns


def assert_mean_is(expected, std, returns):
    """The mean of sampled returns lies in its 99.9 % interval around the exact one."""
    margin = WITHIN_999 * std / np.sqrt(len(returns))
    assert np.mean(returns) == pytest.approx(expected, abs=margin + 1e-4)


# --- against sampling ----------------------------------------------------------------------------


# What is drawn follows the matrix of the policy: of every kind of agent one is enough, and of
# every environment one that is a table and one that is a network.
@pytest.mark.parametrize(
    ("name", "env"),
    [
        *((name, "FrozenLake") for name in AGENTS),
        *((name, env) for name in ("qlearning", "ppo") for env in ("Warehouse", "MineMaze")),
    ],
)
def test_the_exact_return_is_that_of_sampled_episodes(name, env):
    spec = spec_of(env)
    evaluator = exact_evaluator(spec)
    agent = briefly_trained(name, spec)
    for deterministic in (True, False):
        exact = evaluator(agent, deterministic)
        policy = policy_matrix(agent, evaluator.observations, deterministic)
        np.testing.assert_allclose(policy.sum(axis=1), 1, atol=1e-6)
        returns = sampled_returns(evaluator, policy, N_EPISODES)
        assert exact.is_exact
        assert_mean_is(exact.mean_return, exact.std_return, returns)
        # The standard deviation itself, whose error depends on the tails: loosely.
        assert returns.std() == pytest.approx(exact.std_return, rel=0.15, abs=0.01)


@pytest.mark.parametrize(
    ("name", "env", "entry", "n_episodes"),
    [
        ("qlearning", "FrozenLake", {}, 1000),
        ("ppo", "FrozenLake", {}, 1000),
        # A hidden natural is judged by what the agent sees.
        ("qlearning", "Blackjack-v1", {"env_wrapper": "envs.wrappers.FlattenToDiscrete"}, 3000),
        ("dqn", "Warehouse-v0", {"env_kwargs": POSITION}, 200),
    ],
)
def test_the_exact_return_is_that_of_the_agents_own_actions(name, env, entry, n_episodes):
    spec = spec_of(env, **entry)
    agent, evaluator = briefly_trained(name, spec), exact_evaluator(spec)
    for deterministic in (True, False):
        exact = evaluator(agent, deterministic)
        played = evaluate(agent, make_evaluation_env(spec, 50), n_episodes, 5, deterministic)
        assert_mean_is(exact.mean_return, exact.std_return, played.returns)
        assert played.lengths.mean() == pytest.approx(exact.lengths[0], rel=0.15)


# --- observations --------------------------------------------------------------------------------


class Lookup:
    """Acts by a table of actions, on whatever it recognises the state by."""

    def __init__(self, actions, state_of):
        self.actions = actions
        self.state_of = state_of
        self.action_space = spaces.Discrete(4)

    def predict(self, observation, deterministic=True):
        return self.actions[self.state_of(observation)], None


def cell_of(position):
    return (np.rint(position * 9) @ [10, 1]).astype(int)


ENCODINGS = {
    "position": ({"env_kwargs": {"observation": "position", "slip": 0.1}}, cell_of),
    "one_hot": (
        {"env_kwargs": {"observation": "one_hot", "slip": 0.1}},
        lambda hot: hot.argmax(axis=1),
    ),
    "wrapper": (
        {"env_kwargs": {"slip": 0.1}, "env_wrapper": "envs.wrappers.OneHotObservation"},
        lambda hot: hot.argmax(axis=1),
    ),
}


@pytest.mark.parametrize("encoding", ENCODINGS)
def test_other_observations_of_the_same_states(encoding):
    entry, state_of = ENCODINGS[encoding]
    plain = exact_evaluator(spec_of("Warehouse-v0", env_kwargs={"slip": 0.1}))
    encoded = exact_evaluator(spec_of("Warehouse-v0", **entry))
    assert encoded.observations.dtype == np.float32
    plan = value_iteration(plain.model, 1.0)
    for actions in (plan.policy, np.random.default_rng(0).integers(0, 4, 100)):
        expected = plain(Lookup(actions, lambda state: state))
        seen = encoded(Lookup(actions, state_of))
        assert seen.summary() == expected.summary()


@pytest.mark.parametrize(
    ("env", "entry"),
    [
        ("CartPole-v1", {}),
        ("FrozenLake-v1", {"normalize": {"norm_obs": False}}),
        ("FrozenLake-v1", {"frame_stack": 2}),
        ("FrozenLake-v1", {"vec_env_wrapper": "stable_baselines3.common.vec_env.VecMonitor"}),
        # Twenty-two thousand states of as many numbers each are two gigabytes.
        ("envs:RandomWarehouse-v0", {"env_kwargs": {"size": 150, "observation": "one_hot"}}),
    ],
)
def test_where_episodes_must_be_sampled(env, entry):
    assert exact_evaluator(spec_of(env, **entry)) is None


def test_what_takes_longer_than_playing_is_said(monkeypatch):
    spec = spec_of("Warehouse")
    evaluator = exact_evaluator(spec)
    agents = {name: briefly_trained(name, spec) for name in ("qlearning", "dqn", "random")}
    assert [evaluator.obstacle(agent) for agent in agents.values()] == ["", "", ""]
    monkeypatch.setattr(policies, "MOST_NUMBERS", 100 * 100 - 1)
    monkeypatch.setattr(policies, "MOST_AT_RANDOM", 100 * 60 - 1)
    assert evaluator.obstacle(agents["qlearning"]) == ""
    assert evaluator.obstacle(agents["dqn"]).startswith("to ask a network about 100 states")
    assert evaluator.obstacle(agents["random"]).startswith("random actions come to too many")
    assert evaluator.obstacle(agents["qlearning"], deterministic=False).startswith("random")


def test_a_network_is_asked_in_parts_where_states_are_many(monkeypatch):
    spec = spec_of("Warehouse")
    evaluator = exact_evaluator(spec)
    for name in ("dqn", "ppo"):
        agent = briefly_trained(name, spec)
        for sure in (True, False):
            at_once = evaluator(agent, sure).mean_return
            with monkeypatch.context() as patch:
                patch.setattr(policies, "MOST_AT_ONCE", 100 * 7)  # rows of 100 numbers
                in_parts = exact_evaluator(spec)(agent, sure).mean_return
            assert in_parts == pytest.approx(at_once, rel=1e-5)


@pytest.mark.parametrize("slip", [0.0, 0.1])
def test_a_large_warehouse_is_evaluated_exactly(slip):
    """Against planning and evaluating backwards, which takes a hundred times as long."""
    spec = spec_of("envs:RandomWarehouse-v0", env_kwargs={"size": 150, "slip": slip})
    evaluator = exact_evaluator(spec)
    best = value_iteration(evaluator.model, 1.0)
    found = evaluator(Lookup(best.policy, lambda state: state))
    assert found.mean_return == pytest.approx(evaluator.yardstick.optimum, rel=1e-9)
    assert found.summary()["score"] == pytest.approx(1, abs=1e-9)
    assert evaluator.yardstick.optimum == pytest.approx(best.start_value, rel=1e-9)


def test_a_table_is_looked_up_only_where_that_is_what_the_agent_does():
    class Contrary(load_algorithm("qlearning")):
        def predict(self, observation, **kwargs):
            actions, state = super().predict(observation, **kwargs)
            return 3 - actions, state

    rng, states = np.random.default_rng(0), np.arange(16)
    for name, tables in (("qlearning", 1), ("double_qlearning", 2)):
        agent = load_algorithm(name)(env="FrozenLake-v1")
        agent.policy.q_tables.numpy()[:] = rng.normal(size=(tables, 16, 4)).round(1)
        expected, _ = agent.predict(states, deterministic=True)
        assert (policies.best_actions(agent, states) == expected).all()
    assert (policies.best_actions(Contrary(env="FrozenLake-v1"), states) == 3).all()


def test_what_an_unknown_agent_samples_from_is_not_guessed():
    env = exact_evaluator(spec_of("FrozenLake"))
    with pytest.raises(TypeError, match="action probabilities of Lookup are not known"):
        policy_matrix(Lookup(np.zeros(16, int), lambda state: state), env.observations, False)


# --- the yardstick -------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("env", "optimum", "baseline"),
    [("Warehouse-v0", 79.0, -1000.0), ("MineMaze-v0", 91.0, None), ("FrozenLake-v1", 0.7442, None)],
)
def test_the_best_policy_scores_1_and_the_baseline_one_0(env, optimum, baseline):
    evaluator = exact_evaluator(spec_of(env))
    n_states, n_actions = evaluator.model.prob.shape[:2]
    best = Lookup(value_iteration(evaluator.model, 1.0).policy, lambda state: state)
    assert evaluator.yardstick.optimum == pytest.approx(optimum, abs=5e-5)
    # On the slippery lake the best policy depends on the time that is left.
    least = 0.95 if env == "FrozenLake-v1" else 1 - 1e-12
    assert least <= evaluator(best).summary()["score"] <= 1 + 1e-12
    policies = [np.eye(n_actions)[[action] * n_states] for action in range(n_actions)]
    policies.append(np.full((n_states, n_actions), 1 / n_actions))
    returns = [
        policy_return(evaluator.model, policy, evaluator.horizon).expected_return
        for policy in policies
    ]
    scores = [evaluator.yardstick.score(value) for value in returns]
    assert max(scores) == pytest.approx(0, abs=1e-12)
    if baseline is not None:
        assert max(returns) == baseline


def test_figures_of_the_yardstick():
    yardstick = Yardstick(optimum=79.0, baseline=-1000.0)
    assert yardstick.gap(70.0) == 9.0
    assert yardstick.score(79.0) == 1.0
    assert yardstick.score(-1000.0) == 0.0
    assert yardstick.score(-460.5) == 0.5
    assert yardstick.score(-2079.0) == -1.0
    flat = Yardstick(optimum=5.0, baseline=5.0)
    assert (flat.score(5.0), flat.score(4.0)) == (1.0, 0.0)
    # Sums in another order.
    nearly = Yardstick(optimum=0.3, baseline=np.nextafter(0.3, 0))
    assert (nearly.score(np.nextafter(0.3, 0)), nearly.score(0.29)) == (1.0, 0.0)


def test_an_agent_that_has_learnt_something_else_is_evaluated_anew():
    spec = spec_of("FrozenLake")
    evaluator, agent = exact_evaluator(spec), briefly_trained("qlearning", spec)
    before, values = evaluator(agent), evaluator.values(evaluator.policy(agent, True))
    assert evaluator(agent) is before
    agent.policy.q_tables[:, 0] = -agent.policy.q_tables[:, 0] + th.arange(4)
    assert evaluator.policy(agent, True)[0] == 3
    after, anew = evaluator(agent), exact_evaluator(spec)(agent)
    assert (after.mean_return, after.exact_std) == (anew.mean_return, anew.exact_std)
    assert after.mean_return != before.mean_return
    assert evaluator.values(evaluator.policy(agent, True))[0] != values[0]


# With four cells there are as many states as actions, where rows can be mistaken for columns.
MAPS = {"four cells": ["SF", "FG"], "six cells": ["SFF", "FHG"]}
LIMIT = 12


def trained(name, env_kwargs, **arguments):
    """A run's specification, and an agent that has learned for a while."""
    entry = {"n_timesteps": 1, "env_kwargs": {**env_kwargs, "max_episode_steps": LIMIT}}
    spec = TrainSpec(name, "FrozenLake-v1", split(entry), entry, seed=0)
    agent = load_algorithm(name)(env=make_training_env(spec, None), seed=0, **arguments)
    return spec, agent.learn(400)


def epsilon_greedy(row, agent):
    """As the agent chooses where values differ; equal ones share."""
    best = [value == max(row) for value in row]
    epsilon = agent.exploration_rate
    return [epsilon / len(row) + (1 - epsilon) * is_best / sum(best) for is_best in best]


def boltzmann(row, agent):
    weights = [math.exp(value / 0.3) for value in row]
    return [weight / sum(weights) for weight in weights]


def added_up(agent, choose, env):
    """Mean return and mean length of an episode, by going through all of them at once."""
    outcomes = env.unwrapped.P
    at = {env.unwrapped.s: 1.0}
    mean_return = mean_length = 0.0
    for _ in range(LIMIT):
        following = defaultdict(float)
        for state, chance in at.items():
            mean_length += chance
            chosen = choose(agent.policy.q_table[state].tolist(), agent)
            for action, probability in enumerate(chosen):
                for share, next_state, reward, terminated in outcomes[state][action]:
                    likelihood = chance * probability * share
                    mean_return += likelihood * reward
                    if not terminated:
                        following[next_state] += likelihood
        at = following
    return mean_return, mean_length


@pytest.mark.parametrize("cells", MAPS)
@pytest.mark.parametrize(
    ("name", "choose", "arguments"),
    [
        ("qlearning", epsilon_greedy, {"exploration_final_eps": 0.25}),
        ("sarsa", boltzmann, {"exploration": "boltzmann", "temperature": 0.3}),
    ],
)
def test_the_worth_of_exploring(name, choose, arguments, cells):
    env_kwargs = {"desc": MAPS[cells], "is_slippery": False}
    spec, agent = trained(name, env_kwargs, **arguments)
    found = exact_evaluator(spec)(agent, deterministic=False)
    env = gym.make("FrozenLake-v1", **env_kwargs)
    env.reset(seed=0)
    mean_return, mean_length = added_up(agent, choose, env)
    assert found.mean_return == pytest.approx(mean_return, abs=1e-12)
    assert found.lengths[0] == pytest.approx(mean_length, abs=1e-12)
    # It has learnt something, and exploring costs some of it.
    assert 0.05 < mean_return < exact_evaluator(spec)(agent).mean_return


def test_the_worth_of_noise_is_refused():
    spec, agent = trained("qlearning", {"desc": MAPS["four cells"]}, exploration="gaussian_noise")
    evaluator = exact_evaluator(spec)
    with pytest.raises(ValueError, match="no closed-form action probabilities"):
        evaluator(agent, deterministic=False)
    # What it has learned can be told all the same.
    assert evaluator(agent).is_exact
