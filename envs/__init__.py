"""Gymnasium environments whose optimum is known exactly; importing the package registers them."""

from __future__ import annotations

import importlib
from typing import Any

import gymnasium as gym
from gymnasium.envs.registration import WrapperSpec

from envs.grid import MAX_STATES

__all__ = ["ModelCheck", "check_transition_model"]  # loaded when asked for

PATH_MULTIPLE = 10
BANDITS = {
    "BernoulliBandit-v0": "envs.bandits.clicks:BernoulliBandit",
    "GaussianBandit-v0": "envs.bandits.gaussian:GaussianBandit",
    "LinearBandit-v0": "envs.bandits.linear:LinearBandit",
    "ReplayBandit-v0": "envs.bandits.logged:ReplayBandit",
    "SegmentBandit-v0": "envs.bandits.clicks:SegmentBandit",
}
DEFAULT_PULLS = 1000
# Entry points in `envs.textbook`, and time limits.
TEXTBOOK = {
    "DeepSea-v0": ("deep_sea:DeepSeaEnv", 1000),
    "DynaMaze-v0": ("dyna_maze:DynaMazeEnv", 100),
    "GamblersProblem-v0": ("gamblers_problem:GamblersProblemEnv", 1000),
    "JacksCarRental-v0": ("jacks_car_rental:JacksCarRentalEnv", 100),
    "MaximizationBias-v0": ("maximization_bias:MaximizationBiasEnv", 100),
    "Racetrack-v0": ("racetrack:RacetrackEnv", 1000),
    "RandomWalk-v0": ("random_walk:RandomWalkEnv", 1000),
    "RiverSwim-v0": ("river_swim:RiverSwimEnv", 20),
    "ShortCorridor-v0": ("short_corridor:ShortCorridorEnv", 1000),
    "WindyGridworld-v0": ("windy_gridworld:WindyGridworldEnv", 1000),
}
# Where observations hide the state: entry points in `envs.pomdp`, and time limits.
HIDING = {
    "Hallway-v0": ("hallway:HallwayEnv", 30),
    "Tiger-v0": ("tiger:TigerEnv", 10),
}

gym.register(
    id="Warehouse-v0",
    entry_point="envs.warehouse:WarehouseEnv",
    max_episode_steps=1000,
)
gym.register(
    id="DarkWarehouse-v0",
    entry_point="envs.warehouse:WarehouseEnv",
    max_episode_steps=100,
    kwargs={
        "desc": (".......", "#.#.#.#", "#.#.#.#", "#S#G#.#"),
        "shelf_reward": -1,
        "random_start": True,
        "observation": "neighbours",
    },
)
gym.register(
    id="MineMaze-v0",
    entry_point="envs.mine_maze:MineMazeEnv",
    max_episode_steps=100,
)
gym.register(
    id="RandomWarehouse-v0",
    entry_point="envs.warehouse:RandomWarehouseEnv",
    # The limit of the largest possible map, until the map is made: then the wrapper replaces it by
    # the map's own limit, unless the caller of `gym.make` gave another.
    max_episode_steps=PATH_MULTIPLE * MAX_STATES,
    additional_wrappers=(
        WrapperSpec(
            name="PathTimeLimit",
            entry_point="envs.wrappers:limit_by_shortest_path",
            kwargs={"multiple": PATH_MULTIPLE, "instead_of": PATH_MULTIPLE * MAX_STATES},
        ),
    ),
)
for textbook_id, (place, limit) in TEXTBOOK.items():
    gym.register(id=textbook_id, entry_point=f"envs.textbook.{place}", max_episode_steps=limit)
for hiding_id, (place, limit) in HIDING.items():
    gym.register(id=hiding_id, entry_point=f"envs.pomdp.{place}", max_episode_steps=limit)
for bandit_id, entry_point in BANDITS.items():
    gym.register(
        id=bandit_id,
        entry_point=entry_point,
        # Stands in for the bandit's own `pulls`, as the largest map's limit does above.
        max_episode_steps=DEFAULT_PULLS,
        additional_wrappers=(
            WrapperSpec(
                name="PullsLimit",
                entry_point="envs.wrappers:limit_by_pulls",
                kwargs={"instead_of": DEFAULT_PULLS},
            ),
        ),
    )


def __getattr__(name: str) -> Any:
    # Loaded on first use: registering environments is all that most need.
    if name not in __all__:
        raise AttributeError(f"module 'envs' has no attribute {name!r}")
    return getattr(importlib.import_module("envs.checking"), name)
