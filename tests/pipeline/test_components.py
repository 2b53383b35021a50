"""Names become objects of admitted kinds alone: those in files, and modules that the user typed."""

import dataclasses
import math
import os
import sys

import gymnasium as gym
import numpy as np
import pytest
import stable_baselines3 as sb3
from stable_baselines3.common.callbacks import (
    StopTrainingOnMaxEpisodes,
)
from stable_baselines3.common.vec_env import DummyVecEnv, VecFrameStack
from torch import nn, optim

from rl_yardstick.agents import load_algorithm
from rl_yardstick.pipeline.environments import check_env_id, make_env, make_training_env
from rl_yardstick.pipeline.errors import UserError
from rl_yardstick.pipeline.settings.components import (
    build_algorithm_kwargs,
    callbacks,
    confined,
    vec_wrapper_factory,
    wrapper_factory,
)
from rl_yardstick.pipeline.settings.hyperparams import split
from rl_yardstick.pipeline.user_modules import (
    UserModule,
    as_flag,
    check_recorded,
    import_again,
    import_typed,
    keep_copies,
)
from tests.pipeline.short_runs import spec_of

MONITOR = "stable_baselines3.common.monitor.Monitor"
FRAME_STACK = "stable_baselines3.common.vec_env.VecFrameStack"
CALLBACKS = "stable_baselines3.common.callbacks"
CHECKPOINT = f"{CALLBACKS}.CheckpointCallback"


def cartpole():
    return gym.make("CartPole-v1").unwrapped


def test_a_wrapper_of_a_vectorised_environment():
    env = vec_wrapper_factory({FRAME_STACK: {"n_stack": 3}})(DummyVecEnv([cartpole]))
    assert isinstance(env, VecFrameStack)
    assert env.observation_space.shape == (12,)
    with pytest.raises(UserError, match=r"vec_env_wrapper: .* is no VecEnvWrapper"):
        vec_wrapper_factory(MONITOR)


def test_callbacks_and_where_they_save(tmp_path):
    first, second, third = callbacks(
        [
            {f"{CALLBACKS}.StopTrainingOnMaxEpisodes": {"max_episodes": 5}},
            {CHECKPOINT: {"save_freq": "1e3"}},
            {CHECKPOINT: {"save_freq": 10, "save_path": "elsewhere"}},
        ],
        save_path=tmp_path,
    )
    assert isinstance(first, StopTrainingOnMaxEpisodes)
    assert (second.save_freq, second.save_path) == (1000, str(tmp_path))
    assert third.save_path == str(tmp_path / "elsewhere")


# --- values --------------------------------------------------------------------------------------


def test_arguments_make_an_agent():
    given = {
        "policy": "MlpPolicy",
        "learning_rate": "lin_1e-3",
        "n_steps": "64",
        "policy_kwargs": {
            "net_arch": {"pi": [8], "vf": [16.0]},
            "activation_fn": "nn.ELU",
            "optimizer_class": "th.optim.Adam",
            "optimizer_kwargs": {"fused": True},  # a setting of the library's
        },
    }
    kwargs = build_algorithm_kwargs(sb3.PPO, given, "ppo")
    model = sb3.PPO(env="CartPole-v1", device="cpu", **kwargs)
    assert isinstance(model.policy.mlp_extractor.policy_net[1], nn.ELU)
    assert model.policy.mlp_extractor.value_net[0].out_features == 16
    assert isinstance(model.policy.optimizer, optim.Adam)
    assert model.policy.optimizer.defaults["fused"] is True
    assert math.isclose(model.lr_schedule(0.5), 5e-4)
    # Gaussian noise on the values of a table, which no key of the file format may swallow.
    hyperparams = split({"exploration": "gaussian_noise", "noise_std": 0.25})
    assert hyperparams.noise_std is None
    kwargs = build_algorithm_kwargs(load_algorithm("qlearning"), hyperparams.algorithm, "here")
    assert kwargs["noise_std"] == 0.25


# --- where components write ----------------------------------------------------------------------

