"""What is said of agents that failed: tables by hand, whose greedy ways can be seen on the map."""

import numpy as np
import pytest
import torch as th

from agents import load_algorithm
from pipeline.environments import make_training_env
from pipeline.evaluation.advice import advice
from pipeline.evaluation.exact import exact_evaluator
from pipeline.settings.hyperparams import split
from pipeline.train_spec import TrainSpec

UP, DOWN, LEFT, RIGHT = range(4)  # of the warehouse
PAIRS = 61 * 4  # states of the warehouse that can be reached, times actions


def judged(env_id, table, n_steps=10**6, algo="qlearning", env_kwargs=None, **arguments):
    """Advice on an agent with these values: by state a row, or one row for all."""
    entry = {"n_timesteps": 1, "env_kwargs": env_kwargs or {}, **arguments}
    spec = TrainSpec(algo, env_id, split(entry), entry, seed=0)
    algorithm = load_algorithm(algo)
    policy, env = next(iter(algorithm.policy_aliases)), make_training_env(spec, None)
    agent = algorithm(policy, env, seed=0, **arguments)
    if table is None:
        agent.learn(1)
    else:
        for state, row in table.items() if isinstance(table, dict) else [(slice(None), table)]:
            agent.policy.q_tables[0, state] = th.tensor(row, dtype=th.float64)
    evaluator = exact_evaluator(spec)
    return advice(spec, agent, evaluator, evaluator(agent), n_steps)


def prefers(action, low=-1.0, high=0.0):
    return [high if i == action else low for i in range(4)]


@pytest.mark.parametrize(
    ("env_id", "env_kwargs", "table", "instead"),
    [
        (
            "Warehouse-v0",  # up from the start, to the shelf of the seventh row
            {},
            prefers(UP),
            "100% of its episodes run out of time: it stays at row 8, column 1",
        ),
        (
            "Warehouse-v0",
            {},
            {90: prefers(RIGHT), 91: prefers(LEFT)},
            (
                "100% of its episodes run out of time: "
                "it goes round between row 10, column 1; row 10, column 2"
            ),
        ),
        (
            "FrozenLake-v1",  # here 1 is down and 2 is right: into the hole below the second cell
            {"is_slippery": False},
            {0: prefers(2), 1: prefers(1)},
            "100% of its episodes end before the time limit, 0.0% of all with success",
        ),
        (
            "Taxi-v4",
            {},
            [0, 0, 0, 0, 0, -1],  # always south
            "100% of its episodes run out of time: it never leaves 60 of 400 states",
        ),
    ],
)
def test_what_it_does_instead(env_id, env_kwargs, table, instead):
    assert judged(env_id, table, env_kwargs=env_kwargs).instead.startswith(instead)


@pytest.mark.parametrize(
    ("start_value", "n_steps", "try_first"),
    [
        (-81.0, 400 * PAIRS, "-params gamma:0.9995 (now gamma 0.99)"),
        (-79.0, 130 * PAIRS, None),
        (
            -81.0,
            400 * PAIRS - 1,
            ("-n 1000000 -params gamma:0.9995 (now 400 for each state and action; gamma 0.99)"),
        ),
        (-79.0, PAIRS, "-n 1000000 (now 1 for each state and action)"),
    ],
)
def test_by_two_signals(start_value, n_steps, try_first):
    """Standing still costs 1 a step: -100 at a discount of 0.99, of which -80 are four fifths."""
    table = prefers(UP, low=start_value - 1, high=start_value)
    assert judged("Warehouse-v0", table, n_steps, gamma=0.99).try_first == try_first


def test_a_discount_that_hides_the_goal_from_planning_too():
    found = judged("Warehouse-v0", None, env_kwargs={"slip": 0.2}, gamma=0.99)
    assert found.try_first == (
        "-params gamma:0.9995 (now gamma 0.99, where even exact planning scores 0.00)"
    )


def test_nothing_that_planning_shows_to_be_in_vain():
    """In 60 steps only luck leads to the goal, which no discounted plan knows how to use."""
    table = prefers(UP, low=-100.0, high=-99.0)
    found = judged("Warehouse-v0", table, 10, env_kwargs={"max_episode_steps": 60, "slip": 0.1})
    assert found is not None
    assert found.try_first is None


@pytest.mark.parametrize(
    ("env_id", "algo"), [("Warehouse-v0", "optimal"), ("Warehouse-v0", "random")]
)
def test_nothing_is_said_of(env_id, algo):
    assert judged(env_id, None, algo=algo) is None


def test_nothing_is_said_where_the_best_policy_does_not_end_either():
    assert judged("RiverSwim-v0", [0.0, 1.0]) is None


def test_nothing_where_no_model_is_known():
    entry = {"n_timesteps": 1}
    spec = TrainSpec("dqn", "CartPole-v1", split(entry), entry, seed=0)
    assert exact_evaluator(spec) is None
    assert advice(spec, None, np.mean, None, 1) is None
