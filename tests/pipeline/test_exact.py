"""Exact evaluation: agents' own actions, what failed ones do, scales where the state is hidden."""

import math

import numpy as np
import pytest
import torch as th
from gymnasium import spaces
from stable_baselines3.common.env_util import make_vec_env

from rl_yardstick.agents import load_algorithm, policies
from rl_yardstick.agents.policies import policy_matrix
from rl_yardstick.mdp import value_iteration
from rl_yardstick.pipeline.environments import make_envs, make_training_env
from rl_yardstick.pipeline.evaluation import judge
from rl_yardstick.pipeline.evaluation.exact import evaluator_of_single, exact_evaluator
from rl_yardstick.pipeline.evaluation.judge import by_histories, world_of_memory
from rl_yardstick.pipeline.evaluation.sampled import evaluate
from rl_yardstick.pipeline.evaluation.yardstick import Yardstick
from tests.pipeline.short_runs import CART, LAKE, WAREHOUSE, agent_of, spec_of

WITHIN_999 = 3.2905  # two-sided, of the normal distribution
UP, DOWN, LEFT, RIGHT = range(4)  # of the warehouse
POSITION = {"env_kwargs": {"observation": "position", "max_episode_steps": 60, "slip": 0.1}}
HOT = {"env_kwargs": {"slip": 0.1, "max_episode_steps": 60}}
HOT |= {"env_wrapper": "rl_yardstick.envs.wrappers.OneHotObservation"}
SLIPPERY = {"env_kwargs": {"slip": 0.1, "max_episode_steps": 60, "shelf_reward": -3}}
SMALL = {"policy_kwargs": {"net_arch": [16]}, "device": "cpu"}
PROBS = {"probabilities": [0.2, 0.5, 0.9], "pulls": 100}
AGENTS = {
    "qlearning": {"learning_rate": 0.5, "exploration_final_eps": 0.3, "engine": "interpreted"},
    "ppo": {**SMALL, "n_steps": 64, "batch_size": 64, "n_epochs": 2},
    "dqn": {**SMALL, "buffer_size": 500, "learning_starts": 50, "exploration_final_eps": 0.2},
}


def known(env_id, entry=None, algo="qlearning"):
    """The exact evaluator of a run."""
    return exact_evaluator(spec_of(algo, env_id, entry))


def learner(name, spec, n_steps):
    return agent_of(name, make_training_env(spec, None), **AGENTS[name]).learn(n_steps)


@pytest.mark.parametrize(
    ("name", "n_steps", "entry", "n_episodes", "acts_by"),
    [
        ("qlearning", 5000, SLIPPERY, 200, "epsilon 0.3"),
        ("ppo", 256, HOT, 100, "its own distribution"),
        ("dqn", 300, POSITION, 100, "epsilon 0.2"),
    ],
)
def test_the_exact_return_is_that_of_the_agents_own_actions(
    name, n_steps, entry, n_episodes, acts_by
):
    """The mean of sampled returns lies in its 99.9 % interval around the exact one."""
    spec = spec_of("qlearning", WAREHOUSE, entry)
    agent, evaluator = learner(name, spec, n_steps), exact_evaluator(spec)
    for deterministic in (True, False):
        exact = evaluator(agent, deterministic)
        policy = policy_matrix(agent, evaluator.observations, deterministic)
        np.testing.assert_allclose(policy.sum(axis=1), 1, atol=1e-6)
        played = evaluate(agent, make_envs(spec, 50), n_episodes, 5, deterministic)
        margin = WITHIN_999 * exact.std_return / math.sqrt(n_episodes)
        assert exact.is_exact
        assert played.mean_return == pytest.approx(exact.mean_return, abs=margin + 1e-4)
        assert played.lengths.mean() == pytest.approx(exact.lengths[0], rel=0.15)
    found = evaluator.other_returns(agent)
    assert found.acts_by == acts_by
    assert found.stochastic_return == pytest.approx(exact.mean_return)
    assert found.discount == 0.99
    assert found.discounted_return is not None


class Lookup:
    """Acts by a table of actions."""

    action_space = spaces.Discrete(4)

    def __init__(self, actions):
        self.actions = actions

    def predict(self, observation, deterministic=True):
        return self.actions[observation], None


def test_where_episodes_must_be_sampled():
    assert known(CART) is known(LAKE, {"normalize": {"norm_obs": False}}) is None
    # Twenty-two thousand states of as many numbers each are two gigabytes.
    large = {"env_kwargs": {"size": 150, "observation": "one_hot"}}
    assert known("RandomWarehouse-v0", large) is None


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


def test_the_discounted_return_and_its_optimum_by_hand():
    """The shortest way over the lake that is not slippery has six steps."""
    evaluator = known(LAKE, {"env_kwargs": {"is_slippery": False}})
    agent = load_algorithm("qlearning")(env=LAKE, gamma=0.9)
    best = value_iteration(evaluator.model, 0.9).policy
    agent.policy.q_tables[:] = th.eye(4, dtype=th.float64)[best]
    found = evaluator.other_returns(agent)
    assert found.discount == 0.9
    assert found.discounted_return == pytest.approx(0.9**5)
    assert found.discounted_optimum == pytest.approx(0.9**5)
    agent.policy.q_tables[:] = 0  # it goes left for ever
    again = evaluator.other_returns(agent)
    assert (again.discounted_return, again.discounted_optimum) == (0, found.discounted_optimum)


