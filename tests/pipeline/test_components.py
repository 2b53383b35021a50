"""Names in files become objects only of admitted kinds, which write into the run folder alone."""

import ast
import importlib
import inspect
import math
import pickle
import pkgutil
import subprocess
import sys
import warnings
from pathlib import Path

import gymnasium as gym
import numpy as np
import pytest
import stable_baselines3 as sb3
import yaml
from gymnasium.spaces import Box
from gymnasium.wrappers import ClipReward, OrderEnforcing, TimeLimit
from stable_baselines3.common.callbacks import (
    BaseCallback,
    CheckpointCallback,
    LogEveryNTimesteps,
    StopTrainingOnMaxEpisodes,
)
from stable_baselines3.common.monitor import Monitor
from stable_baselines3.common.noise import NormalActionNoise, OrnsteinUhlenbeckActionNoise
from stable_baselines3.common.utils import LinearSchedule
from stable_baselines3.common.vec_env import DummyVecEnv, VecEnvWrapper, VecFrameStack
from torch import nn, optim

from agents import load_algorithm
from agents.common.schedules import ExponentialSchedule
from envs import wrappers
from pipeline.errors import UserError
from pipeline.settings.components import (
    action_noise,
    build_algorithm_kwargs,
    build_value,
    callbacks,
    check_action_noise,
    confined,
    find_class,
    names_a_place,
    vec_wrapper_factory,
    wrapper_factory,
)
from pipeline.settings.hyperparams import component_specs, read_hyperparams, split
from pipeline.settings.values import DottedName, ScheduleSpec, constructor_parameters
from tests.peers.peer_environment import peer_folder, peer_python

TIME_LIMIT = "gymnasium.wrappers.TimeLimit"
CLIP = "gymnasium.wrappers.ClipReward"
RECORD = "gymnasium.wrappers.RecordVideo"
MONITOR = "stable_baselines3.common.monitor.Monitor"
FRAME_STACK = "stable_baselines3.common.vec_env.VecFrameStack"
CALLBACKS = "stable_baselines3.common.callbacks"
CHECKPOINT = f"{CALLBACKS}.CheckpointCallback"


def cartpole():
    return gym.make("CartPole-v1").unwrapped


def wrapped(spec):
    return wrapper_factory(spec)(cartpole())


@pytest.mark.parametrize("spec", [None, [], ()])
def test_nothing_to_wrap(spec):
    assert wrapper_factory(spec) is None
    assert vec_wrapper_factory(spec) is None
    assert callbacks(spec) == []


def test_a_list_wraps_from_the_inside_out():
    env = wrapped([{TIME_LIMIT: {"max_episode_steps": "1e2"}}, {CLIP: {"max_reward": 0}}, MONITOR])
    layers = [env, env.env, env.env.env]
    assert [type(layer) for layer in layers] == [Monitor, ClipReward, TimeLimit]
    assert layers[2].env is env.unwrapped
    assert layers[2]._max_episode_steps == 100


def test_the_order_is_that_of_rl_zoo3():
    # In a process of the Python that has it: importing rl_zoo3 patches Gymnasium.
    code = f"""
import gymnasium as gym
from rl_zoo3.utils import get_wrapper_class
spec = [{{{CLIP!r}: {{"max_reward": 1.0}}}}, {{"gymnasium.wrappers.OrderEnforcing": {{}}}}]
env = get_wrapper_class({{"env_wrapper": spec}})(gym.make("CartPole-v1").unwrapped)
print(type(env).__name__, type(env.env).__name__)
"""
    done = subprocess.run(
        [peer_python(), "-W", "ignore", "-c", code], capture_output=True, text=True, check=True
    )
    ours = wrapped([{CLIP: {"max_reward": 1.0}}, "gymnasium.wrappers.OrderEnforcing"])
    assert isinstance(ours, OrderEnforcing)
    assert done.stdout.split() == [type(ours).__name__, type(ours.env).__name__]
    assert "rl_zoo3" not in sys.modules


def test_arguments_may_be_left_empty_specs_read_before_and_factories_pickled():
    assert isinstance(wrapped({MONITOR: None}), Monitor)
    assert isinstance(wrapped(component_specs(MONITOR, "here")), Monitor)
    wrap = pickle.loads(pickle.dumps(wrapper_factory({TIME_LIMIT: {"max_episode_steps": 7}})))
    assert isinstance(wrap(cartpole()), TimeLimit)


