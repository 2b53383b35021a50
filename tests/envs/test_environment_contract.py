"""What holds for every registered environment and every wrapper, and wrappers worked by hand."""

import copy
import pickle
import re
import subprocess
import sys
from contextlib import nullcontext
from pathlib import Path

import gymnasium as gym
import numpy as np
import pytest
import stable_baselines3.common.env_checker as sb3_checker
from gymnasium import spaces
from gymnasium.envs.registration import EnvSpec
from gymnasium.utils import env_checker
from gymnasium.wrappers import TimeLimit

from rl_yardstick.envs import known_models as known
from rl_yardstick.envs import wrappers as wrap
from rl_yardstick.envs.mine_maze import MineMazeEnv
from rl_yardstick.mdp import TransitionModel
from rl_yardstick.pipeline.settings import read_yaml

LOG = {"log": str(Path(__file__).parent / "uniform_log.csv")}
WRONG = read_yaml(Path(__file__).with_name("wrong.yml"))
# An environment that is registered later is held to its contract as it is.
OURS = "rl_yardstick.envs."
SPECS = [spec for spec in gym.registry.values() if str(spec.entry_point).startswith(OURS)]
IDS = [(spec.id, LOG if spec.id == "ReplayBandit-v0" else {}) for spec in SPECS]
VARIANTS = [
    *IDS,
    ("Warehouse-v0", {"slip": 0.3, "random_start": True, "observation": "position"}),
    ("MineMaze-v0", {"slip": 0.2, "random_start": True, "power_reward": 0}),
    ("LinearBandit-v0", {"arm_parameters": [[1.0, 0.0], [0.0, 1.0]], "pulls": 30}),
    ("WindyGridworld-v0", {"moves": "king_and_stay", "stochastic": True}),
    ("DynaMaze-v0", {"maze": "shortcut", "changed": True, "change_after_steps": 50}),
    ("DeepSea-v0", {"deterministic": False}),
]


def named(variants):
    """A table of environments, each row named by its id and arguments."""
    names = [f"{name} {' '.join(kwargs)}".strip() for name, kwargs in variants]
    return pytest.mark.parametrize(("env_id", "kwargs"), variants, ids=names)


every_id, every_variant = named(IDS), named(VARIANTS)


def play(env, n_steps, seed):
    """What `reset` and `step` return while random actions are taken."""
    actions = np.random.default_rng(seed).integers(env.action_space.n, size=n_steps)
    history = []
    for action in actions.tolist():
        history.append(env.step(action))
        if history[-1][2] or history[-1][3]:
            history.append(env.reset())
    return tuple(history)


def assert_equal(one, other):
    assert env_checker.data_equivalence(one, other, exact=True)


def test_an_id_with_the_package_in_front_registers_it():
    made = ", ".join(f"make('envs:{name}', **{kwargs!r})" for name, kwargs in IDS)
    code = f"from gymnasium import make; print(*(env.unwrapped.spec.id for env in ({made},)))"
    command = [sys.executable, "-W", "error", "-c", code]
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    assert (done.stdout.split(), done.stderr) == ([env_id for env_id, _ in IDS], "")


@every_id
def test_the_checkers_of_gymnasium_and_stable_baselines3_find_nothing(env_id, kwargs):
    env_checker.check_env(gym.make(env_id, **kwargs).unwrapped, skip_render_check=True)
    env = gym.make(env_id, render_mode="rgb_array", **kwargs)
    sb3_checker.check_env(env, warn=True, skip_render_check=False)


@every_variant
def test_its_spec_a_seed_and_copies_in_mid_episode_give_the_same_episodes(env_id, kwargs):
    env = gym.make(env_id, render_mode="rgb_array", max_episode_steps=15, **kwargs)
    again = gym.make(EnvSpec.from_json(env.spec.to_json()))
    assert_equal(env.reset(seed=5), again.reset(seed=5))
    assert_equal(play(env, 37, seed=4), play(again, 37, seed=4))
    env.render()
    copies = [again, pickle.loads(pickle.dumps(env)), copy.deepcopy(env)]
    expected = play(env, 30, seed=3)
    infos = [returned[-1] for returned in expected]
    assert len({id(info) for info in infos}) == len(infos)
    kinds = {type(value) for info in infos for value in info.values()}
    assert kinds <= {bool, int, float, tuple}
    for other in copies:
        assert_equal(play(other, 30, seed=3), expected)
    np.testing.assert_array_equal(copies[1].render(), env.render())


@every_id
def test_it_renders_as_text_and_as_pictures_and_closes_twice(env_id, kwargs):
    for mode, result in (("ansi", str), ("rgb_array", np.ndarray), (None, type(None))):
        env = gym.make(env_id, render_mode=mode, **kwargs).unwrapped
        env.reset(seed=0)
        env.step(np.array(0))  # arrays without axes are actions too
        with nullcontext() if mode else pytest.warns(UserWarning, match="without render_mode"):
            assert isinstance(env.render(), result)
        env.close()
        env.close()
    with pytest.raises(ValueError, match="render_mode 'ansy': did you mean 'ansi'"):
        type(env)(render_mode="ansy", **kwargs)
    with pytest.raises(ValueError, match=r"(action|arm) -1 does not exist: they are"):
        env.step(-1)


