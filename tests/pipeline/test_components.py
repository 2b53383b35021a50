"""Names become objects of admitted kinds alone: those in files, and modules that the user typed."""

import math
import sys

import gymnasium as gym
import pytest
from stable_baselines3.common.buffers import BaseBuffer
from stable_baselines3.common.callbacks import BaseCallback, StopTrainingOnMaxEpisodes
from torch import nn, optim

from rl_yardstick.pipeline.components import (
    build,
    build_value,
    check_typed,
    find_class,
    import_modules,
    module_name,
    split_id,
)
from rl_yardstick.pipeline.environments import make_training_env
from rl_yardstick.pipeline.errors import UserError
from rl_yardstick.pipeline.spec import Component
from rl_yardstick.pipeline.training import make_agent
from tests.pipeline.short_runs import CART, spec_of

KINDS = (nn.Module, optim.Optimizer, BaseBuffer)
CALLBACKS = "stable_baselines3.common.callbacks"

NAMES = [
    ("nn.Tanh", nn.Tanh),
    ("torch.nn.modules.activation.ReLU", nn.ReLU),
    ("th.optim.Adam", optim.Adam),
    ("RMSpropTFLike", "RMSpropTFLike"),
    ("HerReplayBuffer", "HerReplayBuffer"),
    ("nn.Tahn", "Tahn does not exist: did you mean 'Tanh'"),
    ("nn.functional.relu", "is no Module or Optimizer or BaseBuffer"),
    ("th.load", "is in none of the packages"),
    ("os.system", "is in none of the packages"),
    ("rl_zoo3.utils.get_class_by_name", "is in none of the packages"),
    ("gymnasium.wrapers.TimeLimit", "No module named 'gymnasium.wrapers'"),
    ("print", "is in none of the packages"),
]


@pytest.mark.parametrize(("name", "found"), NAMES)
def test_which_names_are_classes(name, found):
    if isinstance(found, type):
        assert find_class(name, KINDS, "here", []) is found
    elif found in name:
        assert find_class(name, KINDS, "here", []).__name__ == found
    else:
        with pytest.raises(UserError, match=r"^here: ") as caught:
            find_class(name, KINDS, "here", [])
        assert found in str(caught.value)


COMPONENTS = [
    (gym.Wrapper, "gymnasium.wrappers.TimeLimit", {}, "max_episode_steps"),
    (gym.Wrapper, "gymnasium.wrappers.TimeLimit", {"max_steps": 5}, "unknown argument 'max_steps'"),
    (gym.Wrapper, "gymnasium.make", {}, "gymnasium.make is no Wrapper"),
    (gym.Wrapper, "gymnasium.wrappers.TimeLimt", {}, "did you mean 'TimeLimit'"),
    (gym.Wrapper, "minigrid.wrappers.FlatObsWrapper", {}, "admit others with --gym-packages"),
    (BaseCallback, f"{CALLBACKS}.CheckpointCallback", {}, "save_freq"),
    (BaseCallback, f"{CALLBACKS}.BaseCallback", {}, "callback"),
    (BaseCallback, "stable_baselines3.common.monitor.Monitor", {}, "Monitor is no BaseCallback"),
]


@pytest.mark.parametrize(("base", "name", "kwargs", "said"), COMPONENTS)
def test_components_that_are_wrong(base, name, kwargs, said, tmp_path):
    inner = [] if base is BaseCallback else [gym.make(CART)]
    with pytest.raises(UserError) as caught:
        build(Component(name=name, kwargs=kwargs), base, "callback", [], tmp_path, *inner)
    assert said in str(caught.value)
    assert "\n" not in str(caught.value)


def test_callbacks_write_into_the_run_folder_alone(tmp_path):
    def made(name, **kwargs):
        component = Component(name=f"{CALLBACKS}.{name}", kwargs=kwargs)
        return build(component, BaseCallback, "callback", [], tmp_path)

    assert isinstance(made("StopTrainingOnMaxEpisodes", max_episodes=5), StopTrainingOnMaxEpisodes)
    assert made("CheckpointCallback", save_freq=10).save_path == str(tmp_path)
    inside = made("CheckpointCallback", save_freq=10, save_path="elsewhere")
    assert inside.save_path == str(tmp_path / "elsewhere")
    (tmp_path / "link").symlink_to(tmp_path.parent)
    for place in ("/etc/x", "..", "a/../../x", "link/x"):
        with pytest.raises(UserError, match="save_path must lie inside the run folder"):
            made("CheckpointCallback", save_freq=10, save_path=place)
    with pytest.raises(UserError, match="name_prefix begins the names of files"):
        made("CheckpointCallback", save_freq=10, name_prefix="../x")


