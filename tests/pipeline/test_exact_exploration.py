"""The exact worth of an agent while it explores, against episodes added up step by step."""

import math
from collections import defaultdict

import gymnasium as gym
import pytest

from agents import load_algorithm
from pipeline.environments import make_training_env
from pipeline.evaluation.exact import exact_evaluator
from pipeline.settings.hyperparams import split
from pipeline.train_spec import TrainSpec

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


STRATEGIES = {
    "epsilon_greedy": (epsilon_greedy, {"exploration_final_eps": 0.25}),
    "boltzmann": (boltzmann, {"exploration": "boltzmann", "temperature": 0.3}),
}


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
@pytest.mark.parametrize("strategy", STRATEGIES)
@pytest.mark.parametrize("name", ["qlearning", "sarsa"])
def test_the_worth_of_exploring(name, strategy, cells):
    choose, arguments = STRATEGIES[strategy]
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
