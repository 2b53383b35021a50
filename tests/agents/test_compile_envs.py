"""What is compiled stands for environments as they are now, whatever was changed by hand."""

import gymnasium as gym
import numpy as np
import pytest
from gymnasium.envs.toy_text.frozen_lake import FrozenLakeEnv
from gymnasium.wrappers import ClipReward, TimeLimit
from stable_baselines3.common.env_util import make_vec_env
from stable_baselines3.common.monitor import Monitor
from stable_baselines3.common.vec_env import DummyVecEnv

import envs  # noqa: F401  # registers the environments
from agents.compiled.worlds import NotCompilable, compile_envs
from envs.grid import Tile
from envs.warehouse import WarehouseEnv
from envs.wrappers import ScaleReward, TerminationReward


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
def test_a_change_by_hand_counts(case):
    make, change = CHANGES[case]
    changed, fresh = make(), make()
    before = compile_envs(changed)
    change(base(changed))
    after = compile_envs(changed)
    assert not equal(before, after)
    assert equal(compile_envs(fresh), before), "what the others stand for is as it was"


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
    "time limit": (lake, lambda vec: setattr(layer(vec, TimeLimit), "_max_episode_steps", 7)),
}


@pytest.mark.parametrize("name", WRAPPER_CHANGES)
def test_so_does_one_of_a_wrapper(name):
    make, change = WRAPPER_CHANGES[name]
    vec_env = make()
    before = compile_envs(vec_env)
    change(vec_env)
    after = compile_envs(vec_env)
    assert not equal(before, after)


def test_a_wrapper_in_between_counts():
    assert not equal(
        compile_envs(wrapped(lambda env: env)),
        compile_envs(wrapped(lambda env: ScaleReward(env, 2.0))),
    )


def test_bounds_of_rewards_count():
    worlds = [
        compile_envs(wrapped(lambda env, top=top: ClipReward(env, -1, top))) for top in (0.5, 1, 1)
    ]
    assert not equal(worlds[0], worlds[1])
    assert equal(worlds[1], worlds[2])


def test_rewards_that_are_no_longer_clipped_are_not_overlooked():
    vec_env = wrapped(lambda env: ClipReward(env, -1, 0.5))
    compile_envs(vec_env)
    layer(vec_env, ClipReward).func = lambda reward: reward
    with pytest.raises(NotCompilable):
        compile_envs(vec_env)


def test_a_method_that_was_replaced_counts(monkeypatch):
    vec_env = house()
    compile_envs(vec_env)
    monkeypatch.setattr(WarehouseEnv, "observation_of", lambda self, states: states[::-1])
    assert compile_envs(vec_env).observation[0] == len(base(vec_env).map.codes) - 1


def test_a_wrapper_that_was_added_counts():
    vec_env = house()
    compile_envs(vec_env)
    vec_env.envs[0] = gym.wrappers.RecordEpisodeStatistics(vec_env.envs[0])
    with pytest.raises(NotCompilable, match="must see every step"):
        compile_envs(vec_env)


def test_unlike_environments_are_refused():
    first, second = base(house()), base(house())
    set_tile(second)
    both = DummyVecEnv([lambda: first, lambda: second])
    with pytest.raises(NotCompilable, match="not alike"):
        compile_envs(both)


def test_playing_changes_nothing():
    vec_env = lake()
    before = compile_envs(vec_env)
    vec_env.reset()
    for _ in range(30):
        vec_env.step([vec_env.action_space.sample()])
    assert equal(compile_envs(vec_env), before)
