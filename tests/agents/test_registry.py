"""The table of agents: where they live, what spaces they fit, and how others are added."""

import importlib.util
from pathlib import Path
from unittest.mock import patch

import gymnasium as gym
import numpy as np
import pytest
from gymnasium import spaces
from stable_baselines3.common.base_class import BaseAlgorithm

from rl_yardstick import agents
from rl_yardstick.agents import ALGORITHMS, fitting_algorithms, load_algorithm
from rl_yardstick.pipeline.components import constructor_parameters
from rl_yardstick.pipeline.settings import read_yaml
from tests.agents.hand_fed import Spaces

DISCRETE, BOX = spaces.Discrete(4), spaces.Box(-1, 1, (4,))
FROM_ONE = spaces.MultiDiscrete([2, 2], start=[1, 0])
PLANNING = ["value_iteration", "policy_iteration", "optimal"]
TABULAR = [name for name, entry in ALGORITHMS.items() if entry.family == "tabular"]
TILED = [name for name, entry in ALGORITHMS.items() if entry.family == "linear"]
BANDITS = [name for name, entry in ALGORITHMS.items() if entry.for_bandits]
LINEAR = ["linucb", "lin_thompson", "lin_epsilon_greedy", "mabwiser_linucb"]
CONTRIB = ["qrdqn", "tqc", "crossq", "trpo", "ars", "ppo_lstm", "ppo_mask"]
# What learns on any observation and acts in Discrete spaces, in the order of the table.
DEEP_Q = ["dqn", "double_dqn", "deep_qlearning"]
NETWORKS = [*DEEP_Q, "ppo", "a2c", "qrdqn", "trpo", "ars", "ppo_lstm"]
CONTINUOUS = ["ppo", "a2c", "sac", "td3", "ddpg", "tqc", "crossq", "trpo", "ars", "ppo_lstm"]


def test_every_name_stands_for_an_algorithm_of_its_own():
    classes = {name: load_algorithm(name) for name in ALGORITHMS}
    assert len(set(classes.values())) == len(ALGORITHMS)
    for name, entry in ALGORITHMS.items():
        assert issubclass(classes[name], BaseAlgorithm)
        assert entry.entry_point.endswith(f":{classes[name].__name__}")
        assert classes[name].policy_aliases
        # What `--engine` offers without importing a class is what its constructor takes.
        parameter = constructor_parameters(classes[name]).get("engine")
        default = parameter and parameter.default
        assert (len(entry.engines) > 1) == (default is not None), name
        assert default in {None, *entry.engines[:1]}, name


@pytest.mark.parametrize(
    ("env_id", "names"),
    [
        ("CartPole-v1", [*TILED, *NETWORKS, "random", "angle"]),
        ("FrozenLake-v1", [*TABULAR, *TILED, *NETWORKS, *PLANNING, "random"]),
        # Which tells of masks.
        ("Warehouse-v0", [*TABULAR, *TILED, *NETWORKS, "ppo_mask", *PLANNING, "random"]),
        ("MountainCarContinuous-v0", [*CONTINUOUS, "random"]),
        ("Blackjack-v1", [*TABULAR, *TILED, *PLANNING, "random"]),
    ],
)
def test_which_agents_fit(env_id, names):
    env = gym.make(env_id)
    masks = env_id == "Warehouse-v0"
    assert fitting_algorithms(env.observation_space, env.action_space, masks=masks) == names
    misfits = {name: entry.env_misfit(env) for name, entry in ALGORITHMS.items()}
    assert [name for name, misfit in misfits.items() if not misfit] == names
    reason = "it is for bandits, where a pull changes nothing but its own reward"
    assert {misfits[name] for name in BANDITS} == {reason}
    if env_id == "CartPole-v1":
        untold = "it needs to be told which actions are valid, by a method action_masks() or by "
        assert misfits["ppo_mask"] == f"{untold}info['action_mask']"
    for bandit, bandits in (("SegmentBandit-v0", BANDITS), ("LinearBandit-v0", LINEAR)):
        env = gym.make(bandit)
        assert [name for name in BANDITS if not ALGORITHMS[name].env_misfit(env)] == bandits


