"""What settings name: classes and modules of admitted kinds alone, and environments."""

import math
import sys

import gymnasium as gym
import numpy as np
import pytest
from stable_baselines3.common.buffers import BaseBuffer
from stable_baselines3.common.callbacks import BaseCallback, StopTrainingOnMaxEpisodes
from stable_baselines3.common.monitor import Monitor
from stable_baselines3.common.vec_env import DummyVecEnv
from torch import nn, optim

from rl_yardstick.envs.wrappers import OneHotObservation, ScaleReward, TerminationReward
from rl_yardstick.pipeline import components, environments
from rl_yardstick.pipeline.environments import make_envs, make_single_env, make_training_env
from rl_yardstick.pipeline.errors import UserError
from rl_yardstick.pipeline.spec import Component
from rl_yardstick.pipeline.training import make_agent
from tests.pipeline.short_runs import CART, TABLES, spec_of


def world(env_id, entry=None):
    return spec_of("random", env_id, entry)


def layers(env):
    """An environment and what is in it, the outermost first."""
    found = [env]
    while found[-1] is not env.unwrapped:
        found.append(found[-1].env)
    return found


def time_limit(env):
    limits = (each for each in layers(env) if isinstance(each, gym.wrappers.TimeLimit))
    return next((each._max_episode_steps for each in limits), None)


ENTRY = {
    "env_kwargs": {"step_reward": -2, "goal_reward": 50},
    "train_env_kwargs": {"random_start": True, "max_episode_steps": 30, "goal_reward": 60},
    "eval_env_kwargs": {"slip": 0.1, "max_episode_steps": 40},
}


def test_which_arguments_reach_training_and_which_evaluation(tmp_path):
    spec = world("Warehouse-v0", {**ENTRY, "n_envs": 2})
    shared = {"step_reward": -2}
    own = {"goal_reward": 60, "random_start": True, "max_episode_steps": 30}
    assert environments.kwargs_of(spec, training=True) == {**shared, **own}
    own = {"goal_reward": 50, "slip": 0.1, "max_episode_steps": 40}
    assert environments.kwargs_of(spec) == {**shared, **own}
    training, evaluation = make_training_env(spec, tmp_path), make_envs(spec, 3)
    assert (training.num_envs, evaluation.num_envs) == (2, 3)
    for env, goal_reward, limit in ((training, 60, 30), (evaluation, 50, 40)):
        for each in (*env.envs, make_single_env(spec, training=env is training)):
            kwargs = each.unwrapped.spec.kwargs
            assert (kwargs["step_reward"], kwargs["goal_reward"]) == (-2, goal_reward)
            assert time_limit(each) == limit
            assert ("slip" in kwargs) == (env is evaluation)
        # Only training begins anywhere.
        assert (len({int(env.reset()[0]) for _ in range(20)}) > 1) == (env is training)
    training.close()
    # Only training is recorded.
    assert sorted(path.name for path in tmp_path.iterdir()) == ["0.monitor.csv", "1.monitor.csv"]
    assert all(isinstance(env, Monitor) for env in evaluation.envs)


@pytest.mark.parametrize(("entry", "changes"), TABLES["changes"])
def test_what_training_changes(entry, changes):
    assert [*environments.training_changes(world("Warehouse-v0", entry))] == changes


def test_evaluation_always_has_a_time_limit():
    """Where one is taken away, training may go on without end."""
    unlimited = {"max_episode_steps": -1}
    for env_id, entry, limit in (
        ("CliffWalking-v1", {}, environments.EVALUATION_TIME_LIMIT),
        (CART, {"train_env_kwargs": unlimited}, 500),
        (CART, {"env_kwargs": unlimited}, environments.EVALUATION_TIME_LIMIT),
    ):
        spec = world(env_id, entry)
        made = make_single_env(spec, training=True), make_training_env(spec, None).envs[0]
        assert [time_limit(env) for env in made] == [None] * 2
        made = make_single_env(spec), make_envs(spec, 1).envs[0]
        assert [time_limit(env) for env in made] == [limit] * 2


