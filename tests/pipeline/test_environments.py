"""What an agent is trained on and evaluated on: arguments, limits, wrappers, files."""

import gymnasium as gym
import numpy as np
import pytest
from stable_baselines3.common.monitor import Monitor
from stable_baselines3.common.vec_env import DummyVecEnv

from rl_yardstick.envs.wrappers import OneHotObservation, ScaleReward, TerminationReward
from rl_yardstick.pipeline.environments import (
    EVALUATION_TIME_LIMIT,
    evaluation_kwargs,
    make_evaluation_env,
    make_single_env,
    make_training_env,
    map_name,
    training_changes,
    training_kwargs,
    with_files_read,
)
from rl_yardstick.pipeline.errors import UserError
from tests.pipeline.short_runs import spec_of as spec_for


def spec_of(env_id, entry=None):
    return spec_for("random", env_id, entry)


def layers(env):
    """The classes around an environment, the outermost first."""
    classes = [type(env)]
    while env is not env.unwrapped:
        env = env.env
        classes.append(type(env))
    return classes


def time_limit(env):
    while env is not env.unwrapped:
        if isinstance(env, gym.wrappers.TimeLimit):
            return env._max_episode_steps
        env = env.env
    return None


# --- arguments -----------------------------------------------------------------------------------


ENTRY = {
    "env_kwargs": {"step_reward": -2, "goal_reward": 50},
    "train_env_kwargs": {"random_start": True, "max_episode_steps": 30, "goal_reward": 60},
    "eval_env_kwargs": {"slip": 0.1, "max_episode_steps": 40},
}


def test_which_arguments_reach_training_and_which_evaluation(tmp_path):
    spec = spec_of("Warehouse-v0", {**ENTRY, "n_envs": 2})
    shared = {"step_reward": -2}
    own = {"goal_reward": 60, "random_start": True, "max_episode_steps": 30}
    assert training_kwargs(spec) == {**shared, **own}
    own = {"goal_reward": 50, "slip": 0.1, "max_episode_steps": 40}
    assert evaluation_kwargs(spec) == {**shared, **own}
    training, evaluation = make_training_env(spec, tmp_path), make_evaluation_env(spec, 3)
    assert (training.num_envs, evaluation.num_envs) == (2, 3)
    for env, goal_reward, limit in ((training, 60, 30), (evaluation, 50, 40)):
        single = make_single_env(spec, training=env is training)
        for each in (*env.envs, single):
            kwargs = each.unwrapped.spec.kwargs
            assert (kwargs["step_reward"], kwargs["goal_reward"]) == (-2, goal_reward)
            assert time_limit(each) == limit
            assert ("slip" in kwargs) == (env is evaluation)
        # Only training begins anywhere.
        starts = {int(env.reset()[0]) for _ in range(20)}
        assert (len(starts) > 1) == (env is training)
    training.close()
    # Only training is recorded.
    assert sorted(path.name for path in tmp_path.iterdir()) == ["0.monitor.csv", "1.monitor.csv"]
    assert all(isinstance(env, Monitor) for env in evaluation.envs)


SHAPED = {"shelf_reward": -10}
SCALED = {"rl_yardstick.envs.wrappers.ScaleReward": {"scale": 0.01}}


UNLIMITED = {"max_episode_steps": -1}


@pytest.mark.parametrize(
    ("entry", "changes"),
    [
        ({"train_env_kwargs": SHAPED}, ("shelf_reward -10",)),
        ({"eval_env_kwargs": SHAPED}, ("shelf_reward -100",)),  # training is as usual
        ({"train_env_kwargs": SHAPED, "eval_env_kwargs": SHAPED}, ()),
        ({"env_kwargs": SHAPED, "train_env_kwargs": {"shelf_reward": -1}}, ("shelf_reward -1",)),
        ({"train_env_kwargs": UNLIMITED}, ("no time limit",)),
        ({"env_kwargs": UNLIMITED, "train_env_kwargs": {"max_episode_steps": None}}, ()),
        ({"eval_env_kwargs": {"max_episode_steps": 9}}, ()),
        ({"train_env_kwargs": {"random_start": True}}, ("random starts",)),
        ({"train_env_wrapper": SCALED}, ("rewards x 0.01",)),
        # In evaluations, too.
        ({"env_wrapper": SCALED, "normalize": {"norm_reward": True}}, ()),
        # What is usual may be said or left out.
        ({"train_env_kwargs": {"slip": 0.0, "max_episode_steps": 1000}}, ()),
    ],
)
def test_what_training_changes(entry, changes):
    assert training_changes(spec_of("Warehouse-v0", entry)) == changes


# --- time limits ---------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("env_id", "entry", "training", "evaluation"),
    [
        # Without a limit of its own.
        ("CliffWalking-v1", {}, None, EVALUATION_TIME_LIMIT),
        # Taken away: training may go on without end, evaluation must not.
        ("CartPole-v1", {"train_env_kwargs": {"max_episode_steps": -1}}, None, 500),
        ("CartPole-v1", {"env_kwargs": {"max_episode_steps": -1}}, None, EVALUATION_TIME_LIMIT),
    ],
)
def test_evaluation_always_has_a_time_limit(env_id, entry, training, evaluation):
    spec = spec_of(env_id, entry)
    made = make_single_env(spec, training=True), make_training_env(spec, None).envs[0]
    assert [time_limit(env) for env in made] == [training] * 2
    made = make_single_env(spec), make_evaluation_env(spec, 1).envs[0]
    assert [time_limit(env) for env in made] == [evaluation] * 2


# --- wrappers ------------------------------------------------------------------------------------

