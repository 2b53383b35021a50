"""Names in files become objects only of the kinds and packages that are admitted."""

import math
import pickle
import subprocess
import sys
from pathlib import Path
from typing import Any

import gymnasium as gym
import pytest
import stable_baselines3 as sb3
import yaml
from gymnasium.wrappers import ClipReward, OrderEnforcing, TimeLimit, TransformReward
from sb3_contrib import QRDQN
from stable_baselines3.common.buffers import ReplayBuffer
from stable_baselines3.common.callbacks import (
    CheckpointCallback,
    LogEveryNTimesteps,
    StopTrainingOnMaxEpisodes,
)
from stable_baselines3.common.monitor import Monitor
from stable_baselines3.common.sb2_compat.rmsprop_tf_like import RMSpropTFLike
from stable_baselines3.common.utils import LinearSchedule
from stable_baselines3.common.vec_env import DummyVecEnv, VecFrameStack
from torch import nn, optim

from agents import load_algorithm
from agents.common.schedules import ExponentialSchedule
from envs.wrappers import FlattenToDiscrete, OneHotObservation, ScaleReward, TerminationReward
from pipeline.errors import UserError
from pipeline.settings.components import (
    build_algorithm_kwargs,
    build_value,
    callbacks,
    find_class,
    vec_wrapper_factory,
    wrapper_factory,
)
from pipeline.settings.hyperparams import component_specs, read_hyperparams, split
from pipeline.settings.values import DottedName, ScheduleSpec
from tests.peers.peer_environment import peer_folder, peer_python

TIME_LIMIT = "gymnasium.wrappers.TimeLimit"
CLIP = "gymnasium.wrappers.ClipReward"
MONITOR = "stable_baselines3.common.monitor.Monitor"
FRAME_STACK = "stable_baselines3.common.vec_env.VecFrameStack"
CALLBACKS = "stable_baselines3.common.callbacks"


def cartpole() -> gym.Env[Any, Any]:
    return gym.make("CartPole-v1").unwrapped


def wrapped(spec: Any) -> gym.Env[Any, Any]:
    wrap = wrapper_factory(spec)
    assert wrap is not None
    return wrap(cartpole())


# --- wrappers ------------------------------------------------------------------------------------


@pytest.mark.parametrize("spec", [None, [], ()])
def test_nothing_to_wrap(spec: Any) -> None:
    assert wrapper_factory(spec) is None
    assert vec_wrapper_factory(spec) is None
    assert callbacks(spec) == []


def test_a_wrapper_by_its_name_alone() -> None:
    env = wrapped(MONITOR)
    assert isinstance(env, Monitor)
    assert env.env is env.unwrapped


def test_a_list_wraps_from_the_inside_out() -> None:
    env = wrapped([{TIME_LIMIT: {"max_episode_steps": "1e2"}}, {CLIP: {"max_reward": 0}}, MONITOR])
    assert isinstance(env, Monitor)
    assert isinstance(env.env, ClipReward)
    limit = env.env.env
    assert isinstance(limit, TimeLimit)
    assert limit._max_episode_steps == 100
    assert limit.env is env.unwrapped


def test_the_order_is_that_of_rl_zoo3() -> None:
    # In a process of the Python that has it: importing rl_zoo3 patches Gymnasium.
    code = f"""
import gymnasium as gym
from rl_zoo3.utils import get_wrapper_class
spec = [{CLIP!r}, {{"gymnasium.wrappers.OrderEnforcing": {{}}}}]
spec[0] = {{spec[0]: {{"max_reward": 1.0}}}}
env = get_wrapper_class({{"env_wrapper": spec}})(gym.make("CartPole-v1").unwrapped)
print(type(env).__name__, type(env.env).__name__)
"""
    done = subprocess.run(
        [peer_python(), "-W", "ignore", "-c", code], capture_output=True, text=True, check=True
    )
    ours = wrapped([{CLIP: {"max_reward": 1.0}}, "gymnasium.wrappers.OrderEnforcing"])
    assert isinstance(ours, OrderEnforcing)
    assert done.stdout.split() == [type(ours).__name__, type(ours.env).__name__]


def test_arguments_may_be_left_empty_and_specs_read_before() -> None:
    assert isinstance(wrapped({MONITOR: None}), Monitor)
    assert isinstance(wrapped(component_specs(MONITOR, "here")), Monitor)


def test_a_wrapper_of_a_vectorised_environment() -> None:
    wrap = vec_wrapper_factory({FRAME_STACK: {"n_stack": 3}})
    assert wrap is not None
    env = wrap(DummyVecEnv([cartpole]))
    assert isinstance(env, VecFrameStack)
    assert env.observation_space.shape == (12,)