def test_a_wrapper_of_a_vectorised_environment():
    env = vec_wrapper_factory({FRAME_STACK: {"n_stack": 3}})(DummyVecEnv([cartpole]))
    assert isinstance(env, VecFrameStack)
    assert env.observation_space.shape == (12,)
    with pytest.raises(UserError, match=r"vec_env_wrapper: .* is no VecEnvWrapper"):
        vec_wrapper_factory(MONITOR)


def test_what_a_wrapper_itself_refuses_is_told():
    with pytest.raises(UserError, match=f"^env_wrapper: {CLIP}: .*[a-z]"):
        wrapped({CLIP: {"min_reward": 2.0, "max_reward": 1.0}})


def test_a_package_is_admitted_by_the_user(tmp_path, monkeypatch):
    source = "import gymnasium\nclass Mine(gymnasium.Wrapper):\n    pass\n"
    (tmp_path / "my_envs.py").write_text(source)
    (tmp_path / "my_broken.py").write_text("from gymnasium import does_not_exist\n")
    monkeypatch.syspath_prepend(tmp_path)
    with pytest.raises(UserError, match="none of the packages"):
        wrapper_factory("my_envs.Mine")
    env = wrapper_factory("my_envs.Mine", ["my_envs"])(cartpole())
    assert type(env).__name__ == "Mine"
    with pytest.raises(UserError, match=r"my_broken\.Mine: cannot be imported: .*does_not_exist"):
        wrapper_factory("my_broken.Mine", ["my_broken"])


def test_an_entry_whose_wrapper_is_not_installed_is_readable():
    path = peer_folder("rl_zoo3") / "hyperparams" / "ppo.yml"
    found = [
        env_id
        for env_id, entry in yaml.safe_load(path.read_text()).items()
        if "minigrid" in str(entry.get("env_wrapper"))
    ]
    hyperparams = split(read_hyperparams("ppo", found[0], path))
    with pytest.raises(UserError, match="--gym-packages"):
        wrapper_factory(hyperparams.env_wrapper)
    with pytest.raises(UserError, match="no module minigrid, or it is not installed"):
        wrapper_factory(hyperparams.env_wrapper, ["minigrid"])


def test_callbacks_and_where_they_save(tmp_path):
    first, second, third, fourth = callbacks(
        [
            {f"{CALLBACKS}.StopTrainingOnMaxEpisodes": {"max_episodes": 5}},
            {CHECKPOINT: {"save_freq": "1e3"}},
            {CHECKPOINT: {"save_freq": 10, "save_path": "elsewhere"}},
            {f"{CALLBACKS}.LogEveryNTimesteps": {"n_steps": 10}},
        ],
        save_path=tmp_path,
    )
    assert isinstance(first, StopTrainingOnMaxEpisodes)
    assert isinstance(second, CheckpointCallback)
    assert (second.save_freq, second.save_path) == (1000, str(tmp_path))
    assert third.save_path == str(tmp_path / "elsewhere")
    assert isinstance(fourth, LogEveryNTimesteps)


# --- values --------------------------------------------------------------------------------------


def test_schedules_become_objects_and_plain_values_stay():
    linear = build_value(ScheduleSpec("linear", 1.0, 0.5))
    assert isinstance(linear, LinearSchedule)
    assert [linear(1.0), linear(0.5), linear(0.0)] == [1.0, 0.75, 0.5]
    exponential = build_value(ScheduleSpec("exponential", 1.0, 0.01))
    assert isinstance(exponential, ExponentialSchedule)
    assert [exponential(x) for x in (1.0, 0.5, 0.0)] == pytest.approx([1.0, 0.1, 0.01])
    plain = {"a": [1, 2.5, (None, True)], "b": "nn.Tanh"}
    assert build_value(plain) == plain
    assert build_value({"a": [(DottedName("nn.Tanh"), 1)]}) == {"a": [(nn.Tanh, 1)]}


