"""The table of agents: where they live, what spaces they fit, and how others are added."""

import importlib.util
import re
import sys
from pathlib import Path

import gymnasium as gym
import pytest
from gymnasium import spaces
from stable_baselines3.common.base_class import BaseAlgorithm

import rl_yardstick.envs  # noqa: F401  # registers the bandits
from rl_yardstick import agents
from rl_yardstick.agents import ALGORITHMS, fitting_algorithms, load_algorithm
from rl_yardstick.agents.bandits.runs import run_batch
from rl_yardstick.pipeline.arguments import constructor_parameters
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
        parameter = constructor_parameters(classes[name]).get("engine")
        default = parameter and parameter.default
        assert (len(entry.engines) > 1) == (default is not None), name
        assert default in {None, *entry.engines[:1]}, name
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
    ("angle", BOX, spaces.Discrete(2), ""),
    ("td3", BOX, DISCRETE, "it acts in Box spaces, not Discrete(4)"),
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


MINE = "some_module:Mine"


@pytest.mark.parametrize(
    ("name", "entry_point", "fields", "complaint"),
    [
        ("PPO", MINE, {}, "there is an agent ppo already (rl_yardstick.agents.library:PPO)"),
        ("taken", "some_module:Other", {}, "register some_module:Other under another name"),
        ("../up", MINE, {}, "the name of an agent holds letters, digits and _"),
        ("mine", MINE, {"action": ["Box"]}, "mine: an entry has no action"),
    ],
)
def test_what_cannot_be_registered(name, entry_point, fields, complaint):
    agents.register("taken", MINE)
    before = dict(ALGORITHMS)
    with pytest.raises(ValueError, match=r".") as caught:
        agents.register(name, entry_point, **fields)
    assert complaint in str(caught.value)
    assert before == ALGORITHMS


DOCUMENT = Path(__file__).parents[2] / "CONTRIBUTING.md"
EXAMPLES = re.findall(r"```python\n(.*?)```", DOCUMENT.read_text(), re.DOTALL)


@pytest.fixture
def example(tmp_path):
    """The class of one of the examples, from a module of its own."""

    def load(name):
        (code,) = [code for code in EXAMPLES if f"class {name}(" in code]
        path = tmp_path / f"example_{name.lower()}.py"
        path.write_text(code)
        spec = importlib.util.spec_from_file_location(path.stem, path)
        module = importlib.util.module_from_spec(spec)
        spec.loader.exec_module(module)
        return getattr(module, name)

    return load


def test_a_tabular_rule(example):
    """Next values 4, 8, 6, 6: half the mean and half the best 8 make 7, and 2 + 0.5 * 7 is 5.5."""
    cautious = example("CautiousQLearning")
    told = Told(cautious, 2, 4, caution=0.5, gamma=0.5, learning_rate=1.0)
    told.agent.policy.q_tables.numpy()[0, 1] = [4, 8, 6, 6]
    told.step(0, 3, 2.0, 1)
    assert told.agent.policy.q_table[0, 3] == 2 + 0.5 * (0.5 * 6 + 0.5 * 8)
    assert cautious(env="FrozenLake-v1").learn(0).engine_in_use == "compiled"
    with pytest.raises(ValueError, match="caution must lie between 0 and 1, not 2"):
        cautious(env="FrozenLake-v1", caution=2)


def test_a_bandit_index(example):
    batch = run_batch(example("MOSS"), {}, "BernoulliBandit-v0", {}, [0, 1], 200)
    assert batch.optimal[:, 100:].mean() > 0.5
