"""The table of agents: where they live, and what spaces they fit."""

import importlib.util
import sys

import gymnasium as gym
import numpy as np
import pytest
from gymnasium import spaces
from stable_baselines3.common.base_class import BaseAlgorithm

from agents import ALGORITHMS, fitting_algorithms, load_algorithm

DISCRETE = spaces.Discrete(4)
BOX = spaces.Box(-1, 1, (4,))
PLANNING = ["value_iteration", "policy_iteration", "optimal"]
TABULAR = [name for name, entry in ALGORITHMS.items() if entry.family == "tabular"]
TILED = [name for name, entry in ALGORITHMS.items() if entry.family == "linear"]
DEEP_Q = ["dqn", "double_dqn", "deep_qlearning"]
CONTRIB = ["qrdqn", "tqc", "crossq", "trpo", "ars", "ppo_lstm", "ppo_mask"]
# What learns on any observation and acts in Discrete spaces, in the order of the table.
NETWORKS = [*DEEP_Q, "ppo", "a2c", "qrdqn", "trpo", "ars", "ppo_lstm"]
CONTINUOUS = ["ppo", "a2c", "sac", "td3", "ddpg", "tqc", "crossq", "trpo", "ars", "ppo_lstm"]


@pytest.mark.parametrize("name", ALGORITHMS)
def test_every_name_stands_for_an_algorithm(name):
    algorithm = load_algorithm(name)
    assert issubclass(algorithm, BaseAlgorithm)
    assert ALGORITHMS[name].entry_point.endswith(f":{algorithm.__name__}")
    assert algorithm.policy_aliases


def test_no_two_names_stand_for_the_same():
    assert len({load_algorithm(name) for name in ALGORITHMS}) == len(ALGORITHMS)
    summaries = [entry.summary for entry in ALGORITHMS.values()]
    assert all(summary == summary.strip() != "" for summary in summaries)
    assert len(set(summaries)) == len(summaries)


def test_an_unknown_name():
    with pytest.raises(KeyError):
        load_algorithm("qlerning")


@pytest.mark.parametrize(
    ("env_id", "names"),
    [
        (
            "CartPole-v1",
            [*TILED, *NETWORKS, "random", "angle"],
        ),
        (
            "FrozenLake-v1",
            [*TABULAR, *TILED, *NETWORKS, *PLANNING, "random"],
        ),
        ("MountainCarContinuous-v0", [*CONTINUOUS, "random"]),
        # Four numbers are observed in CartPole, two here.
        ("MountainCar-v0", [*TILED, *NETWORKS, "random"]),
        ("Blackjack-v1", []),
    ],
)
def test_which_agents_fit(env_id, names):
    env = gym.make(env_id)
    assert fitting_algorithms(env.observation_space, env.action_space) == names
    env.close()


def test_masks_make_one_more_fit():
    assert fitting_algorithms(DISCRETE, DISCRETE, masks=True) == [
        *TABULAR,
        *TILED,
        *NETWORKS,
        "ppo_mask",
        *PLANNING,
        "random",
    ]
    env = OneStep(DISCRETE, DISCRETE)
    assert ALGORITHMS["ppo_mask"].env_misfit(env) == ""
    # A method of the environment serves through wrappers as well.
    assert ALGORITHMS["ppo_mask"].env_misfit(gym.wrappers.TimeLimit(env, 5)) == ""
    assert ALGORITHMS["ppo_mask"].env_misfit(gym.make("CartPole-v1")) == (
        "it needs to be told which actions are valid, by a method action_masks() or by "
        "info['action_mask']"
    )