OURS = "rl_yardstick.envs.wrappers"
WRAPPED = {
    "env_wrapper": [{f"{OURS}.TerminationReward": {"reward": 5}}, f"{OURS}.OneHotObservation"],
    "train_env_wrapper": [{f"{OURS}.ScaleReward": {"scale": 0.5}}],
}


def test_wrappers_stand_in_their_order():
    spec = world("FrozenLake-v1", WRAPPED)
    both = [OneHotObservation, TerminationReward]
    training, evaluation = make_training_env(spec, None), make_envs(spec, 1)
    # Monitor is inside: it records the rewards of the environment itself.
    kinds = [[type(each) for each in layers(env.envs[0])] for env in (training, evaluation)]
    assert (kinds[0][:4], kinds[1][:3]) == ([ScaleReward, *both, Monitor], [*both, Monitor])
    assert training.observation_space.shape == evaluation.observation_space.shape == (16,)
    # Rewards are changed for training, and recorded unchanged.
    scaled = {"env_kwargs": {"desc": ["SG"]}, "train_env_wrapper": WRAPPED["train_env_wrapper"]}
    spec = world("Warehouse-v0", scaled)
    made = {50.0: make_training_env(spec, None), 100.0: make_envs(spec, 1)}
    for reward, env in made.items():
        env.reset()
        _, rewards, dones, infos = env.step([3])
        assert (rewards[0], dones[0], infos[0]["episode"]["r"]) == (reward, True, 100.0)


def test_normalisation_learns_in_training_alone_and_rewards_are_evaluated_as_they_are():
    spec = spec_of("ppo", "CartPole-v1", {"normalize": True, "gamma": 0.9, "n_envs": 2})
    env, eval_env = make_training_env(spec, None), make_envs(spec, 1)
    for made, trains in ((env, True), (eval_env, False)):
        assert (made.norm_obs, made.norm_reward, made.training) == (True, trains, trains)
        assert made.gamma == 0.9
    eval_env.reset()
    statistics = eval_env.obs_rms
    before = statistics.mean.copy()
    assert [eval_env.step([0])[1][0] for _ in range(5)] == [1.0] * 5
    np.testing.assert_array_equal(statistics.mean, before)
    plain = make_training_env(world("CartPole-v1", {"normalize": False}), None)
    assert type(plain) is DummyVecEnv


def test_a_maps_rows_take_the_place_of_its_path_and_a_log_is_found_from_other_folders(
    tmp_path, monkeypatch
):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "map.txt").write_text("S..\n.#.\n..G\n")
    for key in ("env_kwargs", "train_env_kwargs", "eval_env_kwargs"):
        settings = {"gamma": 0.9, key: {"desc": "map.txt", "slip": 0.1}}
        read = {"gamma": 0.9, key: {"desc": ["S..", ".#.", "..G"], "slip": 0.1}}
        for each in (settings, read):
            assert environments.with_files_read("Warehouse-v0", each) == read
        assert settings[key]["desc"] == "map.txt"
    assert environments.with_files_read("CartPole-v1", settings) == settings
    logs = {"env_kwargs": {"log": "pulls.csv"}, "eval_env_kwargs": {"log": "/a.csv"}}
    found = environments.with_files_read("ReplayBandit-v0", logs)
    assert found == {**logs, "env_kwargs": {"log": str(tmp_path / "pulls.csv")}}


KINDS = (nn.Module, optim.Optimizer, BaseBuffer)
CALLBACKS = "stable_baselines3.common.callbacks"


@pytest.mark.parametrize(("name", "found"), TABLES["names"])
def test_which_names_are_classes(name, found):
    if found in name:
        assert components.find_class(name, KINDS, "here", []).__name__ == found
    else:
        with pytest.raises(UserError, match=r"^here: ") as caught:
            components.find_class(name, KINDS, "here", [])
        assert found in str(caught.value)


COMPONENTS = [
    (gym.Wrapper, "gymnasium.wrappers.TimeLimit", {}, "max_episode_steps"),
    (gym.Wrapper, "gymnasium.wrappers.TimeLimit", {"max_steps": 5}, "unknown argument 'max_steps'"),
    (gym.Wrapper, "minigrid.wrappers.FlatObsWrapper", {}, "admit others with --gym-packages"),
    (BaseCallback, f"{CALLBACKS}.CheckpointCallback", {}, "save_freq"),
    (BaseCallback, f"{CALLBACKS}.BaseCallback", {}, "callback"),
    (BaseCallback, "stable_baselines3.common.monitor.Monitor", {}, "Monitor is no BaseCallback"),
]


