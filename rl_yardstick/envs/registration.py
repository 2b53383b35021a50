"""What Gymnasium knows of this project's environments: ids, entry points, time limits."""

from __future__ import annotations

from typing import Any

from gymnasium.envs import registration

# The limit of the largest random map, until the map is made. Then the wrapper replaces it by the
# map's own limit, unless the caller of `gymnasium.make` gave another.
PATH_MULTIPLE, LARGEST_PATH = 10, 2**24
PATH_LIMIT = registration.WrapperSpec(
    name="PathTimeLimit",
    entry_point="rl_yardstick.envs.wrappers:limit_by_shortest_path",
    kwargs={"multiple": PATH_MULTIPLE, "instead_of": PATH_MULTIPLE * LARGEST_PATH},
)
DARK_WAREHOUSE = {
    "desc": (".......", "#.#.#.#", "#.#.#.#", "#S#G#.#"),
    "shelf_reward": -1,
    "random_start": True,
    "observation": "neighbours",
}
BANDITS = {
    "BernoulliBandit-v0": "rl_yardstick.envs.bandits.clicks:BernoulliBandit",
    "GaussianBandit-v0": "rl_yardstick.envs.bandits.gaussian:GaussianBandit",
    "LinearBandit-v0": "rl_yardstick.envs.bandits.linear:LinearBandit",
    "ReplayBandit-v0": "rl_yardstick.envs.bandits.logged:ReplayBandit",
    "SegmentBandit-v0": "rl_yardstick.envs.bandits.clicks:SegmentBandit",
}
DEFAULT_PULLS = 1000  # stands in for the bandit's own `pulls`
PULLS_LIMIT = registration.WrapperSpec(
    name="PullsLimit",
    entry_point="rl_yardstick.envs.wrappers:limit_by_pulls",
    kwargs={"instead_of": DEFAULT_PULLS},
)
# Entry points in `rl_yardstick.envs.textbook`, and time limits.
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


def register_environments() -> None:
    """Register all environments of this project; those that are registered stay as they are."""
    home = "rl_yardstick.envs"
    _register("Warehouse-v0", f"{home}.warehouse:WarehouseEnv", 1000)
    _register("DarkWarehouse-v0", f"{home}.warehouse:WarehouseEnv", 100, kwargs=DARK_WAREHOUSE)
    _register("MineMaze-v0", f"{home}.mine_maze:MineMazeEnv", 100)
    _register(
        "RandomWarehouse-v0",
        f"{home}.warehouse:RandomWarehouseEnv",
        PATH_MULTIPLE * LARGEST_PATH,
        additional_wrappers=(PATH_LIMIT,),
    )
    for env_id, (place, limit) in TEXTBOOK.items():
        _register(env_id, f"{home}.textbook.{place}", limit)
    for env_id, (place, limit) in HIDING.items():
        _register(env_id, f"{home}.pomdp.{place}", limit)
    for env_id, place in BANDITS.items():
        _register(env_id, place, DEFAULT_PULLS, additional_wrappers=(PULLS_LIMIT,))


def _register(env_id: str, entry_point: str, limit: int, **given: Any) -> None:
    if env_id not in registration.registry:
        registration.register(env_id, entry_point, max_episode_steps=limit, **given)