def test_what_wraps_can_be_pickled() -> None:
    wrap = pickle.loads(pickle.dumps(wrapper_factory({TIME_LIMIT: {"max_episode_steps": 7}})))
    assert wrap(cartpole())._max_episode_steps == 7


@pytest.mark.parametrize(
    ("spec", "complaint"),
    [
        ("os.system", "os.system is in none of the packages that may be named"),
        ("builtins.eval", "is in none of the packages"),
        ("torch.load", "torch.load is in none of the packages"),
        ("rl_zoo3.utils.get_class_by_name", "is in none of the packages"),
        ("minigrid.wrappers.FlatObsWrapper", "admit others with --gym-packages"),
        ("gymnasiumx.wrappers.TimeLimit", "is in none of the packages"),
        ("TimeLimit", "'TimeLimit' is not the dotted name of a class"),
        ("gymnasium.wrappers.", "is not the dotted name of a class"),
        ("gymnasium..TimeLimit", "is not the dotted name of a class"),
        ("gymnasium.wrappers.__loader__", "is not the dotted name of a class"),
        ("gymnasium.__class__.x", "is not the dotted name of a class"),
        ("a b", "is not the dotted name of a class"),
        ("", "is not the dotted name of a class"),
        ("gymnasium.wrappers.TimeLimt", "TimeLimt does not exist: did you mean 'TimeLimit'?"),
        ("gymnasium.wrapers.TimeLimit", "there is no module gymnasium.wrapers"),
        ("gymnasium.make", "gymnasium.make is no Wrapper"),
        ("gymnasium.Env", "gymnasium.Env is no Wrapper"),
        (FRAME_STACK, "VecFrameStack is no Wrapper"),
        (TIME_LIMIT, "argument 'max_episode_steps' is missing"),
        (
            {TIME_LIMIT: {"max_steps": 5}},
            "unknown argument 'max_steps': did you mean 'max_episode_steps'?",
        ),
        ({TIME_LIMIT: {"env": 5}}, "unknown argument 'env'"),
        ({"gymnasium.wrappers.TransformReward": {"func": "print"}}, "func is a function, which"),
        ({TIME_LIMIT: {"max_episode_steps": "few"}}, "must be a whole number, not 'few'"),
        ({TIME_LIMIT: [5]}, "must be the dotted name of a class, or that name with its arguments"),
        (5, "must be the dotted name of a class"),
    ],
)
def test_a_wrong_wrapper_is_told(spec: Any, complaint: str) -> None:
    with pytest.raises(UserError) as caught:
        wrapper_factory(spec)
    assert str(caught.value).startswith("env_wrapper")
    assert complaint in str(caught.value)


def test_a_gymnasium_wrapper_is_none_of_a_vectorised_environment() -> None:
    with pytest.raises(UserError, match=r"vec_env_wrapper: .* is no VecEnvWrapper"):
        vec_wrapper_factory(MONITOR)


def test_what_a_wrapper_itself_refuses_is_told() -> None:
    with pytest.raises(UserError, match=f"^env_wrapper: {CLIP}: .*[a-z]"):
        wrapped({CLIP: {"min_reward": 2.0, "max_reward": 1.0}})


def test_a_package_is_admitted_by_the_user(tmp_path: Path, monkeypatch: Any) -> None:
    (tmp_path / "my_envs.py").write_text(
        "import gymnasium\nclass Mine(gymnasium.Wrapper):\n    pass\n"
    )
    (tmp_path / "my_broken.py").write_text("from gymnasium import does_not_exist\n")
    monkeypatch.syspath_prepend(tmp_path)
    with pytest.raises(UserError, match="none of the packages"):
        wrapper_factory("my_envs.Mine")
    wrap = wrapper_factory("my_envs.Mine", ["my_envs"])
    assert wrap is not None
    assert type(wrap(cartpole())).__name__ == "Mine"
    with pytest.raises(UserError, match=r"my_broken\.Mine: cannot be imported: .*does_not_exist"):
        wrapper_factory("my_broken.Mine", ["my_broken"])


def test_an_entry_whose_wrapper_is_not_installed_is_readable() -> None:
    path = peer_folder("rl_zoo3") / "hyperparams" / "ppo.yml"
    found = [
        env_id
        for env_id, entry in yaml.safe_load(path.read_text()).items()
        if "minigrid" in str(entry.get("env_wrapper"))
    ]
    assert found
    for env_id in found:
        hyperparams = split(read_hyperparams("ppo", env_id, path))
        with pytest.raises(UserError, match="--gym-packages"):
            wrapper_factory(hyperparams.env_wrapper)
        with pytest.raises(UserError, match="no module minigrid, or it is not installed"):
            wrapper_factory(hyperparams.env_wrapper, ["minigrid"])


