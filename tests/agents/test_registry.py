"""The table of agents: where they live, what spaces they fit, and how others are added."""

import importlib.util
import re
import sys
from pathlib import Path

import gymnasium as gym
import numpy as np
import pytest
from gymnasium import spaces
from stable_baselines3.common.base_class import BaseAlgorithm

import agents
import envs  # noqa: F401  # registers the bandits
from agents import ALGORITHMS, fitting_algorithms, load_algorithm
from agents.bandits.runs import run_batch, run_one_by_one
from pipeline.settings.values import algorithm_parameters
from tests.agents.hand_fed import Told

DISCRETE, BOX = spaces.Discrete(4), spaces.Box(-1, 1, (4,))
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


@pytest.fixture(autouse=True)
def table():
    """Whatever is added goes away again."""
    before = dict(ALGORITHMS)
    yield
    ALGORITHMS.clear()
    ALGORITHMS.update(before)


def test_every_name_stands_for_an_algorithm_of_its_own():
    classes = {name: load_algorithm(name) for name in ALGORITHMS}
    assert len(set(classes.values())) == len(ALGORITHMS)
    for name, entry in ALGORITHMS.items():
        assert issubclass(classes[name], BaseAlgorithm)
        assert entry.entry_point.endswith(f":{classes[name].__name__}")
        assert classes[name].policy_aliases
        # What `--engine` offers without importing a class is what its constructor takes.
        parameter = algorithm_parameters(classes[name]).get("engine")
        default = parameter and parameter.default
        assert (len(entry.engines) > 1) == (default is not None), name
        assert default in {None, *entry.engines[:1]}, name
    summaries = [entry.summary for entry in ALGORITHMS.values()]
    assert all(summary == summary.strip() != "" for summary in summaries)
    assert len(set(summaries)) == len(summaries)
    with pytest.raises(KeyError):
        load_algorithm("qlerning")