def test_arguments_make_an_agent():
    kwargs = {
        "net_arch": {"pi": [8], "vf": [16]},
        "activation_fn": "nn.ELU",
        "optimizer_class": "th.optim.Adam",
        "optimizer_kwargs": {"fused": True},  # a setting of the library's
    }
    entry = {"learning_rate": "lin_1e-3", "n_steps": "64", "policy_kwargs": kwargs, "n_envs": 1}
    model = make_agent(spec_of("ppo", CART, entry), None)
    assert isinstance(model.policy.mlp_extractor.policy_net[1], nn.ELU)
    assert model.policy.mlp_extractor.value_net[0].out_features == 16
    assert isinstance(model.policy.optimizer, optim.Adam)
    assert model.policy.optimizer.defaults["fused"] is True
    assert math.isclose(model.lr_schedule(0.5), 5e-4)
    assert build_value([{"a": "no.such.name-"}], "here", []) == [{"a": "no.such.name-"}]
    # Gaussian noise on the values of a table, which no key of the file format may swallow.
    entry = {"exploration": "gaussian_noise", "noise_std": 0.25}
    assert make_agent(spec_of("qlearning", "FrozenLake-v1", entry), None).noise_std == 0.25


# --- modules of the user --------------------------------------------------------------------------

MODULE = """
import gymnasium as gym
import numpy as np
from {beside} import STEP

class Own(gym.Env):
    observation_space, action_space = gym.spaces.Discrete(2), gym.spaces.Discrete(2)
    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        return 0, {{}}
    def step(self, action):
        return STEP, 1.0, True, False, {{}}

class Twice(gym.RewardWrapper):
    def reward(self, reward):
        return 2 * reward

gym.register("{name}-v0", Own, max_episode_steps=5)
"""


@pytest.mark.parametrize("how", ["name", "file", "package"])
def test_modules_that_were_typed(own_folder, monkeypatch, how):
    monkeypatch.setattr(sys, "path", [*sys.path])
    name, beside = f"mine_{how}", f"beside_{how}"
    folder = own_folder / ("there" if how == "file" else "")
    folder.mkdir(exist_ok=True)
    (folder / f"{beside}.py").write_text("STEP = 1\n")
    text = MODULE.format(name=name, beside=beside)
    if how == "package":
        (own_folder / name).mkdir()
        (own_folder / name / "__init__.py").write_text(text)
    else:
        (folder / f"{name}.py").write_text(text)
    typed = f"there/{name}.py" if how == "file" else name
    import_modules([typed])
    assert module_name(typed) == name
    wrapper = {f"{name}.Twice": {}}
    spec = spec_of("qlearning", f"{name}-v0", {"env_wrapper": wrapper}, gym_packages=[typed])
    env = make_training_env(spec, None)
    env.reset()
    assert env.step([0])[1].tolist() == [2.0]
    with pytest.raises(UserError, match="admit others with --gym-packages"):
        make_training_env(spec.changed(gym_packages=[]), None)


def test_modules_that_cannot_be_imported(own_folder, monkeypatch):
    monkeypatch.setattr(sys, "path", [*sys.path])
    (own_folder / "broken.py").write_text("import nothing_of_that_name\n")
    (own_folder / "failing.py").write_text("x = 1\nraise ValueError('no')\n")
    (own_folder / "leaving.py").write_text("raise SystemExit(3)\n")
    for typed, said in (
        ("nothing_at_all", "no module named nothing_at_all"),
        ("broken", "no module named nothing_of_that_name"),
        ("failing", r"failing\.py:2: no"),
        ("leaving.py", r"leaving\.py:1: 3"),
        ("none.py", r"none\.py: no such file"),
    ):
        with pytest.raises(UserError, match=said):
            import_modules([typed])


def test_a_folder_does_not_import_what_was_not_typed():
    check_typed(["a", "b.py"], ["./b.py", "a"], "here")
    with pytest.raises(UserError, match=r"here was made with modules .* --gym-packages b\.py"):
        check_typed(["a", "b.py"], ["a"], "here")
    assert split_id("module:Env-v0") == ("module", "Env-v0")
    assert split_id("ALE/Pong-v5") == ("", "ALE/Pong-v5")
