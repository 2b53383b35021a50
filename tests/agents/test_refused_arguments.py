"""Arguments that constructors refuse, in one line that says what is wrong and what is right."""

import math

import pytest
from gymnasium import spaces

import rl_yardstick.envs  # noqa: F401  # registers the environments
from rl_yardstick.agents import ALGORITHMS, load_algorithm
from tests.agents.hand_fed import Spaces

INF, NAN = math.inf, math.nan
TWO = {"initial_q_std": 1e308, "seed": 0}  # one of the numbers that are drawn is above 1.8
EXPONENTIAL = {"exploration_decay": "exponential", "exploration_final_eps": 0.0}
VECTORS = {"env": Spaces(spaces.Box(-1, 1, (4,)))}
MATRICES = {"env": Spaces(spaces.Box(-1, 1, (2, 2)))}
PROBABILITIES = "needs the probabilities of the actions"
TERMINAL = "skip_terminal_update is for the agents that learn from"
REFUSED = {
    "qlearning": [
        ({"gamma": 1.5}, "gamma must lie between 0 and 1"),
        (TWO, "initial_q and initial_q_std must give finite values, not 0 and 1"),
        ({"exploration": "greedy"}, "exploration must be one of epsilon_greedy"),
        ({"learning_rate": "average"}, "learning_rate must be a number"),
        ({"learning_rate": -0.1}, "learning_rate must be at least 0, not -0.1"),
        ({"learning_rate": INF}, "learning_rate must be finite, not inf"),
        ({"exploration": "boltzmann", "temperature": 0.0}, "temperature must be above 0"),
        (EXPONENTIAL, "start and end above 0"),
        ({"engine": "fast"}, "engine must be one of auto, compiled, interpreted, not 'fast'"),
        ({"env": "CartPole-v1"}, "Discrete space that starts at 0"),
        ({"mask_actions": True}, r"^mask_actions: the environment has no method action_masks\(\)"),
    ],
    "expected_sarsa": [({"exploration": "gaussian_noise"}, "take epsilon_greedy or boltzmann")],
    "n_step_tree_backup": [
        *(({"n_steps": n}, "n_steps must be a whole number of at least 1, not")
          for n in (0, 1.5, True)),
        ({"exploration": "gaussian_noise"}, "target_policy: exploring needs the probabilities"),
    ],
    "off_policy_monte_carlo": [
        ({"learning_rate": 0.1}, "learning_rate must be 'sample_average', not 0.1"),
        ({"exploration": "gaussian_noise"}, PROBABILITIES),
    ],
    "dyna_q": [({"planning_steps": -1}, "planning_steps must be a whole number of at least 0")],
    "q_lambda": [({"skip_terminal_update": True}, TERMINAL)],
    "r_max": [
        ({"gamma": 1.0, "value_bound": 1.0}, "gamma must be below 1"),
        ({"known_after": 10**30}, "known_after must be at most 1000000000, not 1000"),
    ],
    "qlearning_ucb": [
        ({"gamma": 1.0}, "value_bound has to be given where gamma is 1"),
        ({"gamma": 1.0, "value_bound": 1.0}, "horizon has to be given where gamma is 1"),
    ],
    "reinforce": [
        ({"initial_preferences": [1, 2, 3]}, "initial_preferences must be a number or 4 numbers"),
        ({"initial_preferences": INF}, "initial_preferences must be finite, not inf"),
        ({"learning_rate": "sample_average"}, "learning_rate must be a number or a schedule"),
    ],
    "epsilon_greedy": [
        ({"learning_rate": "averge"}, "a schedule or 'sample_average', not 'averge'"),
    ],
    "ucb": [
        (VECTORS, "observations in a Discrete space"),
        ({"mask_actions": True}, r"^mask_actions: the environment has no method action_masks\(\)"),
    ],
    "kl_ucb": [({"c": NAN}, "c must be at least 0, not nan")],
    "exp3": [
        ({"mixing": 0.0}, "mixing must be above 0, not 0.0"),
        ({"mixing": 1.1}, "mixing must lie between 0 and 1, not 1.1"),
    ],
    "thompson": [
        ({"prior_mean": INF}, "prior_mean must be finite, not inf"),
    ],
    "linucb": [
        (MATRICES, r"observations of shape \(d,\) in a Box space or in a Discrete space"),
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


UNDECLARED = {
    "qlearning": ["gama"],
    "qlearning_ucb": ["learning_rate", "exploration", "initial_q"],
    "lin_thompson": ["ignore_context", "learning_rate"],
    "mabwiser_ucb1": ["mask_actions", "tie_breaking"],
}


@pytest.mark.parametrize("name", UNDECLARED)
def test_arguments_that_nobody_declared(name):
    algorithm = load_algorithm(name)
    for argument in UNDECLARED[name]:
        assert argument not in algorithm.__signature__.parameters
        line = f"^{algorithm.__name__} has no argument '{argument}'"
        with pytest.raises(TypeError, match=line):
            algorithm(env="SegmentBandit-v0", **{argument: 0.5})