@named([(f"{name}-v0", {}) for name in ("Warehouse", "MaximizationBias", "Tiger", "RandomWalk")])
def test_p_is_the_model_as_dictionaries(env_id, kwargs):
    env = gym.make(env_id, **kwargs).unwrapped
    arrays = env.transition_model()
    again = TransitionModel.from_gymnasium(env.P, env.initial_state_distrib)
    for name in ("prob", "next_state", "reward", "terminated", "initial"):
        np.testing.assert_array_equal(getattr(arrays, name), getattr(again, name))
    assert [type(value) for value in env.P[0][0][0]] == [float, int, float, bool]


@pytest.mark.parametrize(("name", "wrong", "line"), WRONG["arguments"], ids=str)
def test_arguments_out_of_range_are_refused(name, wrong, line):
    with pytest.raises(ValueError, match=re.escape(line)) as refused:
        gym.make(f"{name}-v0", **wrong)
    assert "\n" not in str(refused.value)


def showing(space, shown=None):
    """Two steps of reward 1 and 2, all of which look the same."""
    rewards = {"reward_schedule": (2, 0, 1), "is_slippery": False}
    env = gym.make("FrozenLake-v1", desc=["SFG"], **rewards)
    return gym.wrappers.TransformObservation(env, lambda _: shown, space)


def box(low, high, shown):
    space = spaces.Box(np.array(low, np.float32), np.array(high, np.float32))
    return showing(space, np.array(shown, np.float32))


def cart_pole(**kwargs):
    bounds = {"low": [-0.41887903, -50], "high": [0.41887903, 50]}
    settings = {"bins": 50, "dims": [2, 3], **bounds, **kwargs}
    return wrap.DiscretizeObservation(gym.make("CartPole-v1"), **settings)


def test_bins_worked_by_hand():
    """The last dimension counts fastest, and only the chosen ones count."""
    for value, index in ((-np.inf, 0), (-0.51, 0), (-0.5, 1), (-0.01, 1), (0, 2), (0.5, 3), (9, 3)):
        inner = box([-np.inf], [np.inf], [value])
        env = wrap.DiscretizeObservation(inner, bins=4, low=-1, high=1)
        observation = env.reset()[0]
        assert (observation, type(observation)) == (index, int)
        assert env.map_observations(np.array([[value], [0]])).tolist() == [index, 2]
    inner = box([0, -np.inf, 0, 0], [1, np.inf, 1, 1], [0.9, 7, 0.6, 0.1])
    env = wrap.DiscretizeObservation(inner, bins=[2, 4, 3], dims=[2, 0, 3])
    assert env.observation_space == spaces.Discrete(24)
    assert env.reset()[0] == (1 * 4 + 3) * 3 + 0


@pytest.mark.parametrize(
    ("space", "shown", "n", "index"),
    [
        (spaces.MultiDiscrete([2, 3], start=[5, -1]), np.array([6, 1]), 6, 1 * 3 + 2),
        (spaces.Tuple([spaces.Discrete(32), spaces.Discrete(11)]), (13, 10), 352, 153),
        (spaces.Discrete(5, start=-2), 2, 5, 4),
    ],
)
def test_flattening_worked_by_hand(space, shown, n, index):
    env = wrap.FlattenToDiscrete(showing(space, shown))
    assert env.observation_space == spaces.Discrete(n)
    observed = [env.reset()[0], env.step(0)[0]]
    assert (observed, type(observed[0])) == ([index, index], int)
    assert env.map_observations([shown, shown]).tolist() == [index, index]


def test_one_hot_worked_by_hand():
    env = wrap.OneHotObservation(showing(spaces.Discrete(4, start=2), 3))
    assert env.observation_space == spaces.Box(0, 1, (4,), np.float32)
    for found in (env.reset()[0], env.step(0)[0]):
        assert (found.tolist(), found.dtype) == ([0, 1, 0, 0], np.float32)
    batch = env.map_observations(np.array([5, 2]))
    assert (batch.tolist(), batch.dtype) == ([[0, 0, 0, 1], [1, 0, 0, 0]], np.float32)


@pytest.mark.parametrize(
    ("limit", "on_truncation", "rewards"),
    [(9, False, [0.25, -10]), (9, True, [0.25, -10]), (1, False, [0.25]), (1, True, [-10])],
)
def test_rewards_are_scaled_and_the_last_one_is_replaced(limit, on_truncation, rewards):
    inner = wrap.ScaleReward(TimeLimit(showing(spaces.Discrete(2), 0), limit), scale=0.25)
    env = wrap.TerminationReward(inner, reward=-10, on_truncation=on_truncation)
    env.reset()
    assert [env.step(2)[1] for _ in rewards] == rewards


