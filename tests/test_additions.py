"""What an agent, a bandit's index or a grid world takes: one file, and no change of ours.

Each is written into a folder of its own and trained from there by ``train.py``, tables on compiled
code too. Lines are counted with the docstring and the import lines.
"""

import json
from pathlib import Path

import pytest

RULE = '''
"""Cautious Q-learning."""

from __future__ import annotations

from typing import Any

import numpy as np

import agents
from agents.common.exploration import highest_value
from agents.common.settings import check_share, settings_of
from agents.tabular.algorithm import TabularAlgorithm
from agents.tabular.updates import TabularAgent
from machine_code.compiling import inlined

agents.register("cautious", "cautious:Cautious", observations="Discrete", actions="Discrete")


@inlined
def cautious_value(agent: TabularAgent, env: Any, progress: Any, table: int) -> float:
    """The best next action's value, mixed with the mean of all."""
    mean, caution = agent.room.values.mean(), agent.settings.caution
    return caution * mean + (1.0 - caution) * highest_value(agent.room.values)


class Cautious(TabularAlgorithm):
    """Q-learning that trusts the best next action only in part: ``caution``, in [0, 1]."""

    parameters = {"caution": np.float64}
    next_value = cautious_value

    def __init__(self, *args: Any, caution: float = 0.1, **kwargs: Any) -> None:
        self.caution = caution
        super().__init__(*args, **kwargs)

    def _check_arguments(self) -> None:
        super()._check_arguments()
        check_share(settings_of(self, "caution"))
'''
RULE_SETTINGS = """
FrozenLake-v1:
  n_timesteps: 300
  caution: 0.3
"""
INDEX = '''
"""MOSS."""

from __future__ import annotations

import math

import agents
from agents.bandits.choosing import ScoreAgent
from agents.bandits.upper_bounds import UpperBoundBandit
from machine_code.compiling import inlined

agents.register("moss", "moss:MOSS", observations="Discrete", for_bandits=True)


@inlined
def moss_bound(agent: ScoreAgent, mean: float, count: int, pulls: int) -> float:
    """Mean plus sqrt(max(ln(t / (arms n)), 0) / n) after t pulls."""
    share = pulls / (len(agent.arms) * count)
    return mean + math.sqrt(max(math.log(share), 0.0) / count)


class MOSS(UpperBoundBandit):
    """An index that is optimal in the worst case (Audibert and Bubeck, 2009), at any time."""

    upper_bound = moss_bound
'''
GRID = '''
"""A pond: ice all around, and one hole."""

import gymnasium as gym

from envs.grid import GridWorld
from envs.grid import Tile

gym.register("my/Pond-v0", "pond:Pond", max_episode_steps=50)


class Pond(GridWorld):
    """A robot crosses a pond around a hole, ``H``, that costs it 10 and ends the episode."""

    def __init__(self, slip: float = 0.1, render_mode: str | None = None) -> None:
        ice = Tile(-1.0)
        tiles = {
            ".": ice,
            "S": ice,
            "H": Tile(-10.0, terminated=True),
            "G": Tile(0.0, terminated=True),
        }
        super().__init__(
            ["S...", ".H..", "...G"],
            tiles,
            edge=Tile(-1.0, blocked=True),
            slip=slip,
            random_start=False,
            render_mode=render_mode,
        )
'''


def lines_of(text: str) -> int:
    return len(text.strip().splitlines())


@pytest.fixture
def train(own_folder, type_in_own_folder):
    """Writes a file and trains with it in a folder of a user's; what the run records."""

    def trained(name: str, text: str, *words: str) -> dict[str, object]:
        (own_folder / f"{name}.py").write_text(text.lstrip())
        command = ["train.py", "--gym-packages", name, "--seed", "0", *words]
        code, out, err = type_in_own_folder(*command)
        assert (code, err) == (0, ""), f"{out}{err}"
        (record,) = Path("logs").glob("*/*/run.json")
        return json.loads(record.read_text())

    return trained


def test_a_rule_on_a_table_with_a_setting_of_its_own_is_one_file_and_its_yaml(train, own_folder):
    assert lines_of(RULE) <= 50
    (own_folder / "cautious.yml").write_text(RULE_SETTINGS)
    words = ["--env", "FrozenLake-v1", "--algo", "cautious", "-conf", "cautious.yml"]
    record = train("cautious", RULE, *words)
    assert record["engine"] == "compiled"
    assert record["spec"]["hyperparams"]["caution"] == 0.3
    assert record["final"]["exact"]


def test_a_wrong_value_of_its_setting_is_refused_in_a_line(own_folder, type_in_own_folder):
    (own_folder / "cautious.py").write_text(RULE.lstrip())
    words = ["--env", "FrozenLake-v1", "--algo", "cautious", "-n", "9", "-params", "caution:2"]
    code, _, err = type_in_own_folder("train.py", "--gym-packages", "cautious", *words)
    assert code == 2
    assert err.count("\n") == 1
    assert "caution" in err


def test_an_index_of_a_bandit_is_one_file(train):
    assert lines_of(INDEX) <= 30
    record = train("moss", INDEX, "--env", "BernoulliBandit-v0", "--algo", "moss", "-n", "200")
    assert record["final"]["exact"]
    assert 0 < record["regret"] < 100  # of 200 pulls, each of which can cost half a click


def test_a_grid_world_is_one_file(train):
    record = train("pond", GRID, "--env", "my/Pond-v0", "--algo", "qlearning", "-n", "2000")
    assert record["engine"] == "compiled"
    assert record["final"]["exact"]
    assert record["final"]["optimum"] > -10
