"""Gymnasium environments whose optimum is known exactly; importing the package registers them.

Gymnasium imports it by itself for an id such as ``rl_yardstick.envs:Warehouse-v0``.
"""

from __future__ import annotations

from typing import Any

from gymnasium.envs import registration

# The limit of the largest random map, until the map is made. Then the wrapper replaces it by the
# map's own limit, unless the caller of `gymnasium.make` gave another.
PATH_MULTIPLE, LARGEST_PATH = 10, 2**24
DEFAULT_PULLS = 1000  # stands in for a bandit's own `pulls`, likewise


def _own_limit(attribute: str, multiple: int, instead_of: int) -> registration.WrapperSpec:
    return registration.WrapperSpec(
        name="OwnTimeLimit",
        entry_point="rl_yardstick.envs.wrappers:own_time_limit",
        kwargs={"attribute": attribute, "multiple": multiple, "instead_of": instead_of},
    )


DARK_WAREHOUSE = {
    "desc": (".......", "#.#.#.#", "#.#.#.#", "#S#G#.#"),
    "shelf_reward": -1,
    "random_start": True,
    "observation": "neighbours",
}
# Entry points in `rl_yardstick.envs.bandits`.
BANDITS = {
    "BernoulliBandit-v0": "clicks:BernoulliBandit",
    "GaussianBandit-v0": "gaussian:GaussianBandit",
    "LinearBandit-v0": "linear:LinearBandit",
    "ReplayBandit-v0": "logged:ReplayBandit",
    "SegmentBandit-v0": "clicks:SegmentBandit",
}
# Entry points in `rl_yardstick.envs`, and time limits.
FINITE = {
    "DeepSea-v0": ("textbook.grids:DeepSeaEnv", 1000),
    "DynaMaze-v0": ("textbook.grids:DynaMazeEnv", 100),
    "GamblersProblem-v0": ("textbook.dynamic_programming:GamblersProblemEnv", 1000),
    "JacksCarRental-v0": ("textbook.dynamic_programming:JacksCarRentalEnv", 100),
    "MaximizationBias-v0": ("textbook.chains:MaximizationBiasEnv", 100),
    "Racetrack-v0": ("textbook.racetrack:RacetrackEnv", 1000),
    "RandomWalk-v0": ("textbook.chains:RandomWalkEnv", 1000),
    "RiverSwim-v0": ("textbook.chains:RiverSwimEnv", 20),
    "ShortCorridor-v0": ("textbook.chains:ShortCorridorEnv", 1000),
    "WindyGridworld-v0": ("textbook.grids:WindyGridworldEnv", 1000),
    "Hallway-v0": ("pomdp:HallwayEnv", 30),
    "Tiger-v0": ("pomdp:TigerEnv", 10),
    "Warehouse-v0": ("warehouse:WarehouseEnv", 1000),
    "MineMaze-v0": ("mine_maze:MineMazeEnv", 100),
}


def register_environments() -> None:
    """Register all environments of this project; those that are registered stay as they are."""
    home = "rl_yardstick.envs"
    _register("DarkWarehouse-v0", f"{home}.warehouse:WarehouseEnv", 100, kwargs=DARK_WAREHOUSE)
    _register(
        "RandomWarehouse-v0",
        f"{home}.warehouse:RandomWarehouseEnv",
        PATH_MULTIPLE * LARGEST_PATH,
        additional_wrappers=(
            _own_limit("shortest_path_length", PATH_MULTIPLE, PATH_MULTIPLE * LARGEST_PATH),
        ),
    )
    for env_id, (place, steps) in FINITE.items():
        _register(env_id, f"{home}.{place}", steps)
    for env_id, place in BANDITS.items():
        limit = _own_limit("pulls", 1, DEFAULT_PULLS)
        _register(env_id, f"{home}.bandits.{place}", DEFAULT_PULLS, additional_wrappers=(limit,))


def _register(env_id: str, entry_point: str, limit: int, **given: Any) -> None:
    if env_id not in registration.registry:
        registration.register(env_id, entry_point, max_episode_steps=limit, **given)


register_environments()
