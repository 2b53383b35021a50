"""What is said of agents: advice where they failed, and what they make of their actions."""

import numpy as np
import pytest
import torch as th
from stable_baselines3.common.env_util import make_vec_env

import envs  # noqa: F401  # registers the bandits
from agents import load_algorithm
from pipeline.environments import make_training_env
from pipeline.evaluation.advice import advice
from pipeline.evaluation.exact import exact_evaluator
from pipeline.evaluation.policies import action_figures
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


LATE = "100% of its episodes run out of time"


def prefers(action, low=-1.0, high=0.0):
    return [high if i == action else low for i in range(4)]


@pytest.mark.parametrize(
    ("env_id", "env_kwargs", "table", "instead"),
    [
        # Up from the start, to the shelf of the seventh row.
        ("Warehouse-v0", {}, prefers(UP), f"{LATE}: it stays at row 8, column 1"),
        (
            "Warehouse-v0",
            {},
            {90: prefers(RIGHT), 91: prefers(LEFT)},
            f"{LATE}: it goes round between row 10, column 1; row 10, column 2",
        ),
        (
            "FrozenLake-v1",  # here 1 is down and 2 is right: into the hole below the second cell
            {"is_slippery": False},
            {0: prefers(2), 1: prefers(1)},
            "100% of its episodes end before the time limit, 0.0% of all with success",
        ),
        # Always south.
        ("Taxi-v4", {}, [0, 0, 0, 0, 0, -1], f"{LATE}: it never leaves 60 of 400 states"),
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


def test_nothing_is_said_of_the_optimum_of_chance_and_where_nothing_is_known():
    for algo in ("optimal", "random"):
        assert judged("Warehouse-v0", None, algo=algo) is None
    # Here the best policy does not end either.
    assert judged("RiverSwim-v0", [0.0, 1.0]) is None
    entry = {"n_timesteps": 1}
    spec = TrainSpec("dqn", "CartPole-v1", split(entry), entry, seed=0)
    assert exact_evaluator(spec) is None
    assert advice(spec, None, np.mean, None, 1) is None


SMALL = {"policy_kwargs": {"net_arch": [8]}}


def agent_of(name, env_id="FrozenLake-v1", **kwargs):
    algorithm = load_algorithm(name)
    env = make_vec_env(env_id, 1, seed=0)
    return algorithm(next(iter(algorithm.policy_aliases)), env, seed=0, **kwargs)


def test_of_a_table_its_row():
    agent = agent_of("double_qlearning")
    agent.policy.q_tables[:, 3] = th.tensor([[1.0, 2.0, 3.0, 4.0], [3.0, 2.0, 1.0, 0.0]])
    figures = action_figures(agent, np.array([3]))
    assert (figures.word, figures.numbers.tolist()) == ("value", [2.0, 2.0, 2.0, 2.0])


@pytest.mark.parametrize("pooled", [False, True])
def test_of_a_bandit_its_scores(pooled):
    agent = agent_of("epsilon_greedy", "envs:SegmentBandit-v0", ignore_context=pooled)
    agent.policy.scores[-1] = th.tensor([0.25, 0.5, 0.75])
    figures = action_figures(agent, np.array([1]))
    assert (figures.word, figures.numbers.tolist()) == ("score", [0.25, 0.5, 0.75])


@pytest.mark.parametrize("name", ["dqn", "qrdqn"])
def test_of_a_network_values_whose_highest_it_takes(name):
    agent = agent_of(name, buffer_size=10, **SMALL)
    for state in range(16):
        word, values = action_figures(agent, np.array([state]))
        assert (word, values.shape) == ("value", (4,))
        assert values.argmax() == agent.predict(np.array([state]), deterministic=True)[0]
    assert len(set(values.tolist())) == 4


def test_of_a_policy_that_samples_its_probabilities():
    agent = agent_of("ppo", **SMALL)
    word, shares = action_figures(agent, np.array([5]))
    assert word == "probability"
    assert shares.sum() == pytest.approx(1.0)
    with th.no_grad():
        _, logs, _ = agent.policy.evaluate_actions(th.full((4,), 5), th.arange(4))
    assert shares == pytest.approx(np.exp(logs.numpy()), rel=1e-5)


@pytest.mark.parametrize("env_id", ["FrozenLake-v1", "MountainCar-v0"])
def test_on_tiles_values_or_what_is_made_of_preferences(env_id):
    observation = np.array([5]) if env_id == "FrozenLake-v1" else np.array([[-0.5, 0.01]])
    values = agent_of("semi_gradient_q", env_id)
    values.policy.weights[:] = th.arange(values.policy.weights.shape[1])
    word, numbers = action_figures(values, observation)
    assert (word, numbers.argmax()) == ("value", len(numbers) - 1)
    assert np.unique(np.diff(numbers)).size == 1
    softmax = agent_of("actor_critic", env_id)
    word, shares = action_figures(softmax, observation)
    assert (word, shares.tolist()) == (
        "probability",
        [pytest.approx(1 / len(shares))] * len(shares),
    )


def test_where_there_is_no_such_figure():
    assert action_figures(agent_of("random"), np.array([0])) is None
    assert action_figures(agent_of("ppo", "Pendulum-v1", **SMALL), np.zeros((1, 3))) is None
    lstm = agent_of("ppo_lstm", n_steps=8, policy_kwargs={"lstm_hidden_size": 4})
    assert action_figures(lstm, np.array([0])) is None
    linear = agent_of("linucb", "envs:LinearBandit-v0")
    assert action_figures(linear, np.zeros((1, 5))) is None
