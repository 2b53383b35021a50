"""Settings that ask for more memory than there is are refused before any is taken."""

import inspect

import gymnasium as gym
import numpy as np
import pytest
from gymnasium import spaces

from pipeline import memory_limits
from pipeline.environments import make_evaluation_env
from pipeline.errors import UserError
from pipeline.memory_limits import check_agent, check_pulls, observation_bytes
from pipeline.preparation import algorithm_kwargs
from pipeline.settings.hyperparams import Hyperparams, split
from pipeline.train_spec import TrainSpec
from safe_files import files as limits
from safe_files.files import memory_bytes

GIGABYTE = 2**30
FOUR_FLOATS = spaces.Box(-1, 1, (4,), np.float32)  # 16 bytes


@pytest.fixture(autouse=True)
def one_gigabyte(monkeypatch):
    monkeypatch.setattr(memory_limits, "memory_bytes", lambda: GIGABYTE)


def spec_of(algo, entry, env_id="CartPole-v1"):
    raw = {"n_timesteps": 10, **entry}
    return TrainSpec(algo, env_id, split(raw), saved_hyperparams=raw, seed=0)


@pytest.mark.parametrize(
    ("space", "n_bytes"),
    [
        (FOUR_FLOATS, 16),
        (spaces.Box(0, 255, (84, 84, 4), np.uint8), 28224),
        (spaces.Discrete(10**6), 8),
        (spaces.Dict({"a": FOUR_FLOATS, "b": spaces.Discrete(2)}), 24),
        (spaces.Tuple([FOUR_FLOATS, FOUR_FLOATS]), 32),
        (spaces.Text(5), 0),
    ],
)
def test_bytes_of_an_observation(space, n_bytes):
    assert observation_bytes(space) == n_bytes


@pytest.mark.parametrize(
    ("special", "arguments", "complaint"),
    [
        ({"n_envs": 54_000}, {}, "n_envs 54,000 would take 1 GB"),
        # Two observations of 16 bytes and what else belongs to a transition.
        ({}, {"buffer_size": 10**9}, "buffer_size 1,000,000,000 would take 45 GB of memory"),
        ({}, {"buffer_size": GIGABYTE // 48 + 1}, "buffer_size"),
        ({"frame_stack": 100}, {"buffer_size": 10**6}, "buffer_size"),
        ({"n_envs": 8}, {"n_steps": 10**7}, "n_steps 10,000,000 with n_envs 8 would take 2 GB"),
        ({"n_envs": 100, "frame_stack": 10**6}, {}, "frame_stack 1,000,000 with n_envs 100"),
        ({}, {"buffer_size": 9, "batch_size": 10**9}, "batch_size"),
        ({}, {"n_delta": 10**9}, "n_delta"),
        ({"n_envs": 8}, {"longest_episode": 10**7}, "longest_episode 10,000,000 with n_envs 8"),
        ({}, {"policy_kwargs": {"net_arch": [10**4, 10**4]}}, "network of policy_kwargs"),
        ({}, {"policy_kwargs": {"net_arch": {"pi": [64], "vf": [10**9]}}}, "network"),
        ({}, {"policy_kwargs": {"lstm_hidden_size": 10**4}}, "network"),
        ({}, {"policy_kwargs": {"n_critics": 10**9}}, "network"),
        ({}, {"policy_kwargs": {"n_quantiles": 10**5}}, "network"),
    ],
)
def test_what_does_not_fit_is_named_with_its_number(special, arguments, complaint):
    with pytest.raises(UserError, match=f"^here: .*{complaint}.*this machine has 1 GB$"):
        check_agent(Hyperparams(**special), arguments, FOUR_FLOATS, "here")


@pytest.mark.parametrize(
    ("special", "arguments"),
    [
        ({"n_envs": 1000}, {"n_steps": 2048}),
        ({}, {"buffer_size": GIGABYTE // 48}),
        ({}, {"buffer_size": GIGABYTE // 24, "optimize_memory_usage": True}),
        # PPO takes no more than its rollout.
        ({}, {"batch_size": 10**12}),
        ({"n_envs": 8, "frame_stack": 4}, {"policy_kwargs": {"net_arch": [400, 300]}}),
        ({}, {"policy_kwargs": inspect.Parameter.empty, "n_steps": inspect.Parameter.empty}),
        ({}, {"policy_kwargs": None, "buffer_size": None, "n_steps": True}),
    ],
)
def test_what_fits_passes(special, arguments):
    check_agent(Hyperparams(**special), arguments, FOUR_FLOATS, "here")


def test_defaults_of_the_agent_count_too():
    """A buffer of a million pictures, which is what DQN takes where nothing else is said."""
    with pytest.raises(UserError, match="buffer_size 1,000,000 would take 2 GB"):
        algorithm_kwargs(spec_of("dqn", {"frame_stack": 64, "policy": "MlpPolicy"}))


@pytest.mark.parametrize(
    "entry",
    [
        {"n_envs": 10**9},
        {"n_steps": 10**12},
        {"frame_stack": 10**9},
        {"policy_kwargs": "dict(net_arch=[1000000, 1000000])"},
    ],
)
def test_a_specification_is_refused_before_anything_is_made(entry):
    (name,) = entry
    with pytest.raises(UserError, match=f"^ppo: .*{name}.* GB"):
        algorithm_kwargs(spec_of("ppo", entry))


def test_stacks_of_an_agent_that_is_played_are_bounded_too():
    with pytest.raises(UserError, match="frame_stack 1,000,000,000 with n_envs 1"):
        make_evaluation_env(spec_of("ppo", {"frame_stack": 10**9}), 1)
    with pytest.raises(UserError, match="n_envs 1,000,000,000"):
        make_evaluation_env(spec_of("ppo", {}), 10**9)


@pytest.mark.parametrize(
    ("key", "wrapper", "argument"),
    [
        ("env_wrapper", "gymnasium.wrappers.FrameStackObservation", "stack_size"),
        ("vec_env_wrapper", "stable_baselines3.common.vec_env.VecFrameStack", "n_stack"),
    ],
)
def test_stacks_of_wrappers_are_bounded(key, wrapper, argument):
    spec = spec_of("ppo", {key: {wrapper: {argument: 10**9}}})
    with pytest.raises(UserError, match=f"{argument} must be at most 10,000"):
        make_evaluation_env(spec, 1)


def test_an_environment_that_asks_for_too_much_is_told_in_one_line():
    class Greedy(gym.Env):
        def __init__(self):
            np.empty(2**50)

    gym.register("Greedy-v0", Greedy)
    try:
        with pytest.raises(UserError, match=r"Greedy-v0: .*allocate"):
            algorithm_kwargs(spec_of("ppo", {}, "Greedy-v0"))
    finally:
        del gym.registry["Greedy-v0"]


def test_pulls_of_a_batch():
    check_pulls(1000, 10_000, "here")
    with pytest.raises(UserError, match=r"^here: 1,000,000 seeds with n_timesteps 10,000 "):
        check_pulls(10**6, 10**4, "here")


def test_where_the_system_does_not_tell(monkeypatch):
    assert memory_bytes() > 2**28

    def unknown(_):
        raise ValueError

    monkeypatch.setattr(limits.os, "sysconf", unknown)
    assert memory_bytes() == 16 * GIGABYTE
