"""What environments say may be done: in one state, in all of them, and through wrappers."""

import gymnasium as gym
import numpy as np
import pytest

import envs  # noqa: F401  # registers the environments
from envs.known_models import action_masks_of_states, observations_of_states, transition_model
from envs.mine_maze import MineMazeEnv
from envs.warehouse import WarehouseEnv
from envs.wrappers import ActionMasks, FlattenToDiscrete, IdleActionMasks, ScaleReward, action_masks

ENVS = {
    "Warehouse": lambda: gym.make("Warehouse-v0"),
    "slippery Warehouse": lambda: gym.make("Warehouse-v0", slip=0.5),
    "RandomWarehouse": lambda: gym.make("RandomWarehouse-v0", size=15, map_seed=3),
    "MineMaze": lambda: gym.make("MineMaze-v0"),
    "wrapped MineMaze": lambda: ScaleReward(FlattenToDiscrete(gym.make("MineMaze-v0")), 0.1),
    "Taxi": lambda: gym.make("Taxi-v4"),
    "told Taxi": lambda: ActionMasks(gym.make("Taxi-v4")),
    "idle lake": lambda: IdleActionMasks(gym.make("FrozenLake-v1", is_slippery=False)),
    "idle cliff": lambda: ActionMasks(IdleActionMasks(gym.make("CliffWalking-v1"))),
}


@pytest.mark.parametrize("name", ENVS)
def test_a_state_is_told_as_all_states_are(name):
    env = ENVS[name]()
    env.reset(seed=0)
    masks = action_masks_of_states(env)
    assert masks.shape == (len(observations_of_states(env)), env.action_space.n)
    assert masks.dtype == np.bool_
    assert masks.any(axis=1).all()
    for state, mask in enumerate(masks):
        env.unwrapped.s = state
        np.testing.assert_array_equal(action_masks(env), mask)


def test_moves_into_shelves_and_out_of_the_map_are_masked():
    env = gym.make("Warehouse-v0", desc=["S#", ".G"])
    env.reset()
    # Up leaves the map, down is free, left leaves it, right is a shelf.
    assert env.unwrapped.action_masks().tolist() == [False, True, False, False]
    np.testing.assert_array_equal(
        action_masks_of_states(env),
        [[0, 1, 0, 0], [1, 1, 1, 1], [1, 0, 0, 1], [1, 1, 1, 1]],
    )


def test_a_walled_in_cell_allows_all():
    env = WarehouseEnv(desc=["S.G", "###", "#.#", "###"])
    assert env.dynamics.action_masks()[7].all()
    env.s = 7
    assert env.action_masks().all()


@pytest.mark.parametrize("slip", [0, 0.3])
def test_a_masked_move_is_one_that_is_meant_to_bump(slip):
    env = MineMazeEnv(slip=slip)
    model, masks = env.transition_model(), action_masks_of_states(env)
    ends = model.terminated.all(axis=(1, 2))
    # The first outcome is the one that is meant.
    stays = model.next_state[:, :, 0] == np.arange(model.n_states)[:, None]
    np.testing.assert_array_equal(masks, ~stays | ends[:, None])


def test_idle_actions_change_nothing():
    env = IdleActionMasks(gym.make("FrozenLake-v1", is_slippery=False))
    model = transition_model(env)
    goes = model.next_state[:, :, 0] != np.arange(16)[:, None]
    goes |= model.terminated[:, :, 0]
    np.testing.assert_array_equal(action_masks_of_states(env), goes)
    # On ice any move may lead somewhere.
    assert IdleActionMasks(gym.make("FrozenLake-v1")).masks.all()


@pytest.mark.parametrize("name", ["Warehouse", "Taxi", "idle lake"])
def test_the_wrapper_tells_both_ways(name):
    env = ActionMasks(ENVS[name]())
    rng = np.random.default_rng(0)
    _, info = env.reset(seed=0)
    for _ in range(300):
        mask = action_masks_of_states(env)[env.unwrapped.s]
        np.testing.assert_array_equal(info["action_mask"], mask)
        np.testing.assert_array_equal(env.action_masks(), mask)
        _, _, terminated, truncated, info = env.step(rng.choice(np.flatnonzero(mask)))
        if terminated or truncated:
            _, info = env.reset()


class ToldByInfo(gym.Wrapper):
    """Says it in info alone."""

    def reset(self, **kwargs):
        obs, info = self.env.reset(**kwargs)
        return obs, {**info, "action_mask": np.array([0, 1], np.int8)}

    def step(self, action):
        *rest, info = self.env.step(action)
        return *rest, {**info, "action_mask": np.array([1, 0], np.int8)}


def test_info_alone_is_enough_for_the_wrapper():
    env = ActionMasks(ToldByInfo(gym.make("CartPole-v1")))
    env.reset(seed=0)
    assert env.action_masks().tolist() == [False, True]
    env.step(1)
    assert env.action_masks().tolist() == [True, False]


def test_environments_without_masks():
    for env in (gym.make("CartPole-v1"), gym.make("FrozenLake-v1"), gym.make("BernoulliBandit-v0")):
        assert action_masks(env) is None
        assert action_masks_of_states(env) is None
    with pytest.raises(ValueError, match=r"^CartPole-v1 has no action masks: neither a method"):
        ActionMasks(gym.make("CartPole-v1"))
    with pytest.raises(ValueError, match="needs an environment that holds P"):
        IdleActionMasks(gym.make("CartPole-v1"))


class OwnMasks(MineMazeEnv):
    """Never up."""

    def action_masks(self):
        return np.array([False, True, True, True])


def test_masks_of_ones_own_are_not_guessed():
    assert action_masks_of_states(OwnMasks()) is None
    assert action_masks(OwnMasks()).tolist() == [False, True, True, True]
    # A wrapper that nobody here knows may mask as well.
    assert action_masks_of_states(gym.Wrapper(MineMazeEnv())) is None
