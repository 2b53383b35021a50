"""Arguments that constructors refuse, in one line that says what is wrong and what is right."""

import math

import pytest
from gymnasium import spaces

import envs  # noqa: F401  # registers the environments
from agents import ALGORITHMS, load_algorithm
from tests.agents.hand_fed import Spaces

INF = math.inf
EXPONENTIAL = {"exploration_decay": "exponential", "exploration_final_eps": 0.0}
VECTORS = {"env": Spaces(spaces.Box(-1, 1, (4,)))}
PROBABILITIES = "needs the probabilities of the actions"
TERMINAL = "skip_terminal_update is for the agents that learn from"
REFUSED = {
    "qlearning": [
        ({"gamma": 1.5}, "gamma must lie between 0 and 1"),
        ({"exploration": "greedy"}, "exploration must be one of epsilon_greedy"),
        ({"learning_rate": "average"}, "learning_rate must be a number"),
        ({"learning_rate": -0.1}, "learning_rate must be at least 0, not -0.1"),
        ({"exploration": "boltzmann", "temperature": 0.0}, "temperature must be above 0"),
        (EXPONENTIAL, "start and end above 0"),
        ({"engine": "fast"}, "engine must be one of auto, compiled, interpreted, not 'fast'"),
        ({"env": "CartPole-v1"}, "Discrete space that starts at 0"),
        ({"mask_actions": True}, r"^mask_actions: the environment has no method action_masks\(\)"),
    ],
    "expected_sarsa": [({"exploration": "gaussian_noise"}, "take epsilon_greedy or boltzmann")],
    "n_step_tree_backup": [
        ({"n_steps": 0}, "n_steps must be a whole number of at least 1, not 0"),
        ({"exploration": "gaussian_noise"}, "target_policy: exploring needs the probabilities"),
    ],
    "sarsa_lambda": [
        ({"trace_type": "green"}, "trace_type must be one of accumulating, replacing, dutch"),
        ({"skip_terminal_update": True}, TERMINAL),
    ],
    "off_policy_monte_carlo": [
        ({"learning_rate": 0.1}, "learning_rate must be 'sample_average', not 0.1"),
        ({"exploration": "gaussian_noise"}, PROBABILITIES),
    ],
    "r_max": [
        ({"gamma": 1.0, "value_bound": 1.0}, "gamma must be below 1"),
    ],
    "qlearning_ucb": [
        ({"gamma": 1.0}, "value_bound has to be given where gamma is 1"),
        ({"gamma": 1.0, "value_bound": 1.0}, "horizon has to be given where gamma is 1"),
    ],
    "semi_gradient_q": [({"initial_q": INF}, "initial_q must be finite, not inf")],
    "reinforce": [
        ({"initial_preferences": [1, 2, 3]}, "initial_preferences must be a number or 4 numbers"),
        ({"learning_rate": "sample_average"}, "learning_rate must be a number or a schedule"),
    ],
    "ucb": [
        (VECTORS, "observations in a Discrete space"),
    ],
    "exp3": [
        ({"mixing": 0.0}, "mixing must be above 0, not 0.0"),
    ],
    "linucb": [
        ({"ridge": 0.0}, "ridge must be above 0, not 0.0"),
    ],
    "ppo": [({"engine": "fast", "policy": "MlpPolicy"}, "engine must be one of")],
}  # fmt: skip
CASES = [(name, *case) for name, cases in REFUSED.items() for case in cases]


@pytest.mark.parametrize(
    ("name", "arguments", "line"),
    CASES,
    # Spaces have no text of their own.
    ids=[
        f"{name} {key}={value if isinstance(value, str | float) or key != 'env' else 'spaces'}"
        for name, (*_, (key, value)) in ((name, given.items()) for name, given, _ in CASES)
    ],
)
def test_wrong_arguments(name, arguments, line):
    usual = "SegmentBandit-v0" if ALGORITHMS[name].for_bandits else "FrozenLake-v1"
    with pytest.raises(ValueError, match=line) as refusal:
        load_algorithm(name)(**{"env": usual, **arguments})
    assert "\n" not in str(refusal.value)


@pytest.mark.parametrize(
    ("name", "argument"), [("qlearning", "gama"), ("qlearning_ucb", "learning_rate")]
)
def test_arguments_that_nobody_declared(name, argument):
    with pytest.raises(TypeError, match=f" has no argument '{argument}'"):
        load_algorithm(name)(env="FrozenLake-v1", **{argument: 0.5})
