"""Wrappers and callbacks of settings write nowhere but in the run folder."""

import ast
import importlib
import inspect
import pkgutil
import warnings
from pathlib import Path

import gymnasium as gym
import pytest
from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.vec_env import VecEnvWrapper

from pipeline.errors import UserError
from pipeline.settings.components import (
    callbacks,
    confined,
    names_a_place,
    vec_wrapper_factory,
    wrapper_factory,
)
from pipeline.settings.values import constructor_parameters
from tests.peers.peer_environment import peer_folder

CALLBACKS = "stable_baselines3.common.callbacks"
CHECKPOINT = f"{CALLBACKS}.CheckpointCallback"
MONITOR = "stable_baselines3.common.monitor.Monitor"
RECORD = "gymnasium.wrappers.RecordVideo"

PACKAGES = (
    "stable_baselines3",
    "sb3_contrib",
    "gymnasium.wrappers",
    "envs.wrappers",
    "agents.common",
    "pipeline",
)

# Texts, and values of any kind, that say what is done and not where to write.
HARMLESS = {
    "action_mask_fn",
    "args",
    "channels_order",
    "callback",
    "dict_time_key",
    "dtype",
    "during",
    "env",
    "filter_keys",
    "func",
    "info_keywords",
    "key",
    "kwargs",
    "norm_obs_keys",
    "obs_key",
    "padding_type",
    "render_key",
    "reset_keywords",
    "stats_key",
    "verbose",
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


@pytest.fixture(scope="module")
def component_classes():
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        return {
            value
            for module in modules()
            for value in vars(module).values()
            if isinstance(value, type)
            and issubclass(value, gym.Wrapper | VecEnvWrapper | BaseCallback)
        }


def test_every_text_of_every_component_is_known(component_classes):
    """What takes a text, or does not say what it takes, is a place or known to be harmless."""
    assert len(component_classes) > 80
    places = set()
    for cls in component_classes:
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
    assert places == {
        "best_model_save_path",
        "filename",
        "folder",
        "log_path",
        "name_prefix",
        "save_path",
        "video_folder",
    }


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
    for make in (
        lambda: callbacks({CHECKPOINT: {"save_freq": 5, "save_path": place}}, (), tmp_path),
        lambda: callbacks(
            {CHECKPOINT: {"save_freq": 5, "name_prefix": place + "/x"}}, (), tmp_path
        ),
        lambda: callbacks({f"{CALLBACKS}.EvalCallback": {"eval_env": 0, "log_path": place}}),
        lambda: wrapper_factory({MONITOR: {"filename": place}}, folder=tmp_path),
        lambda: wrapper_factory({MONITOR: {"filename": place}}),
        lambda: wrapper_factory({RECORD: {"video_folder": place}}),
        lambda: vec_wrapper_factory(
            {"stable_baselines3.common.vec_env.VecMonitor": {"filename": place}}
        ),
    ):
        with pytest.raises(UserError, match=r"inside the run folder|holds no path") as caught:
            make()
        assert "\n" not in str(caught.value)


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
    assert confined(given, tmp_path, "") == {
        **given,
        "save_path": str(tmp_path / "kept/here"),
        "nested": {
            "log_dir": str(tmp_path / "logs"),
            "files": [str(tmp_path / "a"), str(tmp_path / "b")],
        },
    }
    with pytest.raises(UserError, match=r"^here: nested: log_dir must lie inside"):
        confined({"nested": {"log_dir": "/etc"}}, tmp_path, "here")


@pytest.mark.parametrize("prefix", ["../../escaped", "..", "a/b", "/a", "C:a", "a\\b"])
def test_a_prefix_holds_no_path(tmp_path, prefix):
    with pytest.raises(UserError, match=r"name_prefix begins the names of files"):
        confined({"name_prefix": prefix}, tmp_path, "")


def test_a_monitor_writes_into_the_run_folder_or_into_none(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "run").mkdir()
    wrap = wrapper_factory({MONITOR: {"filename": "mine"}}, folder=tmp_path / "run")
    wrap(gym.make("FrozenLake-v1")).close()
    assert [path.name for path in tmp_path.rglob("*.csv")] == ["mine.monitor.csv"]
    wrap = wrapper_factory({MONITOR: {"filename": "mine"}})
    env = wrap(gym.make("FrozenLake-v1"))
    assert Path(env.results_writer.file_handler.name).exists()
    env.close()
    assert [path.name for path in tmp_path.rglob("*.csv")] == ["mine.monitor.csv"]