OUTSIDE = ["/etc/x", "..", "a/../../x", "C:/x", "..\\x"]
PLACES = {
    "callback": lambda place, run: callbacks({CHECKPOINT: {"save_path": place}}, (), run),
    "prefix": lambda place, run: callbacks({CHECKPOINT: {"name_prefix": f"{place}/x"}}, (), run),
    "wrapper": lambda place, run: wrapper_factory({MONITOR: {"filename": place}}, folder=run),
    "vectorised": lambda place, _: vec_wrapper_factory(
        {"stable_baselines3.common.vec_env.VecMonitor": {"filename": place}}
    ),
}


@pytest.mark.parametrize("make", PLACES.values(), ids=PLACES)
def test_a_place_outside_is_refused_in_one_line(tmp_path, make):
    for place in OUTSIDE:
        with pytest.raises(UserError, match=r"inside the run folder|holds no path") as caught:
            make(place, tmp_path)
        assert "\n" not in str(caught.value)


def test_a_prefix_and_a_link_lead_nowhere(tmp_path):
    for prefix in ("..", "a/b"):
        with pytest.raises(UserError, match=r"name_prefix begins the names of files"):
            confined({"name_prefix": prefix}, tmp_path, "")
    (tmp_path / "run").mkdir()
    (tmp_path / "run" / "link").symlink_to(tmp_path)
    with pytest.raises(UserError, match=r"^here: save_path must lie inside the run folder"):
        confined({"save_path": "link/x"}, tmp_path / "run", "here")


# --- modules of the user's ------------------------------------------------------------------------


@pytest.fixture
def write(own_folder):
    """Write files into the user's folder."""

    def put(**files):
        for name, text in files.items():
            path = own_folder / f"{name.replace('__in__', '/')}.py"
            path.parent.mkdir(exist_ok=True)
            path.write_text(text)
        return own_folder

    return put


def complaint_of(call, *args):
    with pytest.raises(UserError) as caught:
        call(*args)
    assert "\n" not in str(caught.value)
    return str(caught.value)


def test_a_module_is_found_by_its_name_and_by_its_path(write, own_folder, monkeypatch, tmp_path):
    write(my_first="x = 1", my_package__in____init__="from my_package.part import x")
    write(my_package__in__part="x = 2", my_space__in__part="x = 3", my_other="import my_first")
    words = ["my_first", "./my_other.py", "my_package/", "my_package/part.py", "my_space.part"]
    names = ["my_first", "my_other", "my_package", "my_package.part", "my_space.part"]
    ours = "rl_yardstick.envs"
    assert import_typed([ours], [f"{ours}:Warehouse-v0", "CartPole-v1"]) == ()
    modules = import_typed(words)
    assert [(module.typed, module.name) for module in modules] == [*zip(words, names, strict=True)]
    assert {module.search_folder for module in modules} == {str(own_folder)}
    assert sys.modules["my_package"].x == 2
    assert str(own_folder) not in sys.path
    # From elsewhere, by its path from the home folder; and by another process.
    monkeypatch.setenv("HOME", str(tmp_path))
    monkeypatch.chdir(tmp_path)
    typed = f"~/{own_folder.name}/my_first.py"
    (module,) = import_typed([typed])
    assert module == UserModule(typed, "my_first", f"{own_folder}/my_first.py")
    del sys.modules["my_first"]
    sys.meta_path.pop()
    import_again(modules)
    assert sys.modules["my_first"].__file__ == str(own_folder / "my_first.py")


# --- names that are taken, modules that fail -----------------------------------------------------