ANY = "Box or Discrete or MultiDiscrete or MultiBinary"
MIXED = spaces.Dict(at=BOX, to=FROM_ONE)
NOT_ZERO = "it needs Discrete spaces that start at 0, not"
TABLES = "it observes Discrete spaces"
MISFITS = [  # agent, observations, actions, and why it does not fit
    ("qlearning", DISCRETE, DISCRETE, ""),
    ("angle", BOX, spaces.Discrete(2), ""),
    ("td3", BOX, DISCRETE, "it acts in Box spaces, not Discrete(4)"),
    ("sarsa", spaces.Discrete(4, start=1), spaces.MultiBinary(3), ""),
    ("random", spaces.Tuple([DISCRETE]), DISCRETE, ""),
    ("ppo", spaces.Tuple([DISCRETE]), DISCRETE,
     f"it observes {ANY} or Dict spaces, not Tuple(Discrete(4))"),
    ("optimal", spaces.Box(0, 9, (9,), np.uint8), spaces.Discrete(2),
     f"{TABLES}, not Box(0, 9, (9,), uint8) of this size (a table of 1e+09 x 2 needs 16 GB)"),
    ("dqn", spaces.Discrete(4, start=1), DISCRETE, f"{NOT_ZERO} Discrete(4, start=1)"),
    ("ppo", BOX, FROM_ONE, f"{NOT_ZERO} MultiDiscrete([2 2], start=[1 0])"),
    ("a2c", MIXED, DISCRETE, f"{NOT_ZERO} {MIXED}: shift it by Gymnasium's TransformObservation"),
    ("ppo", BOX, spaces.Box(-1, 0, (2,), np.int64), "it acts in no Box(-1, 0, (2,), int64)"),
    ("ppo", spaces.Box(0, 9, (), np.int32), DISCRETE, "it observes no Box(0, 9, (), int32)"),
    ("dqn", spaces.MultiDiscrete([[2, 3]]), DISCRETE, "it observes no MultiDiscrete([[2 3]])"),
    ("angle", spaces.Box(-1, 1, (2,)), DISCRETE,
     "it needs observations of shape (4,), not (2,)"),
]  # fmt: skip


@pytest.mark.parametrize(("name", "observations", "actions", "misfit"), MISFITS)
def test_why_an_agent_does_not_fit(name, observations, actions, misfit):
    assert ALGORITHMS[name].misfit(observations, actions) == misfit


def test_an_optional_package_that_is_missing(monkeypatch):
    find_spec = importlib.util.find_spec
    assert all(entry.is_installed for entry in ALGORITHMS.values())
    missing = lambda name: None if name == "sb3_contrib" else find_spec(name)  # noqa: E731
    monkeypatch.setattr(importlib.util, "find_spec", missing)  # as where it is not installed
    assert [name for name, entry in ALGORITHMS.items() if not entry.is_installed] == CONTRIB
    commands = {ALGORITHMS[name].install_command for name in CONTRIB}
    assert commands == {"pip install 'rl-yardstick[contrib]'"}
    # What fits does not depend on what is installed.
    assert "qrdqn" in fitting_algorithms(BOX, DISCRETE)


@pytest.mark.parametrize("name", ["ppo", "taken"])
@patch.dict(ALGORITHMS)  # whatever is added goes away again
def test_a_name_is_registered_once(name):
    agents.register("taken", "some_module:Mine")
    before = dict(ALGORITHMS)
    agents.register("taken", "some_module:Mine")  # the same class again
    line = f"there is an agent {name} already: give other:Mine another"
    with pytest.raises(ValueError, match=line):
        agents.register(name, "other:Mine")
    assert before == ALGORITHMS


REFUSED = [
    *read_yaml(Path(__file__).with_name("wrong_arguments.yml")),
    ("ucb", {"env": Spaces(spaces.Box(-1, 1, (4,)))}, "observations in a Discrete space"),
    ("linucb", {"env": Spaces(spaces.Box(-1, 1, (2, 2)))},
     r"observations of shape \(d,\) in a Box space or in a Discrete space"),
]  # fmt: skip


@pytest.mark.parametrize(("name", "arguments", "line"), REFUSED)
def test_wrong_arguments(name, arguments, line):
    usual = "SegmentBandit-v0" if ALGORITHMS[name].for_bandits else "FrozenLake-v1"
    with pytest.raises((TypeError, ValueError), match=line) as refusal:
        load_algorithm(name)(**{"env": usual, **arguments})
    assert "\n" not in str(refusal.value)