@pytest.mark.parametrize(
    ("env_id", "names"),
    [
        ("CartPole-v1", [*TILED, *NETWORKS, "random", "angle"]),
        ("FrozenLake-v1", [*TABULAR, *TILED, *NETWORKS, *PLANNING, "random"]),
        # Which tells of masks.
        ("Warehouse-v0", [*TABULAR, *TILED, *NETWORKS, "ppo_mask", *PLANNING, "random"]),
        ("MountainCarContinuous-v0", [*CONTINUOUS, "random"]),
        # Four numbers are observed in CartPole, two here.
        ("MountainCar-v0", [*TILED, *NETWORKS, "random"]),
        ("Blackjack-v1", []),
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
    untold = "it needs to be told which actions are valid, by a method action_masks() or by "
    if env_id == "CartPole-v1":
        assert misfits["ppo_mask"] == f"{untold}info['action_mask']"
    for bandit, bandits in (("SegmentBandit-v0", BANDITS), ("LinearBandit-v0", LINEAR)):
        env = gym.make(bandit)
        assert [name for name in BANDITS if not ALGORITHMS[name].env_misfit(env)] == bandits


ANY = "Box or Discrete or MultiDiscrete or MultiBinary"
MISFITS = [  # agent, observations, actions, and why it does not fit
    ("qlearning", DISCRETE, DISCRETE, ""),
    ("ppo", spaces.Dict({"a": BOX}), DISCRETE, ""),
    ("angle", BOX, spaces.Discrete(2), ""),
    ("td3", BOX, DISCRETE, "it acts in Box spaces, not Discrete(4)"),
    ("qlearning", BOX, DISCRETE, f"it observes Discrete spaces, not {BOX}"),
    ("sarsa", spaces.Discrete(4, start=1), DISCRETE,
     "it needs Discrete spaces that start at 0, not Discrete(4, start=1)"),
    ("random", spaces.Tuple([DISCRETE]), DISCRETE,
     f"it observes {ANY} or Dict spaces, not Tuple(Discrete(4))"),
    ("angle", spaces.Box(-1, 1, (2,)), DISCRETE,
     "it needs observations of shape (4,), not (2,)"),
]  # fmt: skip


@pytest.mark.parametrize(("name", "observations", "actions", "misfit"), MISFITS)
def test_why_an_agent_does_not_fit(name, observations, actions, misfit):
    assert ALGORITHMS[name].misfit(observations, actions) == misfit


class OneStep(gym.Env):
    """An environment of any spaces whose episodes last one step."""

    def __init__(self, observation_space, action_space):
        self.observation_space, self.action_space = observation_space, action_space

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
    **dict.fromkeys(["ppo", "ppo_mask", "trpo"], ON_POLICY),
    # Two of each of their networks, and a memory: smaller, as time goes with their size.
    "ppo_lstm": {**ON_POLICY, "n_epochs": 1, "policy_kwargs": {"lstm_hidden_size": 4}},
    "crossq": {"policy_kwargs": {"net_arch": [8]}},
    "ars": {"n_delta": 2},
}


@pytest.mark.parametrize("name", ALGORITHMS)
def test_the_table_tells_the_truth(name):
    """Every agent takes a step in every pair of spaces that it is said to fit."""
    algorithm, entry = load_algorithm(name), ALGORITHMS[name]
    for kind in entry.observations:
        for acts in entry.actions:
            policy = next(iter(algorithm.policy_aliases))
            policy = policy.replace("Mlp", "MultiInput") if kind == "Dict" else policy
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
    missing = lambda name: None if name == "sb3_contrib" else find_spec(name)  # noqa: E731
    monkeypatch.setattr(importlib.util, "find_spec", missing)  # as where it is not installed
    assert [name for name, entry in ALGORITHMS.items() if not entry.is_installed] == CONTRIB
    assert {ALGORITHMS[name].install_command for name in CONTRIB} == {
        "pip install 'rl-yardstick[contrib]'"
    }
    # What fits does not depend on what is installed.
    assert "qrdqn" in fitting_algorithms(BOX, DISCRETE)
    monkeypatch.setitem(sys.modules, "sb3_contrib", None)
    with pytest.raises(ModuleNotFoundError, match="sb3_contrib"):
        load_algorithm("qrdqn")


# --- agents that are added -----------------------------------------------------------------------


def test_an_entry_says_what_it_fits_and_fits_all_where_it_says_nothing():
    for _ in range(2):  # the same twice is harmless
        agents.register("mine", "some_module:Mine")
    entry = ALGORITHMS["mine"]
    assert list(ALGORITHMS)[-1] == "mine"
    assert (entry.summary, entry.is_installed, entry.family) == ("Mine", True, "")
    for space in (spaces.Discrete(3, start=1), spaces.Tuple([spaces.Discrete(2)]), spaces.Text(3)):
        assert entry.misfit(space, space) == ""
        assert "mine" in fitting_algorithms(space, space)
    fields = {"observations": ["Box"], "actions": "Discrete", "for_bandits": True}
    agents.register("own", "some_module:Own", package="no_such_package_of_mine", **fields)
    entry = ALGORITHMS["own"]
    assert entry.misfit(BOX, DISCRETE) == ""
    assert "it observes Box spaces" in entry.misfit(DISCRETE, DISCRETE)
    assert "it acts in Discrete spaces" in entry.misfit(BOX, BOX)
    assert "own" not in fitting_algorithms(BOX, DISCRETE)
    assert "own" in fitting_algorithms(BOX, DISCRETE, bandit=True)
    assert not entry.is_installed
    assert entry.install_command == "pip install no_such_package_of_mine"


MINE = "some_module:Mine"


@pytest.mark.parametrize(
    ("name", "entry_point", "fields", "complaint"),
    [
        ("PPO", MINE, {}, "there is an agent ppo already (agents.library:PPO)"),
        ("taken", "some_module:Other", {}, "register some_module:Other under another name"),
        ("taken", MINE, {"actions": ["Box"]}, "there is an agent taken already"),
        ("../up", MINE, {}, "the name of an agent holds letters, digits and _"),
        ("", MINE, {}, "not ''"),
        ("mine", "some_module.Mine", {}, "is named as 'module:Class', not 'some_module.Mine'"),
        ("mine", MINE, {"action": ["Box"]}, "mine: an entry has no action"),
        ("mine", MINE, {"actions": "Bx"}, "actions are names of Gymnasium's spaces"),
        ("mine", MINE, {"observations": [spaces.Box]}, "observations are names"),
    ],
)
def test_what_cannot_be_registered(name, entry_point, fields, complaint):
    agents.register("taken", MINE)
    before = dict(ALGORITHMS)
    with pytest.raises(ValueError, match=r".") as caught:
        agents.register(name, entry_point, **fields)
    assert complaint in str(caught.value)
    assert before == ALGORITHMS


def test_a_class_that_is_none():
    for entry_point, complaint in (
        ("gymnasium:Typo", "mine is registered as gymnasium:Typo, which does not exist"),
        ("gymnasium:Env", "which is no subclass of BaseAlgorithm"),
    ):
        agents.register("mine", entry_point)
        with pytest.raises(ValueError, match=complaint):
            load_algorithm("mine")
        del ALGORITHMS["mine"]


# --- the agents that CONTRIBUTING.md writes, as they stand there ----------------------------------

DOCUMENT = Path(__file__).parents[2] / "CONTRIBUTING.md"
EXAMPLES = re.findall(r"```python\n(.*?)```", DOCUMENT.read_text(), re.DOTALL)
# An entry in the table of agents, and hyperparameters.
OTHER_LINES = 7


@pytest.fixture
def example(tmp_path):
    """The class of one of the examples, from a module of its own, and the module's lines."""

    def load(name):
        (code,) = [code for code in EXAMPLES if f"class {name}(" in code]
        path = tmp_path / f"example_{name.lower()}.py"
        path.write_text(code)
        spec = importlib.util.spec_from_file_location(path.stem, path)
        module = importlib.util.module_from_spec(spec)
        spec.loader.exec_module(module)
        return getattr(module, name), len(code.splitlines())

    return load


def test_a_tabular_rule(example):
    """Next values 4, 8, 6, 6: half the mean and half the best 8 make 7, and 2 + 0.5 * 7 is 5.5."""
    cautious, lines = example("CautiousQLearning")
    assert lines + OTHER_LINES <= 45
    told = Told(cautious, 2, 4, caution=0.5, gamma=0.5, learning_rate=1.0)
    told.agent.policy.q_tables.numpy()[0, 1] = [4, 8, 6, 6]
    told.step(0, 3, 2.0, 1)
    assert told.agent.policy.q_table[0, 3] == 2 + 0.5 * (0.5 * 6 + 0.5 * 8)
    assert cautious(env="FrozenLake-v1").learn(0).engine_in_use == "compiled"
    with pytest.raises(ValueError, match="caution must lie between 0 and 1, not 2"):
        cautious(env="FrozenLake-v1", caution=2)


def test_a_bandit_index(example):
    moss, lines = example("MOSS")
    assert lines + OTHER_LINES <= 30
    arguments = moss, {}, "BernoulliBandit-v0", {}, [0, 1], 200
    batch, single = run_batch(*arguments), run_one_by_one(*arguments)
    assert np.array_equal(batch.arms, single.arms)
    assert np.array_equal(batch.rewards, single.rewards)
    assert batch.optimal[:, 100:].mean() > 0.5
