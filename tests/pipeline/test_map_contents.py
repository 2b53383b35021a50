"""Maps are remembered by what is in them."""

import gymnasium as gym
import pytest

from pipeline.environments import with_logs_located, with_maps_read
from pipeline.errors import UserError

ROWS = ["S..", ".#.", "..G"]


@pytest.fixture(autouse=True)
def folder(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "map.txt").write_text("S..\n.#.\n..G\n")


class Library(gym.Env):
    """Knows something else by the name of a map."""


@pytest.mark.parametrize("env_id", ["Warehouse-v0", "MineMaze-v0", "envs:Warehouse-v0"])
@pytest.mark.parametrize("key", ["env_kwargs", "train_env_kwargs", "eval_env_kwargs"])
def test_rows_take_the_place_of_the_path(env_id, key):
    settings = {"gamma": 0.9, key: {"desc": "map.txt", "slip": 0.1}}
    assert with_maps_read(env_id, settings) == {
        "gamma": 0.9,
        key: {"desc": ROWS, "slip": 0.1},
    }
    assert settings[key]["desc"] == "map.txt"
    settings[key]["desc"] = "S..\n.#.\n..G"
    assert with_maps_read(env_id, settings)[key]["desc"] == ROWS


def test_what_is_no_file_is_left_alone(monkeypatch):
    rows = {"env_kwargs": {"desc": ROWS}, "eval_env_kwargs": None}
    assert with_maps_read("Warehouse-v0", rows) == rows
    assert with_maps_read("Warehouse-v0", {}) == {}
    lake = {"env_kwargs": {"desc": "map.txt"}}
    assert with_maps_read("FrozenLake-v1", lake) == lake
    monkeypatch.setitem(
        gym.registry, "Library-v0", gym.envs.registration.EnvSpec("Library-v0", Library)
    )
    assert with_maps_read("Library-v0", lake) == lake


def test_a_missing_file_is_named():
    with pytest.raises(UserError, match=r"Warehouse-v0: desc: cannot read the map file no\.txt"):
        with_maps_read("Warehouse-v0", {"env_kwargs": {"desc": "no.txt"}})


def test_a_log_is_found_from_other_folders(tmp_path):
    settings = {
        "gamma": 0.9,
        "env_kwargs": {"log": "pulls.csv"},
        "eval_env_kwargs": {"log": "/a.csv"},
    }
    assert with_logs_located("ReplayBandit-v0", settings) == {
        "gamma": 0.9,
        "env_kwargs": {"log": str(tmp_path / "pulls.csv")},
        "eval_env_kwargs": {"log": "/a.csv"},
    }
    assert settings["env_kwargs"]["log"] == "pulls.csv"
    assert with_logs_located("FrozenLake-v1", settings) == settings
    assert with_logs_located("ReplayBandit-v0", {"env_kwargs": None}) == {"env_kwargs": None}
