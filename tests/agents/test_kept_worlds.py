"""Compiled environments are kept, and never where what they were made from has changed."""

import gc
from dataclasses import replace

import gymnasium as gym
import numpy as np
import pytest
from gymnasium.envs.toy_text.frozen_lake import FrozenLakeEnv
from gymnasium.wrappers import ClipReward, TimeLimit
from stable_baselines3.common.env_util import make_vec_env
from stable_baselines3.common.monitor import Monitor
from stable_baselines3.common.vec_env import DummyVecEnv

import envs  # noqa: F401  # registers the environments
from agents import load_algorithm
from agents.compiled import compile_envs as module
from agents.compiled import kept_worlds
from agents.compiled.compile_envs import NotCompilable, compile_envs
from envs.grid_dynamics import Tile
from envs.map_generation import random_warehouse
from envs.warehouse import WarehouseEnv
from envs.wrappers import FlattenToDiscrete, ScaleReward, TerminationReward


def forget():
    """As in a new process."""
    kept_worlds._of_envs.clear()
    kept_worlds._small.clear()


@pytest.fixture(autouse=True)
def built(monkeypatch):
    """How often an environment was worked out."""
    made = []
    work_out = module._finite_model
    monkeypatch.setattr(module, "_finite_model", lambda env: made.append(env) or work_out(env))
    forget()
    return made


def lake(**kwargs):
    return make_vec_env("FrozenLake-v1", 1, seed=0, **kwargs)


def house(**kwargs):
    return make_vec_env("envs:Warehouse-v0", 1, seed=0, **kwargs)


def base(vec_env):
    return vec_env.envs[0].unwrapped


def equal(world, other):
    return all(np.array_equal(mine, its) for mine, its in zip(world, other, strict=True))


def layer(vec_env, kind):
    env = vec_env.envs[0]
    while not isinstance(env, kind):
        env = env.env
    return env


def test_each_training_finds_the_world_of_the_one_before(built):
    agent = load_algorithm("qlearning")(env=house(), seed=0)
    for _ in range(3):
        agent.learn(50)
    assert agent.engine_in_use == "compiled"
    assert len(built) == 1


def test_eight_equal_environments_are_worked_out_once(built):
    world = compile_envs(make_vec_env("envs:Warehouse-v0", 8, seed=0))
    assert len(built) == 1
    assert compile_envs(house()) is world


def test_another_agent_finds_it_too_and_a_large_one_goes_with_its_environments(built):
    large = {"env_kwargs": {"desc": random_warehouse(200, 0.3, 0)}}
    env = house(**large)
    compile_envs(env)
    compile_envs(house(**large))
    assert len(built) == 1
    del env
    gc.collect()
    compile_envs(house(**large))
    assert len(built) == 2


def set_tile(env):
    env.dynamics.tiles[ord("#")] = Tile(-7, blocked=True)


def change_outcome(env):
    env.P[14][2][1] = (1 / 3, 15, 0.5, True)


LAKE_CHANGES = {
    "an outcome in place": change_outcome,
    "a list of outcomes": lambda env: env.P[0].update({1: [(1.0, 15, 1.0, True)]}),
    "a whole model": lambda env: setattr(env, "P", FrozenLakeEnv(is_slippery=False).P),
    "a start in place": lambda env: env.initial_state_distrib.__setitem__(slice(2), [0.5, 0.5]),
    "a reward inside of an array": lambda env: env.P[14].update(
        {2: [(1.0, 15, np.float64(0.25), True)]}
    ),
}
HOUSE_CHANGES = {
    "a tile": set_tile,
    "the edge": lambda env: setattr(env.dynamics, "edge", Tile(-3, blocked=True)),
    "slipping": lambda env: setattr(env.dynamics, "outcome_prob", (0.8, 0.1, 0.1)),
    "a start": lambda env: env.initial_state_distrib.__setitem__([90, 91], [0.5, 0.5]),
    "the map's letters": lambda env: setattr(
        env.dynamics, "codes", env.dynamics.codes.replace(b"#", b".")
    ),
}
CHANGES = {
    **{("lake", name): (lake, change) for name, change in LAKE_CHANGES.items()},
    **{("house", name): (house, change) for name, change in HOUSE_CHANGES.items()},
}