def test_arguments_make_an_agent():
    given = {
        "policy": "MlpPolicy",
        "learning_rate": "lin_1e-3",
        "n_steps": "64",
        "policy_kwargs": {
            "net_arch": {"pi": [8], "vf": [16.0]},
            "activation_fn": "nn.ELU",
            "optimizer_class": "th.optim.RMSprop",
            "optimizer_kwargs": {"eps": 1e-4},
        },
    }
    kwargs = build_algorithm_kwargs(sb3.PPO, given, "ppo")
    model = sb3.PPO(env="CartPole-v1", device="cpu", **kwargs)
    assert isinstance(model.policy.mlp_extractor.policy_net[1], nn.ELU)
    assert model.policy.mlp_extractor.value_net[0].out_features == 16
    assert isinstance(model.policy.optimizer, optim.RMSprop)
    assert math.isclose(model.lr_schedule(0.5), 5e-4)
    # Gaussian noise on the values of a table, which no key of the file format may swallow.
    entry = {"exploration": "gaussian_noise", "noise_std": 0.25, "learning_rate": "exp_0.5_0.1"}
    hyperparams = split(entry)
    assert hyperparams.noise_std is None
    kwargs = build_algorithm_kwargs(load_algorithm("qlearning"), hyperparams.algorithm, "here")
    assert isinstance(kwargs["learning_rate"], ExponentialSchedule)
    assert kwargs["noise_std"] == 0.25


@pytest.mark.parametrize(
    ("kind", "noise"),
    [("normal", NormalActionNoise), ("ornstein-uhlenbeck", OrnsteinUhlenbeckActionNoise)],
)
def test_action_noise_has_the_shape_of_an_action(kind, noise):
    hyperparams = split({"noise_type": kind, "noise_std": "0.5"})
    assert hyperparams.algorithm == {}
    built = action_noise(hyperparams, Box(-2, 2, (3,)))["action_noise"]
    assert repr(built) == repr(noise(np.zeros(3), np.full(3, 0.5)))
    assert built().shape == (3,)
    check_action_noise(hyperparams, sb3.TD3, "td3")
    check_action_noise(split({}), sb3.PPO, "ppo")
    with pytest.raises(UserError, match=r"^ppo: noise_type is for agents that add noise to"):
        check_action_noise(hyperparams, sb3.PPO, "ppo")


@pytest.mark.parametrize(
    "name", ["FlattenToDiscrete", "OneHotObservation", "ScaleReward", "TerminationReward"]
)
def test_files_that_name_a_class_where_it_was_before_are_read(name):
    before = "rewards" if name.endswith("Reward") else "encodings"
    found = find_class(f"envs.wrappers.{before}.{name}", (gym.Wrapper,), "here")
    assert found is getattr(wrappers, name)


