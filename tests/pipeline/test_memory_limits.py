"""Settings that ask for more memory than there is end in one line."""

import gymnasium as gym
import numpy as np
import pytest
from rich.console import Console

from pipeline.environments import make_evaluation_env
from pipeline.errors import UserError
from pipeline.preparation import algorithm_kwargs
from pipeline.settings.hyperparams import split
from pipeline.train_spec import TrainSpec
from pipeline.training import train
from safe_files import files as limits
from safe_files.files import memory_bytes


def spec_of(algo, entry, env_id="CartPole-v1", **more):
    raw = {"n_timesteps": 10, **entry}
    return TrainSpec(algo, env_id, split(raw), saved_hyperparams=raw, seed=0, **more)


@pytest.mark.parametrize(
    ("algo", "entry", "said"),
    [
        ("ppo", {"n_envs": 10**9}, "n_envs 1,000,000,000 would take 18,626 GB of memory at least"),
        ("ppo", {"n_steps": 10**12}, "Unable to allocate"),
        ("dqn", {"buffer_size": 10**12}, "Unable to allocate"),
        ("ppo", {"policy_kwargs": "dict(net_arch=[1000000, 1000000])"}, "allocate memory"),
    ],
)
def test_numbers_beyond_all_memory_end_in_one_line_and_leave_nothing(tmp_path, algo, entry, said):
    spec = spec_of(algo, entry, log_folder=tmp_path)
    with pytest.raises(UserError, match=said):
        train(spec, Console(quiet=True), {}, "")
    assert not tmp_path.exists()


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


def test_where_the_system_does_not_tell(monkeypatch):
    assert memory_bytes() > 2**28

    def unknown(_):
        raise ValueError

    monkeypatch.setattr(limits.os, "sysconf", unknown)
    assert memory_bytes() == 16 * 2**30