# --- callbacks -----------------------------------------------------------------------------------


def test_callbacks_and_where_they_save(tmp_path: Path) -> None:
    first, second, third, fourth = callbacks(
        [
            {f"{CALLBACKS}.StopTrainingOnMaxEpisodes": {"max_episodes": 5}},
            {f"{CALLBACKS}.CheckpointCallback": {"save_freq": "1e3"}},
            {f"{CALLBACKS}.CheckpointCallback": {"save_freq": 10, "save_path": "elsewhere"}},
            {f"{CALLBACKS}.LogEveryNTimesteps": {"n_steps": 10}},
        ],
        save_path=tmp_path,
    )
    assert isinstance(first, StopTrainingOnMaxEpisodes)
    assert isinstance(second, CheckpointCallback)
    assert (second.save_freq, second.save_path) == (1000, str(tmp_path))
    assert isinstance(third, CheckpointCallback)
    assert third.save_path == str(tmp_path / "elsewhere")
    assert isinstance(fourth, LogEveryNTimesteps)


@pytest.mark.parametrize(
    ("spec", "complaint"),
    [
        (f"{CALLBACKS}.CheckpointCallback", "argument 'save_freq' is missing"),
        ({f"{CALLBACKS}.CheckpointCallback": {"save_freq": 5}}, "'save_path' is missing"),
        (f"{CALLBACKS}.CheckpointCalback", "did you mean 'CheckpointCallback'?"),
        (f"{CALLBACKS}.BaseCallback", "callback: "),
        (MONITOR, "Monitor is no BaseCallback"),
        ({f"{CALLBACKS}.LogEveryNTimesteps": {"steps": 5}}, "did you mean 'n_steps'?"),
    ],
)
def test_a_wrong_callback_is_told(spec: Any, complaint: str) -> None:
    with pytest.raises(UserError) as caught:
        callbacks(spec)
    assert complaint in str(caught.value)


# --- values --------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("name", "cls"),
    [
        ("nn.Tanh", nn.Tanh),
        ("th.nn.ELU", nn.ELU),
        ("torch.nn.ReLU", nn.ReLU),
        ("torch.nn.modules.activation.ReLU", nn.ReLU),
        ("th.optim.Adam", optim.Adam),
        ("RMSpropTFLike", RMSpropTFLike),
        ("stable_baselines3.common.buffers.ReplayBuffer", ReplayBuffer),
        ("HerReplayBuffer", sb3.HerReplayBuffer),
    ],
)
def test_classes_that_values_may_name(name: str, cls: type) -> None:
    assert build_value({"a": [(DottedName(name), 1)]}) == {"a": [(cls, 1)]}


@pytest.mark.parametrize(
    ("name", "complaint"),
    [
        ("nn.Tahn", "nn.Tahn does not exist: did you mean 'Tanh'?"),
        ("nn.functional.relu", "nn.functional.relu is no Module or Optimizer or BaseBuffer"),
        ("nn.Parameter", "nn.Parameter is no Module"),
        ("nn.init", "nn.init is no Module"),
        ("th.load", "th.load is in none of the packages"),
        ("torch.hub.load", "is in none of the packages"),
        ("np.inf", "is in none of the packages"),
        ("os.system", "is in none of the packages"),
        ("gymnasium.Env", "gymnasium.Env is no Module"),
        ("print", "'print' is not the dotted name of a class"),
    ],
)
def test_what_values_may_not_name(name: str, complaint: str) -> None:
    with pytest.raises(UserError) as caught:
        build_value({"activation_fn": DottedName(name)}, where="ppo")
    assert str(caught.value).startswith("ppo: activation_fn: ")
    assert complaint in str(caught.value)


def test_schedules_become_objects() -> None:
    linear = build_value(ScheduleSpec("linear", 1.0, 0.5))
    assert isinstance(linear, LinearSchedule)
    assert [linear(1.0), linear(0.5), linear(0.0)] == [1.0, 0.75, 0.5]
    exponential = build_value(ScheduleSpec("exponential", 1.0, 0.01))
    assert isinstance(exponential, ExponentialSchedule)
    assert [exponential(x) for x in (1.0, 0.5, 0.0)] == pytest.approx([1.0, 0.1, 0.01])


def test_plain_values_stay() -> None:
    plain = {"a": [1, 2.5, (None, True)], "b": "nn.Tanh"}
    assert build_value(plain) == plain