@pytest.mark.parametrize(("base", "name", "kwargs", "said"), COMPONENTS)
def test_components_that_are_wrong(base, name, kwargs, said, tmp_path):
    inner = [] if base is BaseCallback else [gym.make(CART)]
    component = Component(name=name, kwargs=kwargs)
    with pytest.raises(UserError) as caught:
        components.build(component, base, "callback", [], tmp_path, *inner)
    assert said in str(caught.value)
    assert "\n" not in str(caught.value)


def test_callbacks_write_into_the_run_folder_alone(tmp_path):
    def made(name, **kwargs):
        component = Component(name=f"{CALLBACKS}.{name}", kwargs=kwargs)
        return components.build(component, BaseCallback, "callback", [], tmp_path)

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
    kwargs = {"net_arch": {"pi": [8], "vf": [16]}, "activation_fn": "nn.ELU"}
    kwargs |= {"optimizer_class": "th.optim.Adam", "optimizer_kwargs": {"fused": True}}
    entry = {"learning_rate": "lin_1e-3", "n_steps": "64", "policy_kwargs": kwargs, "n_envs": 1}
    model = make_agent(spec_of("ppo", CART, entry), None)
    assert isinstance(model.policy.mlp_extractor.policy_net[1], nn.ELU)
    assert model.policy.mlp_extractor.value_net[0].out_features == 16
    assert isinstance(model.policy.optimizer, optim.Adam)
    assert model.policy.optimizer.defaults["fused"] is True
    assert math.isclose(model.lr_schedule(0.5), 5e-4)
    assert components.build_value([{"a": "no.such.name-"}], "here", []) == [{"a": "no.such.name-"}]
    # Gaussian noise on the values of a table, which no key of the file format may swallow.
    entry = {"exploration": "gaussian_noise", "noise_std": 0.25}
    assert make_agent(spec_of("qlearning", entry=entry), None).noise_std == 0.25


MODULE = """
import gymnasium as gym
from {beside} import FACTOR

class Twice(gym.RewardWrapper):
    def reward(self, reward):
        return FACTOR * reward
"""


@pytest.mark.parametrize("how", ["name", "file", "package"])
def test_modules_that_were_typed(own_folder, monkeypatch, how):
    monkeypatch.setattr(sys, "path", [*sys.path])
    name, beside = f"mine_{how}", f"beside_{how}"
    folder = own_folder / ("there" if how == "file" else "")
    folder.mkdir(exist_ok=True)
    (folder / f"{beside}.py").write_text("FACTOR = 2\n")
    text = MODULE.format(beside=beside)
    if how == "package":
        (own_folder / name).mkdir()
        (own_folder / name / "__init__.py").write_text(text)
    else:
        (folder / f"{name}.py").write_text(text)
    typed = f"there/{name}.py" if how == "file" else name
    components.import_modules([typed])
    assert components.module_name(typed) == name
    spec = spec_of("random", CART, {"env_wrapper": f"{name}.Twice"}, gym_packages=[typed])
    env = make_training_env(spec, None)
    env.reset()
    assert env.step([0])[1].tolist() == [2.0]
    with pytest.raises(UserError, match="admit others with --gym-packages"):
        make_training_env(spec.changed(gym_packages=[]), None)


def test_modules_that_cannot_be_imported(own_folder, monkeypatch):
    monkeypatch.setattr(sys, "path", [*sys.path])
    for text, typed, said in (
        ("x = 1\nraise ValueError('no')\n", "failing", r"failing\.py:2: ValueError: no"),
        ("raise SystemExit(3)\n", "leaving.py", r"leaving\.py:1: SystemExit: 3"),
    ):
        (own_folder / typed).with_suffix(".py").write_text(text)
        with pytest.raises(UserError, match=said):
            components.import_modules([typed])