def test_bandits_draw_their_arms_by_their_own_rule():
    scores = np.array([0.0, 0.5, 0.0])
    softmax = np.exp(scores) / np.exp(scores).sum()
    evaluator = known("BernoulliBandit-v0", {"env_kwargs": PROBS}, "epsilon_greedy")
    for name, arguments, words, chances in (
        ("epsilon_greedy", {"exploration_initial_eps": 0.3}, "epsilon 0.3", [0.1, 0.8, 0.1]),
        ("boltzmann", {"temperature": 1.0}, "temperature 1", softmax),
        ("gradient_bandit", {}, "its own distribution", softmax),
        ("exp3", {"mixing": 0.3}, "its own distribution", 0.7 * softmax + 0.1),
    ):
        agent = agent_of(name, make_vec_env("BernoulliBandit-v0", env_kwargs=PROBS), **arguments)
        agent.policy.scores[:] = th.from_numpy(scores)
        found = evaluator.other_returns(agent)
        assert found.acts_by == words
        expected = 100 * np.dot(chances, PROBS["probabilities"])
        assert found.stochastic_return == pytest.approx(expected)


def test_the_best_policy_scores_1_and_the_baseline_one_0():
    evaluator = known(WAREHOUSE)
    best = Lookup(value_iteration(evaluator.model, 1.0).policy)
    assert evaluator.yardstick.optimum == pytest.approx(79.0)
    assert evaluator(best).summary()["score"] == pytest.approx(1)
    # The best constant policy goes left for ever, and stays where it is.
    left = evaluator(Lookup(np.full(evaluator.model.n_states, LEFT)))
    assert (left.mean_return, left.summary()["score"]) == (-1000, pytest.approx(0, abs=1e-12))
    # On the slippery lake the best policy depends on the time that is left.
    assert known(LAKE).yardstick.optimum == pytest.approx(0.7442, abs=5e-5)


def test_figures_of_the_yardstick():
    yardstick = Yardstick(optimum=79.0, baseline=-1000.0)
    assert yardstick.gap(70.0) == 9.0
    worths = (79.0, -1000.0, -460.5, -2079.0)
    assert [yardstick.score(worth) for worth in worths] == [1.0, 0.0, 0.5, -1.0]
    flat = Yardstick(optimum=5.0, baseline=5.0)
    assert (flat.score(5.0), flat.score(4.0)) == (1.0, 0.0)


def test_an_agent_that_has_learnt_something_else_is_evaluated_anew():
    spec = spec_of("qlearning", LAKE)
    evaluator, agent = exact_evaluator(spec), learner("qlearning", spec, 5000)
    before, values = evaluator(agent), evaluator.values(evaluator.policy(agent, True))
    assert evaluator(agent) is before
    agent.policy.q_tables[:, 0] = -agent.policy.q_tables[:, 0] + th.arange(4)
    assert evaluator.policy(agent, True)[0] == 3
    after, anew = evaluator(agent), exact_evaluator(spec)(agent)
    assert (after.mean_return, after.exact_std) == (anew.mean_return, anew.exact_std)
    assert after.mean_return != before.mean_return
    assert evaluator.values(evaluator.policy(agent, True))[0] != values[0]


def test_what_is_not_known_is_not_guessed():
    evaluator, agent = known(LAKE), agent_of("qlearning", LAKE, exploration="gaussian_noise")
    with pytest.raises(ValueError, match="no closed-form action probabilities"):
        evaluator(agent, deterministic=False)
    assert evaluator.other_returns(agent).stochastic_return is None
    # What it has learned can be told all the same.
    assert evaluator(agent).is_exact
    with pytest.raises(TypeError, match="action probabilities of Lookup are not known"):
        policy_matrix(Lookup(np.zeros(16, int)), evaluator.observations, False)


LATE = "100% of its episodes run out of time"
WELL = "the best"


def prefers(action):
    return [0.0 if i == action else -1.0 for i in range(4)]


BETWEEN_TWO = {90: prefers(RIGHT), 91: prefers(LEFT)}
INTO_THE_HOLE = {0: prefers(2), 1: prefers(1)}  # on the lake 1 is down and 2 is right


@pytest.mark.parametrize(
    ("env_id", "rows", "instead"),
    [
        (WAREHOUSE, prefers(UP), f"{LATE}: it stays at row 8, column 1"),
        (WAREHOUSE, BETWEEN_TWO, f"{LATE}: it circles between row 10, column 1; row 10, colu"),
        (LAKE, INTO_THE_HOLE, "100% of its episodes end before the time limit, 0.0% of all with"),
        ("Taxi-v4", [0, 0, 0, 0, 0, -1], f"{LATE}: it never leaves 60 of 400 states"),
        ("Taxi-v4", WELL, None),
    ],
)
def test_what_a_failed_agent_does_instead(env_id, rows, instead):
    dry = {"is_slippery": False} if env_id == LAKE else {}
    spec = spec_of("qlearning", env_id, {"env_kwargs": dry})
    agent, evaluator = agent_of("qlearning", make_training_env(spec, None)), exact_evaluator(spec)
    rows = evaluator.optimum[1].astype(float) if rows is WELL else rows
    for state, row in rows.items() if isinstance(rows, dict) else [(slice(None), rows)]:
        agent.policy.q_tables[0, state] = th.tensor(row, dtype=th.float64)
    found = evaluator.instead(agent, evaluator(agent))
    assert found is None if instead is None else found.startswith(instead)


