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

DARK_WAREHOUSE = {
    "desc": (".......", "#.#.#.#", "#.#.#.#", "#S#G#.#"),
    "shelf_reward": -1,
    "random_start": True,
    "observation": "neighbours",
}
# Entry points in `rl_yardstick.envs`, and time limits.
ENVIRONMENTS = {
    "DarkWarehouse-v0": ("warehouse:WarehouseEnv", 100),
    "RandomWarehouse-v0": ("warehouse:RandomWarehouseEnv", PATH_MULTIPLE * LARGEST_PATH),
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
    "BernoulliBandit-v0": ("bandits.clicks:BernoulliBandit", DEFAULT_PULLS),
    "GaussianBandit-v0": ("bandits.gaussian:GaussianBandit", DEFAULT_PULLS),
    "LinearBandit-v0": ("bandits.linear:LinearBandit", DEFAULT_PULLS),
    "ReplayBandit-v0": ("bandits.logged:ReplayBandit", DEFAULT_PULLS),
    "SegmentBandit-v0": ("bandits.clicks:SegmentBandit", DEFAULT_PULLS),
}


def register_environments() -> None:
    """Register all environments of this project; those that are registered stay as they are."""
    home = "rl_yardstick.envs"
    for env_id, (place, steps) in ENVIRONMENTS.items():
        if env_id in registration.registry:
            continue
        given: dict[str, Any] = {"kwargs": DARK_WAREHOUSE} if env_id[:4] == "Dark" else {}
        if place.startswith("bandits.") or env_id == "RandomWarehouse-v0":
            own = {"attribute": "pulls", "multiple": 1, "instead_of": steps}
            if env_id == "RandomWarehouse-v0":
                own |= {"attribute": "shortest_path_length", "multiple": PATH_MULTIPLE}
            limit = f"{home}.wrappers:own_time_limit"
            wrapper = registration.WrapperSpec("OwnTimeLimit", limit, own)
            given = {"additional_wrappers": (wrapper,)}
        registration.register(env_id, f"{home}.{place}", max_episode_steps=steps, **given)


register_environments()