MISTAKEN = [
    (lambda: cart_pole(low=None), "dimension 3 of the observation has the bounds -inf and 50.0: g"),
    (lambda: cart_pole(low=[1, -50]), "dimension 2 of .* has the bounds 1.0 and 0.418"),
    (lambda: cart_pole(bins=0), "bins must be whole numbers from 1 on, not 0"),
    (lambda: wrap.FlattenToDiscrete(gym.make("CartPole-v1")), "needs MultiDiscrete, a Tuple or"),
    (lambda: wrap.ScaleReward(gym.make("CartPole-v1"), 0), "scale must not be 0"),
    (lambda: wrap.ActionMasks(gym.make("CartPole-v1")), "^CartPole-v1 has no action masks"),
    (lambda: wrap.IdleActionMasks(gym.make("CartPole-v1")), "needs an environment that holds P"),
]


@pytest.mark.parametrize(("make", "message"), MISTAKEN)
def test_what_makes_no_sense_is_refused(make, message):
    with pytest.raises(ValueError, match=message):
        make()


WRAPPED = {
    "DiscretizeObservation": cart_pole,
    "FlattenToDiscrete": lambda: wrap.FlattenToDiscrete(gym.make("Blackjack-v1")),
    "OneHotObservation": lambda: wrap.OneHotObservation(gym.make("Warehouse-v0", slip=0.2)),
    "ScaleReward": lambda: wrap.ScaleReward(gym.make("Warehouse-v0"), 0.01),
    "TerminationReward": lambda: wrap.TerminationReward(gym.make("CartPole-v1"), -10),
    "ActionMasks": lambda: wrap.ActionMasks(gym.make("MineMaze-v0")),
    "IdleActionMasks": lambda: wrap.IdleActionMasks(gym.make("FrozenLake-v1")),
}


@pytest.mark.parametrize("name", WRAPPED)
def test_wrapped_environments_are_checked_remade_from_their_spec_and_pickled(name):
    env = WRAPPED[name]()
    sb3_checker.check_env(env, warn=True)
    for other in (gym.make(env.spec), pickle.loads(pickle.dumps(env))):
        assert str(other) == str(env)
        assert_equal(env.reset(seed=3), other.reset(seed=3))
        assert_equal(play(env, 50, seed=0), play(other, 50, seed=0))


def test_moves_that_bump_and_actions_that_are_idle_are_masked():
    env = gym.make("Warehouse-v0", desc=["S#", ".G"])
    # Of the start: up leaves the map, down is free, left leaves it, right is a shelf.
    expected = [[0, 1, 0, 0], [1, 1, 1, 1], [1, 0, 0, 1], [1, 1, 1, 1]]
    np.testing.assert_array_equal(known.action_masks_of_states(env), expected)
    for env in (MineMazeEnv(slip=0.3), wrap.IdleActionMasks(gym.make("CliffWalking-v1"))):
        model, masks = known.transition_model(env), known.action_masks_of_states(env)
        # The first outcome is the one that is meant.
        goes = model.next_state[:, :, 0] != np.arange(model.n_states)[:, None]
        np.testing.assert_array_equal(masks, goes | model.terminated[:, :, 0])
    # On ice any move may lead somewhere.
    assert wrap.IdleActionMasks(gym.make("FrozenLake-v1")).masks.all()


MASKED = {
    "MineMaze": lambda: wrap.ScaleReward(wrap.FlattenToDiscrete(gym.make("MineMaze-v0")), 0.1),
    "told Taxi": lambda: wrap.ActionMasks(gym.make("Taxi-v4")),
    "idle cliff": lambda: wrap.ActionMasks(wrap.IdleActionMasks(gym.make("CliffWalking-v1"))),
}


@pytest.mark.parametrize("name", MASKED)
def test_masks_of_all_states_are_those_told_on_the_way(name):
    bare = MASKED[name]()
    masks = known.action_masks_of_states(bare)
    assert masks.shape == (len(known.observations_of_states(bare)), bare.action_space.n)
    assert masks.any(axis=1).all()
    env, rng = wrap.ActionMasks(bare), np.random.default_rng(0)
    _, info = env.reset(seed=0)
    for _ in range(300):
        mask = masks[env.unwrapped.s]
        for told in (info["action_mask"], env.action_masks(), wrap.action_masks(bare)):
            np.testing.assert_array_equal(told, mask)
        _, _, terminated, truncated, info = env.step(rng.choice(np.flatnonzero(mask)))
        if terminated or truncated:
            _, info = env.reset()


class OwnMasks(MineMazeEnv):
    """Never up."""

    def action_masks(self):
        return np.array([False, True, True, True])


def test_masks_that_are_not_there_are_not_guessed():
    for env_id in ("CartPole-v1", "FrozenLake-v1", "BernoulliBandit-v0"):
        env = gym.make(env_id)
        assert wrap.action_masks(env) is known.action_masks_of_states(env) is None
    assert known.action_masks_of_states(OwnMasks()) is None
    assert wrap.action_masks(OwnMasks()).tolist() == [False, True, True, True]
    # A wrapper that nobody here knows may mask as well.
    assert known.action_masks_of_states(gym.Wrapper(MineMazeEnv())) is None