CORRIDOR, TIGER = "ShortCorridor-v0", "Tiger-v0"
BEST_OF_CORRIDOR = -(6 + 4 * np.sqrt(2))
SHORT = {"n_steps": 16, "batch_size": 16}


def test_agents_without_memory_are_measured_by_the_best_of_their_kind():
    yardstick = known(CORRIDOR).yardstick
    assert yardstick.optimum == pytest.approx(BEST_OF_CORRIDOR)
    assert yardstick.at_least is None
    figures = yardstick.figures(BEST_OF_CORRIDOR)
    assert figures["score"] == pytest.approx(1)
    assert (figures["full_optimum"], figures["memory_optimum"]) == (-3, -3)
    assert figures["measured_by"] == "observation"
    # Without a limit, p = 1/2 takes (4 - 1) / (1/4) steps; of 1000 the rest is nothing.
    assert yardstick.baseline == pytest.approx(-12)


def test_where_nothing_is_lost_by_observing_the_scale_stays():
    for env_id, kwargs in (
        *((LAKE, {}), (WAREHOUSE, {"observation": "position"})),
        (CORRIDOR, {"max_episode_steps": 1}),
    ):
        evaluator = known(env_id, {"env_kwargs": kwargs})
        assert evaluator.scale is evaluator.yardstick.hidden is None


class Counting:
    """Counts readings of the tiger, and opens a door at a difference of two."""

    def predict(self, observation, state=None, episode_start=None, deterministic=True):
        count = np.zeros((1, len(observation), 1)) if state is None else state[0].copy()
        count[:, np.asarray(episode_start)] = 0
        count[0, observation == 0] = 0
        count[0, observation == 1] += 1
        count[0, observation == 2] -= 1
        actions = np.where(count[0, :, 0] >= 2, 2, np.where(count[0, :, 0] <= -2, 1, 0))
        return actions, (count,)


def worth(agent, env_id, **env_kwargs):
    spec = spec_of("ppo_lstm", env_id, {"env_kwargs": env_kwargs})
    return by_histories(spec, agent, evaluator_of_single(spec))


def test_who_counts_readings_reaches_the_optimum_of_memory():
    # By hand: after two readings that agree the door is right in .7225 of all cases and wrong in
    # .0225; else there are three steps of listening.
    found = worth(Counting(), TIGER, max_episode_steps=3)
    assert found.mean_return == pytest.approx(2.72)
    shares, returns = np.array([0.7225, 0.0225, 0.255]), np.array([8.0, -102.0, -3.0])
    assert found.exact_std == pytest.approx(np.sqrt(shares @ (returns - 2.72) ** 2))
    assert found.summary()["score"] == pytest.approx(1)
    assert found.mean_length == 3


def test_histories_that_an_agent_does_not_tell_apart_are_one(monkeypatch):
    # Ten steps: 2^10 sequences of sounds and more, but few counts.
    monkeypatch.setattr(judge, "MOST_HISTORIES", 10)
    found = worth(Counting(), TIGER)
    # By hand, by how much more often the tiger was heard where it is; opening begins anew.
    total, counts = 0.0, {0: 1.0}
    for _ in range(10):
        after = {}
        for count, chance in counts.items():
            if abs(count) == 2:
                total += chance * (10 if count == 2 else -100)
                after[0] = after.get(0, 0.0) + chance
                continue
            total -= chance
            for step, share in ((1, 0.85), (-1, 0.15)):
                after[count + step] = after.get(count + step, 0.0) + chance * share
        counts = after
    assert found.mean_return == pytest.approx(total)
    assert found.mean_return < found.yardstick.optimum == pytest.approx(9.438, abs=1e-3)


def test_all_histories_say_what_many_episodes_say():
    memory = {**SHORT, "policy_kwargs": {"lstm_hidden_size": 4}}
    spec = spec_of("ppo_lstm", TIGER, {**memory, "env_kwargs": {"max_episode_steps": 5}})
    env = make_envs(spec, 8)
    agent = agent_of("ppo_lstm", env, device="cpu", **memory).learn(32)
    exact = by_histories(spec, agent, world_of_memory(spec, agent))
    sampled = evaluate(agent, env, 400, seed=0)
    error = exact.exact_std / np.sqrt(400)
    assert abs(sampled.mean_return - exact.mean_return) <= 4 * error + 1e-6
    assert sampled.std_return == pytest.approx(exact.exact_std, rel=0.2, abs=1e-6)
    assert sampled.mean_length == pytest.approx(exact.mean_length, rel=0.05)