# --- an agent's arguments ------------------------------------------------------------------------


def test_arguments_make_an_agent() -> None:
    kwargs = build_algorithm_kwargs(
        sb3.PPO,
        {
            "policy": "MlpPolicy",
            "learning_rate": "lin_1e-3",
            "n_steps": "64",
            "policy_kwargs": {
                "net_arch": {"pi": [8], "vf": [16.0]},
                "activation_fn": "nn.ELU",
                "optimizer_class": "th.optim.RMSprop",
                "optimizer_kwargs": {"eps": 1e-4},
            },
        },
        "ppo",
    )
    model = sb3.PPO(env="CartPole-v1", device="cpu", **kwargs)
    assert isinstance(model.policy.mlp_extractor.policy_net[1], nn.ELU)
    assert model.policy.mlp_extractor.value_net[0].out_features == 16
    assert isinstance(model.policy.optimizer, optim.RMSprop)
    assert math.isclose(model.lr_schedule(0.5), 5e-4)


def test_the_hand_written_agents_take_their_arguments() -> None:
    kwargs = build_algorithm_kwargs(
        load_algorithm("qlearning"),
        {"learning_rate": "exp_0.5_0.1", "tie_breaking": "first"},
        "qlearning",
    )
    assert isinstance(kwargs["learning_rate"], ExponentialSchedule)
    assert kwargs["tie_breaking"] == "first"


@pytest.mark.parametrize("algorithm", [sb3.PPO, sb3.DQN, sb3.A2C, QRDQN])
def test_every_rl_zoo3_entry_builds(algorithm: type[Any]) -> None:
    name = algorithm.__name__.lower()
    path = peer_folder("rl_zoo3") / "hyperparams" / f"{name}.yml"
    for env_id in yaml.safe_load(path.read_text()):
        entry = split(read_hyperparams(name, env_id, path))
        assert build_algorithm_kwargs(algorithm, entry.algorithm, env_id).keys() == (
            entry.algorithm.keys()
        )


@pytest.mark.parametrize(
    ("kwargs", "complaint"),
    [
        ({}, "policy is missing: MlpPolicy, CnnPolicy, MultiInputPolicy"),
        ({"policy": "MlpPolcy"}, "unknown policy 'MlpPolcy': did you mean 'MlpPolicy'?"),
        ({"policy": "torch.nn.Tanh"}, "policy: torch.nn.Tanh is no BasePolicy"),
        ({"net_arch": [1]}, "unknown hyperparameter 'net_arch'"),
        ({"policy_kwargs": {"net_arhc": [1]}}, "'net_arhc': did you mean 'net_arch'?"),
        ({"policy_kwargs": {"net_arch": ["a"]}}, "net_arch[0] must be a whole number, not 'a'"),
        ({"policy_kwargs": {"optimizer_class": "nn.Tanh"}}, "nn.Tanh is no Optimizer"),
        ({"policy_kwargs": {"activation_fn": "th.optim.Adam"}}, "th.optim.Adam is no Module"),
        ({"rollout_buffer_class": "HerReplayBuffer"}, "HerReplayBuffer is no RolloutBuffer"),
    ],
)
def test_a_wrong_agent_is_told(kwargs: dict[str, Any], complaint: str) -> None:
    if kwargs and "policy" not in kwargs:
        kwargs = {"policy": "MlpPolicy"} | kwargs
    with pytest.raises(UserError) as caught:
        build_algorithm_kwargs(sb3.PPO, kwargs, "ppo")
    assert str(caught.value).startswith("ppo: ")
    assert complaint in str(caught.value)


def test_reading_needs_no_heavy_library() -> None:
    code = (
        "import sys\n"
        "from pipeline.settings import components, hyperparams, values\n"
        "print({'torch', 'stable_baselines3', 'numba', 'rl_zoo3', 'gymnasium'} & {*sys.modules})"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout.strip() == "set()"


def test_wrapping_does_not_need_rl_zoo3() -> None:
    assert isinstance(wrapped({CLIP: {"max_reward": 1}}), TransformReward)
    assert "rl_zoo3" not in sys.modules


@pytest.mark.parametrize(
    ("before", "now"),
    [
        ("envs.wrappers.encodings.FlattenToDiscrete", FlattenToDiscrete),
        ("envs.wrappers.encodings.OneHotObservation", OneHotObservation),
        ("envs.wrappers.rewards.ScaleReward", ScaleReward),
        ("envs.wrappers.rewards.TerminationReward", TerminationReward),
    ],
)
def test_files_that_name_a_class_where_it_was_before_are_read(before, now):
    assert find_class(before, (gym.Wrapper,), "here") is now