@pytest.mark.parametrize("case", CHANGES, ids=" ".join)
def test_an_environment_changed_by_hand_is_worked_out_anew(case):
    make, change = CHANGES[case]
    changed, fresh = make(), make()
    before = compile_envs(changed)
    change(base(changed))
    after = compile_envs(changed)
    assert not equal(before, after)
    assert equal(compile_envs(fresh), before), "what the others stand for is as it was"
    forget()
    assert equal(compile_envs(changed), after), "as it is without anything kept"


def wrapped(make):
    return DummyVecEnv([lambda: Monitor(make(gym.make("FrozenLake-v1")))])


WRAPPER_CHANGES = {
    "scale": (
        lambda: wrapped(lambda env: ScaleReward(env, 2.0)),
        lambda vec: setattr(layer(vec, ScaleReward), "scale", 3.0),
    ),
    "last reward": (
        lambda: wrapped(lambda env: TerminationReward(env, -1.0)),
        lambda vec: setattr(layer(vec, TerminationReward), "last_reward", -2.0),
    ),
    "first": (
        lambda: wrapped(FlattenToDiscrete),
        lambda vec: setattr(layer(vec, FlattenToDiscrete), "_first", [1]),
    ),
    "time limit": (lake, lambda vec: setattr(layer(vec, TimeLimit), "_max_episode_steps", 7)),
}


@pytest.mark.parametrize("name", WRAPPER_CHANGES)
def test_so_is_one_whose_wrapper_was_changed(name):
    make, change = WRAPPER_CHANGES[name]
    vec_env = make()
    before = compile_envs(vec_env)
    change(vec_env)
    after = compile_envs(vec_env)
    assert not equal(before, after)
    forget()
    assert equal(compile_envs(vec_env), after)


def test_a_wrapper_in_between_counts():
    assert not equal(
        compile_envs(wrapped(lambda env: env)),
        compile_envs(wrapped(lambda env: ScaleReward(env, 2.0))),
    )


def test_bounds_of_rewards_count(built):
    worlds = [
        compile_envs(wrapped(lambda env, top=top: ClipReward(env, -1, top))) for top in (0.5, 1, 1)
    ]
    assert not equal(worlds[0], worlds[1])
    assert equal(worlds[1], worlds[2])
    assert len(built) == 2


def test_rewards_that_are_no_longer_clipped_are_not_overlooked():
    vec_env = wrapped(lambda env: ClipReward(env, -1, 0.5))
    compile_envs(vec_env)
    layer(vec_env, ClipReward).func = lambda reward: reward
    with pytest.raises(NotCompilable):
        compile_envs(vec_env)


def test_a_method_that_was_replaced_counts(monkeypatch, built):
    vec_env = house()
    compile_envs(vec_env)
    monkeypatch.setattr(WarehouseEnv, "observation_of", lambda self, states: states[::-1])
    assert compile_envs(vec_env).observation[0] == len(built[0].unwrapped.map.codes) - 1


def test_a_refusal_is_not_overlooked_by_what_was_kept():
    vec_env = house()
    compile_envs(vec_env)
    vec_env.envs[0] = gym.wrappers.RecordEpisodeStatistics(vec_env.envs[0])
    with pytest.raises(NotCompilable, match="must see every step"):
        compile_envs(vec_env)


def test_unlike_environments_are_refused_still(built):
    first, second = base(house()), base(house())
    set_tile(second)
    both = DummyVecEnv([lambda: first, lambda: second])
    for _ in range(2):
        with pytest.raises(NotCompilable, match="not alike"):
            compile_envs(both)


def test_playing_and_drawing_changes_nothing(built):
    vec_env = lake()
    compile_envs(vec_env)
    vec_env.reset()
    for _ in range(30):
        vec_env.step([vec_env.action_space.sample()])
    compile_envs(vec_env)
    assert len(built) == 1


def test_an_environment_of_ones_own_is_worked_out_each_time(built):
    class Own(FrozenLakeEnv):
        """Gymnasium's, by another name: its word is not enough."""

    vec_env = DummyVecEnv([lambda: TimeLimit(Own(), 50)])
    for _ in range(2):
        compile_envs(vec_env)
    assert len(built) == 2


def test_recipes_are_of_content_not_of_identity():
    first, second = house(), house()
    map_of = base(second).map
    base(second).map = replace(map_of, distances=map_of.distances.copy())
    assert compile_envs(first) is compile_envs(second)