WRAPPED = {
    "env_wrapper": [
        {"rl_yardstick.envs.wrappers.TerminationReward": {"reward": 5}},
        "rl_yardstick.envs.wrappers.OneHotObservation",
    ],
    "train_env_wrapper": [{"rl_yardstick.envs.wrappers.ScaleReward": {"scale": 0.5}}],
}


def test_wrappers_stand_in_their_order():
    spec = spec_of("FrozenLake-v1", WRAPPED)
    both = [OneHotObservation, TerminationReward]
    training, evaluation = make_training_env(spec, None), make_evaluation_env(spec, 1)
    # Monitor is inside: it records the rewards of the environment itself.
    assert layers(training.envs[0])[:4] == [ScaleReward, *both, Monitor]
    assert layers(evaluation.envs[0])[:3] == [*both, Monitor]
    assert training.observation_space.shape == evaluation.observation_space.shape == (16,)
    # Rewards are changed for training, and recorded unchanged.
    scaled = {"env_kwargs": {"desc": ["SG"]}, "train_env_wrapper": WRAPPED["train_env_wrapper"]}
    spec = spec_of("Warehouse-v0", scaled)
    made = {50.0: make_training_env(spec, None), 100.0: make_evaluation_env(spec, 1)}
    for reward, env in made.items():
        env.reset()
        _, rewards, dones, infos = env.step([3])
        assert (rewards[0], dones[0], infos[0]["episode"]["r"]) == (reward, True, 100.0)


# --- vectorised environments ---------------------------------------------------------------------


def test_normalisation_learns_in_training_alone_and_rewards_are_evaluated_as_they_are():
    spec = spec_for("ppo", "CartPole-v1", {"normalize": True, "gamma": 0.9, "n_envs": 2})
    env, eval_env = make_training_env(spec, None), make_evaluation_env(spec, 1)
    for made, trains in ((env, True), (eval_env, False)):
        assert (made.norm_obs, made.norm_reward, made.training) == (True, trains, trains)
        assert made.gamma == 0.9
    eval_env.reset()
    statistics = eval_env.obs_rms
    before = statistics.mean.copy()
    assert [eval_env.step([0])[1][0] for _ in range(5)] == [1.0] * 5
    np.testing.assert_array_equal(statistics.mean, before)
    plain = make_training_env(spec_of("CartPole-v1", {"normalize": False}), None)
    assert type(plain) is DummyVecEnv


MISTAKES = [
    (
        "FrozenLake-v1",
        {"slippery": True},
        "unknown argument 'slippery': did you mean 'is_slippery'?",
    ),
    ("FrozenLake-v1", {"map_name": "9x9"}, "there is no '9x9' (with map_name='9x9')"),
    ("Warehouse-v0", {"slip": 2}, "slip must be a finite number from 0 to 1, not 2"),
    ("Warehouse-v0", {"desc": []}, "the map is empty (with desc=[])"),
]


@pytest.mark.parametrize(("env_id", "kwargs", "complaint"), MISTAKES)
def test_a_mistaken_argument_is_told_in_a_line(env_id, kwargs, complaint):
    with pytest.raises(UserError) as refused:
        make_single_env(spec_of(env_id, {"env_kwargs": kwargs}), training=True)
    assert str(refused.value) == f"{env_id}: {complaint}"


# --- files that arguments name -------------------------------------------------------------------

ROWS = ["S..", ".#.", "..G"]


@pytest.fixture
def map_file(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "map.txt").write_text("S..\n.#.\n..G\n")


@pytest.mark.usefixtures("map_file")
def test_a_maps_rows_take_the_place_of_its_path():
    env_id = "Warehouse-v0"
    for key in ("env_kwargs", "train_env_kwargs", "eval_env_kwargs"):
        settings = {"gamma": 0.9, key: {"desc": "map.txt", "slip": 0.1}}
        read = {"gamma": 0.9, key: {"desc": ROWS, "slip": 0.1}}
        assert with_files_read(env_id, settings) == with_files_read(env_id, read) == read
        assert settings[key]["desc"] == "map.txt"
    assert with_files_read("FrozenLake-v1", settings) == settings
    with pytest.raises(UserError, match=r"Warehouse-v0: desc: cannot read the map file no\.txt"):
        with_files_read("Warehouse-v0", {"env_kwargs": {"desc": "no.txt"}, "eval_env_kwargs": None})


def test_a_maps_name_is_that_of_the_file_that_is_evaluated_on():
    path, other, rows = {"desc": "maps/depot.txt"}, {"desc": "b.txt"}, {"desc": "S.\n.G"}
    for kwargs, expected in (
        ({"env_kwargs": path}, "depot.txt"),
        ({"env_kwargs": path, "eval_env_kwargs": other}, "b.txt"),
        ({"env_kwargs": path, "eval_env_kwargs": {"slip": 0.1}}, "depot.txt"),
        ({"env_kwargs": path, "eval_env_kwargs": {"desc": ["SG"]}}, ""),
        ({"train_env_kwargs": path}, ""),
        ({"env_kwargs": rows}, ""),
        ({}, ""),
    ):
        assert map_name("Warehouse-v0", kwargs) == expected, kwargs
    assert map_name("CartPole-v1", {"env_kwargs": path}) == ""


@pytest.mark.usefixtures("map_file")
def test_a_log_is_found_from_other_folders(tmp_path):
    settings = {"env_kwargs": {"log": "pulls.csv"}, "eval_env_kwargs": {"log": "/a.csv"}}
    found = with_files_read("ReplayBandit-v0", settings)
    place = str(tmp_path / "pulls.csv")
    assert found == {"env_kwargs": {"log": place}, "eval_env_kwargs": {"log": "/a.csv"}}
    assert with_files_read("FrozenLake-v1", settings) == settings