@pytest.mark.parametrize(
    ("name", "observations", "actions", "misfit"),
    [
        ("qlearning", DISCRETE, DISCRETE, ""),
        ("ppo", BOX, BOX, ""),
        ("sac", BOX, BOX, ""),
        ("td3", BOX, DISCRETE, "it acts in Box spaces, not Discrete(4)"),
        ("ppo", spaces.Dict({"a": BOX}), DISCRETE, ""),
        ("angle", BOX, spaces.Discrete(2), ""),
        ("qlearning", BOX, DISCRETE, f"it observes Discrete spaces, not {BOX}"),
        ("qlearning", DISCRETE, BOX, f"it acts in Discrete spaces, not {BOX}"),
        ("dqn", BOX, BOX, f"it acts in Discrete spaces, not {BOX}"),
        (
            "sarsa",
            spaces.Discrete(4, start=1),
            DISCRETE,
            "it needs Discrete spaces that start at 0, not Discrete(4, start=1)",
        ),
        (
            "a2c",
            BOX,
            spaces.Discrete(2, start=-1),
            "it needs Discrete spaces that start at 0, not Discrete(2, start=-1)",
        ),
        (
            "random",
            spaces.Tuple([DISCRETE]),
            DISCRETE,
            (
                "it observes Box or Discrete or MultiDiscrete or MultiBinary or Dict spaces, "
                "not Tuple(Discrete(4))"
            ),
        ),
        (
            "ppo",
            BOX,
            spaces.Dict({"a": DISCRETE}),
            (
                "it acts in Box or Discrete or MultiDiscrete or MultiBinary spaces, "
                "not Dict('a': Discrete(4))"
            ),
        ),
        (
            "angle",
            spaces.Box(-1, 1, (2,)),
            DISCRETE,
            "it needs observations of shape (4,), not (2,)",
        ),
    ],
)
def test_why_an_agent_does_not_fit(name, observations, actions, misfit):
    assert ALGORITHMS[name].misfit(observations, actions) == misfit


class OneStep(gym.Env):
    """An environment of any spaces whose episodes last one step."""

    def __init__(self, observation_space, action_space):
        self.observation_space = observation_space
        self.action_space = action_space

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        return self.observation_space.sample(), {}

    def step(self, action):
        assert self.action_space.contains(action)
        return self.observation_space.sample(), 0.0, True, False, {}

    def action_masks(self):
        space = self.action_space
        n_choices = {"Discrete": lambda: space.n, "MultiDiscrete": lambda: sum(space.nvec)}
        # Of a MultiBinary action each part can be 0 or 1.
        return np.ones(n_choices.get(type(space).__name__, lambda: 2 * space.n)(), dtype=bool)


SPACES = {
    "Box": spaces.Box(-1, 1, (4,)),
    "Discrete": spaces.Discrete(3),
    "MultiDiscrete": spaces.MultiDiscrete([2, 3]),
    "MultiBinary": spaces.MultiBinary(3),
    "Dict": spaces.Dict({"a": spaces.Box(-1, 1, (2,)), "b": spaces.Discrete(3)}),
}
ON_POLICY = {"n_steps": 4, "batch_size": 4}
SMALL = {
    **dict.fromkeys(["ppo", "ppo_mask"], ON_POLICY),
    # Two of each of their networks, and a memory: smaller, as time goes with their size.
    "ppo_lstm": {**ON_POLICY, "n_epochs": 1, "policy_kwargs": {"lstm_hidden_size": 4}},
    "crossq": {"policy_kwargs": {"net_arch": [8]}},
    "trpo": {"n_steps": 4, "batch_size": 4},
    "ars": {"n_delta": 2},
}


@pytest.mark.parametrize("name", ALGORITHMS)
def test_the_table_tells_the_truth(name):
    """Every agent takes a step in every pair of spaces that it is said to fit."""
    algorithm, entry = load_algorithm(name), ALGORITHMS[name]
    for kind in entry.observations:
        for acts in entry.actions:
            policy = next(iter(algorithm.policy_aliases))
            if kind == "Dict":
                policy = policy.replace("Mlp", "MultiInput")
            env = OneStep(SPACES[kind], SPACES[acts])
            assert entry.misfit(env.observation_space, env.action_space) == ""
            model = algorithm(policy, env, seed=0, **SMALL.get(name, {}))
            if name in PLANNING:
                with pytest.raises(ValueError, match="transition model is known"):
                    model.learn(4)
                continue
            model.learn(4)
            assert model.num_timesteps >= 4


def test_an_optional_package_that_is_missing(monkeypatch):
    find_spec = importlib.util.find_spec
    assert all(entry.is_installed for entry in ALGORITHMS.values())
    monkeypatch.setattr(
        importlib.util, "find_spec", lambda name: None if name == "sb3_contrib" else find_spec(name)
    )
    assert [name for name, entry in ALGORITHMS.items() if not entry.is_installed] == CONTRIB
    assert {ALGORITHMS[name].extra for name in CONTRIB} == {"contrib"}
    # What fits does not depend on what is installed.
    assert "qrdqn" in fitting_algorithms(BOX, DISCRETE)
    monkeypatch.setitem(sys.modules, "sb3_contrib", None)
    with pytest.raises(ModuleNotFoundError, match="sb3_contrib"):
        load_algorithm("qrdqn")