@pytest.mark.parametrize(
    ("words", "complaint"),
    [
        (["json"], "json is the name of one of Python's own modules: rename"),
        (["rl_yardstick"], "rl_yardstick is the name of one of Yardstick's own modules: rename"),
        (["my_first", "agents/../below/my_first.py"], "Python finds another my_first first, at "),
        (["no_such"], "cannot import no_such: it is neither in "),
        (["./no_such.py"], "there is no such file or folder"),
        (["./notes.txt"], "it is no Python file"),
        (["./my-agents.py"], "'my-agents' is no name of a module: rename it"),
    ],
)
def test_what_cannot_be_imported(write, own_folder, words, complaint):
    poison = "raise SystemExit('it was imported')"
    write(agents__in____init__=poison, json=poison, rl_yardstick=poison)
    write(my_first="x = 1", below__in__my_first=poison)
    (own_folder / "notes.txt").touch()
    (own_folder / "my-agents.py").touch()
    assert complaint in complaint_of(import_typed, words)


@pytest.mark.parametrize(
    ("text", "complaint"),
    [
        ("x = 1\ndef f(:", "my_first.py:2: SyntaxError: "),
        ("x = 1\n\nimport no_such_library", "my_first.py:3: ModuleNotFoundError: No module named"),
        ("import sys\nsys.exit(3)", "my_first.py:2: SystemExit: 3"),
    ],
)
def test_a_module_that_fails_is_told_with_its_line(write, text, complaint):
    folder = write(my_first=text)
    told = complaint_of(import_typed, ["my_first"])
    assert told.startswith(f"--gym-packages my_first: {folder}{os.sep}{complaint}")


# --- only what was typed -------------------------------------------------------------------------


REGISTERED = "gymnasium.register('my/Lake-v0', 'gymnasium.envs.toy_text:FrozenLakeEnv')"


def test_an_id_imports_what_was_typed_alone(write):
    write(my_first="raise SystemExit('imported')", my_second=f"import gymnasium\n{REGISTERED}")
    said = complaint_of(check_env_id, "my_first:FrozenLake-v1")
    assert said.endswith("is not imported because a file asks: add --gym-packages my_first")
    make_env("my_first:FrozenLake-v1", {}).close()
    assert "my_first" not in sys.modules
    (module,) = import_typed([], ["my_second:my/Lake-v0"])
    check_env_id("my_second:my/Lake-v0")
    assert as_flag([module], "my_second:my/Lake-v0") == ""
    assert as_flag([module], "my/Lake-v0") == " --gym-packages my_second"
    assert as_flag([UserModule("./my file.py", "my", None)]) == " --gym-packages './my file.py'"


def test_a_run_keeps_copies_and_quotes_what_it_asks_for(write, tmp_path):
    """Of what was typed, of what that imports, and of what it names in a text; what is asked for
    where a module is gone, of packs and of studies, is in ``tests/commands``.
    """
    write(my_first="import my_beside", my_package__in____init__="", my_beside="import json")
    write(json="x = 1", my_other="x = 1", my_package__in__part="'my_named:Class'", my_named="")
    keep_copies(import_typed(["my_first", "my_package"]), tmp_path)
    copies = [path.relative_to(tmp_path).as_posix() for path in tmp_path.glob("modules/**/*.py")]
    package = ["modules/my_package/__init__.py", "modules/my_package/part.py"]
    alone = [f"modules/my_{name}.py" for name in ("beside", "first", "named")]
    assert sorted(copies) == [*alone, *package]
    recorded = {"gym_packages": ["../x", "a\x1b[2Jb", 3], "user_modules": ["x", {"name": "../x"}]}
    told = complaint_of(check_recorded, recorded, tmp_path)
    assert told.endswith(r"add --gym-packages ../x 'a\x1b[2Jb'")


def test_worker_processes_of_a_training_know_the_modules(write):
    """Each environment lives in a process of its own, which begins without the user's modules."""
    write(my_first=f"import gymnasium\n{REGISTERED}\nclass Plain(gymnasium.Wrapper):\n    pass")
    modules = {"user_modules": import_typed(["my_first"]), "gym_packages": ("my_first",)}
    spec = spec_of("ppo", "my/Lake-v0", {"env_wrapper": "my_first.Plain"}, vec_env="subproc")
    env = make_training_env(dataclasses.replace(spec, **modules), None)
    assert np.array_equal(env.reset(), [0])
    assert env.env_is_wrapped(sys.modules["my_first"].Plain) == [True]
    env.close()
