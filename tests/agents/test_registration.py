"""Agents that are added to the table."""

import subprocess
import sys

import pytest
from gymnasium import spaces

import agents
from agents import ALGORITHMS, fitting_algorithms, load_algorithm


@pytest.fixture(autouse=True)
def table(monkeypatch):
    """Whatever is added goes away again."""
    before = dict(ALGORITHMS)
    yield
    ALGORITHMS.clear()
    ALGORITHMS.update(before)


def test_an_entry_that_says_nothing_fits_any_space():
    agents.register("mine", "some_module:Mine")
    entry = ALGORITHMS["mine"]
    assert (entry.summary, entry.is_installed, entry.family) == ("Mine", True, "")
    for space in (spaces.Discrete(3, start=1), spaces.Tuple([spaces.Discrete(2)]), spaces.Text(3)):
        assert entry.misfit(space, space) == ""
        assert "mine" in fitting_algorithms(space, space)


def test_an_entry_says_what_it_fits():
    agents.register(
        "mine", "some_module:Mine", observations=["Box"], actions="Discrete", for_bandits=True
    )
    entry = ALGORITHMS["mine"]
    box, discrete = spaces.Box(0, 1, (2,)), spaces.Discrete(2)
    assert entry.misfit(box, discrete) == ""
    assert "it observes Box spaces" in entry.misfit(discrete, discrete)
    assert "it acts in Discrete spaces" in entry.misfit(box, box)
    assert "mine" not in fitting_algorithms(box, discrete)
    assert "mine" in fitting_algorithms(box, discrete, bandit=True)


def test_the_same_twice_is_harmless():
    for _ in range(2):
        agents.register("mine", "some_module:Mine", observations=["Box"])
    assert list(ALGORITHMS)[-1] == "mine"


@pytest.mark.parametrize(
    ("name", "entry_point", "fields", "complaint"),
    [
        ("ppo", "some_module:Mine", {}, "an agent ppo already (agents.library:PPO)"),
        ("PPO", "some_module:Mine", {}, "there is an agent ppo already"),
        ("taken", "some_module:Other", {}, "register some_module:Other under another name"),
        ("taken", "some_module:Mine", {"actions": ["Box"]}, "there is an agent taken already"),
        ("../up", "some_module:Mine", {}, "the name of an agent holds letters, digits and _"),
        ("a/b", "some_module:Mine", {}, "not 'a/b'"),
        ("", "some_module:Mine", {}, "not ''"),
        ("mine", "some_module.Mine", {}, "is named as 'module:Class', not 'some_module.Mine'"),
        ("mine", dict, {}, "is named as 'module:Class'"),
        ("mine", "some_module:Mine", {"action": ["Box"]}, "mine: an entry has no action"),
        ("mine", "some_module:Mine", {"actions": "Bx"}, "actions are names of Gymnasium's spaces"),
        ("mine", "some_module:Mine", {"observations": [spaces.Box]}, "observations are names"),
    ],
)
def test_what_cannot_be_registered(name, entry_point, fields, complaint):
    agents.register("taken", "some_module:Mine")
    before = dict(ALGORITHMS)
    with pytest.raises(ValueError, match=r".") as caught:
        agents.register(name, entry_point, **fields)
    assert complaint in str(caught.value)
    assert before == ALGORITHMS


@pytest.mark.parametrize(
    ("entry_point", "complaint"),
    [
        ("gymnasium:Typo", "mine is registered as gymnasium:Typo, which does not exist"),
        ("gymnasium:Env", "which is no subclass of BaseAlgorithm"),
    ],
)
def test_a_class_that_is_none(entry_point, complaint):
    agents.register("mine", entry_point)
    with pytest.raises(ValueError, match=complaint):
        load_algorithm("mine")


def test_what_an_agent_needs_is_said_with_its_package():
    agents.register("mine", "some_module:Mine", package="no_such_package_of_mine")
    entry = ALGORITHMS["mine"]
    assert not entry.is_installed
    assert entry.install_command == "pip install no_such_package_of_mine"
    assert ALGORITHMS["qrdqn"].install_command == "pip install 'rl-yardstick[contrib]'"


def test_registering_is_light():
    code = (
        "import sys, agents\n"
        "agents.register('mine', 'some_module:Mine')\n"
        "print({'torch', 'numba', 'stable_baselines3', 'some_module'} & {*sys.modules})"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout.strip() == "set()"