def test_reading_needs_no_heavy_library():
    code = (
        "import sys\n"
        "from pipeline.settings import components, hyperparams, values\n"
        "print({'torch', 'stable_baselines3', 'numba', 'rl_zoo3', 'gymnasium'} & {*sys.modules})"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout.strip() == "set()"


# --- where components write ----------------------------------------------------------------------

PACKAGES = (
    *("stable_baselines3", "sb3_contrib", "gymnasium.wrappers", "envs.wrappers"),
    *("agents.common", "pipeline"),
)
# Texts, and values of any kind, that say what is done and not where to write.
HARMLESS = {
    *("action_mask_fn", "args", "channels_order", "callback", "dict_time_key", "dtype", "during"),
    *("env", "filter_keys", "func", "info_keywords", "key", "kwargs", "norm_obs_keys", "obs_key"),
    *("padding_type", "render_key", "reset_keywords", "stats_key", "verbose"),
}


def modules():
    for package in PACKAGES:
        module = importlib.import_module(package)
        yield module
        for info in pkgutil.walk_packages(getattr(module, "__path__", []), f"{package}."):
            try:
                yield importlib.import_module(info.name)
            except ImportError:  # of what is not installed
                continue


def test_every_text_of_every_component_is_known():
    """What takes a text, or does not say what it takes, is a place or known to be harmless."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        held = {
            value
            for module in modules()
            for value in vars(module).values()
            if isinstance(value, type)
        }
    classes = {c for c in held if issubclass(c, gym.Wrapper | VecEnvWrapper | BaseCallback)}
    assert len(classes) > 80
    places = set()
    for cls in classes:
        for name, parameter in constructor_parameters(cls).items():
            annotation = parameter.annotation
            says = "Any" if annotation is inspect.Parameter.empty else str(annotation)
            if names_a_place(name):
                places.add(name)
                # Nor does any write somewhere without being told where.
                assert "prefix" in name or parameter.default in (inspect.Parameter.empty, None)
            elif says.startswith("collections.abc.Callable"):
                continue  # no file can name a function
            elif any(word in says for word in ("str", "Path", "Any")):
                assert name in HARMLESS, (cls, name, says)
    assert sorted(places) == [
        *("best_model_save_path", "filename", "folder", "log_path", "name_prefix", "save_path"),
        "video_folder",
    ]


def test_every_text_of_the_components_of_rl_zoo3_is_known():
    folder = peer_folder("rl_zoo3")
    found = set()
    for file in ("wrappers.py", "callbacks.py"):
        for node in ast.walk(ast.parse((folder / file).read_text())):
            if isinstance(node, ast.FunctionDef) and node.name == "__init__":
                arguments = node.args.args[1:] + node.args.kwonlyargs
                found |= {a.arg for a in arguments if "str" in ast.unparse(a.annotation or a)}
    assert found == {"best_model_save_path", "log_path", "name_prefix", "save_path"}
    assert all(map(names_a_place, found))


OUTSIDE = ["/etc/x", "..", "../x", "a/../../x", "C:x", "C:/x", "\\x", "..\\x", "//server/x", "a\0b"]


@pytest.mark.parametrize("place", OUTSIDE)
def test_a_place_outside_is_refused_in_one_line(tmp_path, place):
    saved = {"save_freq": 5, "save_path": place}
    prefixed = {"save_freq": 5, "name_prefix": f"{place}/x"}
    for make in (
        lambda: callbacks({CHECKPOINT: saved}, (), tmp_path),
        lambda: callbacks({CHECKPOINT: prefixed}, (), tmp_path),
        lambda: callbacks({f"{CALLBACKS}.EvalCallback": {"eval_env": 0, "log_path": place}}),
        lambda: wrapper_factory({MONITOR: {"filename": place}}, folder=tmp_path),
        lambda: wrapper_factory({MONITOR: {"filename": place}}),
        lambda: wrapper_factory({RECORD: {"video_folder": place}}),
        lambda: vec_wrapper_factory(
            {"stable_baselines3.common.vec_env.VecMonitor": {"filename": place}}
        ),
        lambda: confined({"nested": {"log_dir": place}}, tmp_path, "here"),
    ):
        with pytest.raises(UserError, match=r"inside the run folder|holds no path") as caught:
            make()
        assert "\n" not in str(caught.value)


@pytest.mark.parametrize("prefix", ["../../escaped", "..", "a/b", "/a", "C:a", "a\\b"])
def test_a_prefix_holds_no_path(tmp_path, prefix):
    with pytest.raises(UserError, match=r"name_prefix begins the names of files"):
        confined({"name_prefix": prefix}, tmp_path, "")


def test_a_link_does_not_lead_out(tmp_path):
    folder = tmp_path / "run"
    folder.mkdir()
    (folder / "link").symlink_to(tmp_path)
    with pytest.raises(UserError, match=r"^here: save_path must lie inside the run folder"):
        confined({"save_path": "link/x"}, folder, "here")


def test_places_inside_are_resolved_there_and_nothing_else_is_touched(tmp_path):
    given = {
        "save_path": "kept/here",
        "name_prefix": "agent",
        "key": "../x",
        "n_steps": 5,
        "log_path": None,
        "nested": {"log_dir": "logs", "files": ["a", "b"]},
    }
    files = [str(tmp_path / "a"), str(tmp_path / "b")]
    assert confined(given, tmp_path, "") == {
        **given,
        "save_path": str(tmp_path / "kept/here"),
        "nested": {"log_dir": str(tmp_path / "logs"), "files": files},
    }


def test_a_monitor_writes_into_the_run_folder_or_into_none(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "run").mkdir()
    wrap = wrapper_factory({MONITOR: {"filename": "mine"}}, folder=tmp_path / "run")
    wrap(gym.make("FrozenLake-v1")).close()
    assert [path.name for path in tmp_path.rglob("*.csv")] == ["mine.monitor.csv"]
    env = wrapper_factory({MONITOR: {"filename": "mine"}})(gym.make("FrozenLake-v1"))
    assert Path(env.results_writer.file_handler.name).exists()
    env.close()
    assert [path.name for path in tmp_path.rglob("*.csv")] == ["mine.monitor.csv"]
