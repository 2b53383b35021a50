"""What an agent is trained on and evaluated on: arguments, limits, wrappers, files, memory."""

import gymnasium as gym
import numpy as np
import pytest
from rich.console import Console
from stable_baselines3.common import vec_env
from stable_baselines3.common.monitor import Monitor
from stable_baselines3.common.vec_env import DummyVecEnv, VecFrameStack, VecNormalize

from envs.wrappers import OneHotObservation, ScaleReward, TerminationReward
from pipeline.environments import (
    EVALUATION_TIME_LIMIT,
    check_env_id,
    evaluation_kwargs,
    make_env,
    make_evaluation_env,
    make_single_env,
    make_training_env,
    training_changes,
    training_kwargs,
    trains_on_variant,
    with_logs_located,
    with_maps_read,
)
from pipeline.errors import UserError
from pipeline.settings.hyperparams import split
from pipeline.train_spec import TrainSpec
from pipeline.training import train


def spec_of(env_id, entry=None, **kwargs):
    entry = {"n_timesteps": 100, **(entry or {})}
    return TrainSpec("random", env_id, split(entry), entry, seed=0, **kwargs)


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
SCALED = {"envs.wrappers.ScaleReward": {"scale": 0.01}}


@pytest.mark.parametrize(
    ("entry", "is_variant"),
    [
        ({}, False),
        ({"env_kwargs": SHAPED}, False),
        ({"train_env_kwargs": SHAPED}, True),
        ({"eval_env_kwargs": SHAPED}, True),
        ({"train_env_kwargs": {"max_episode_steps": 100}}, True),
        # Wrappers lie above Monitor, and normalisation above them.
        ({"train_env_wrapper": SCALED}, False),
        ({"env_wrapper": SCALED, "normalize": {"norm_reward": True}}, False),
        # The same for both, in two ways of saying it.
        ({"train_env_kwargs": SHAPED, "eval_env_kwargs": SHAPED}, False),
        ({"env_kwargs": SHAPED, "train_env_kwargs": SHAPED}, False),
        ({"env_kwargs": SHAPED, "train_env_kwargs": {"shelf_reward": -1}}, True),
        # What is usual may be said or left out.
        ({"train_env_kwargs": {"slip": 0.0, "max_episode_steps": 1000}}, False),
        ({"env_kwargs": {"slip": 0.1}, "train_env_kwargs": {"slip": 0.0}}, True),
    ],
)
def test_what_makes_training_returns_those_of_a_variant(entry, is_variant):
    assert trains_on_variant(spec_of("Warehouse-v0", entry)) is is_variant


CLIPPED = {"gymnasium.wrappers.ClipReward": {"min_reward": -10, "max_reward": 0}}


@pytest.mark.parametrize(
    ("entry", "words"),
    [
        ({}, ()),
        # What training and evaluation share is the environment that was asked for.
        ({"env_kwargs": SHAPED, "env_wrapper": SCALED, "eval_env_kwargs": {"slip": 0.1}}, ()),
        ({"env_kwargs": SHAPED, "train_env_kwargs": {**SHAPED, "random_start": False}}, ()),
        ({"train_env_kwargs": {"max_episode_steps": 1000, "slip": 0.0}}, ()),
        ({"normalize": {"norm_reward": True}}, ()),
        (
            {"train_env_kwargs": {"random_start": True, "max_episode_steps": 100, **SHAPED}},
            ("random starts", "episodes of 100 steps", "shelf_reward -10"),
        ),
        (
            {"train_env_wrapper": [CLIPPED, SCALED, "envs.wrappers.ActionMasks"]},
            ("rewards clipped at -10 and 0", "rewards x 0.01", "ActionMasks"),
        ),
        (
            {"train_env_wrapper": {"gymnasium.wrappers.ClipReward": {"max_reward": 1}}},
            ("rewards clipped at 1",),
        ),
    ],
)
def test_what_settings_change_for_training_in_words(entry, words):
    assert training_changes(spec_of("Warehouse-v0", entry)) == words


def test_arguments_of_a_registration_are_usual_too():
    # FrozenLake8x8-v1 is registered with this map and this limit.
    usual = {"map_name": "8x8", "max_episode_steps": 200, "is_slippery": True}
    assert not trains_on_variant(spec_of("FrozenLake8x8-v1", {"train_env_kwargs": usual}))
    other = {"train_env_kwargs": {"map_name": "4x4"}}
    assert trains_on_variant(spec_of("FrozenLake8x8-v1", other))
    assert not trains_on_variant(spec_of("FrozenLake-v1", other))


def test_training_environments_follow_the_seed_each_with_its_own():
    def starts(spec):
        env = make_training_env(spec, None)
        return [env.reset().tolist() for _ in range(3)]

    entry = {"n_envs": 2}
    first = starts(spec_of("CartPole-v1", entry))
    assert starts(spec_of("CartPole-v1", entry)) == first
    assert all(both[0] != both[1] for both in first)


# --- time limits ---------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("env_id", "entry", "training", "evaluation"),
    [
        # Without a limit of its own.
        ("CliffWalking-v1", {}, None, EVALUATION_TIME_LIMIT),
        ("CliffWalking-v1", {"eval_env_kwargs": {"max_episode_steps": 200}}, None, 200),
        ("CliffWalking-v1", {"env_kwargs": {"max_episode_steps": 50}}, 50, 50),
        ("CliffWalking-v1", {"train_env_kwargs": {"max_episode_steps": 70}}, 70, 1000),
        # With one.
        ("FrozenLake-v1", {}, 100, 100),
        ("FrozenLake-v1", {"train_env_kwargs": {"max_episode_steps": 7}}, 7, 100),
        ("envs:Warehouse-v0", {}, 1000, 1000),
        # Taken away: training may go on without end, evaluation must not.
        ("CartPole-v1", {"train_env_kwargs": {"max_episode_steps": -1}}, None, 500),
        ("CartPole-v1", {"env_kwargs": {"max_episode_steps": -1}}, None, EVALUATION_TIME_LIMIT),
    ],
)
def test_evaluation_always_has_a_time_limit(env_id, entry, training, evaluation):
    spec = spec_of(env_id, entry)
    assert time_limit(make_single_env(spec, training=True)) == training
    assert time_limit(make_single_env(spec)) == evaluation
    assert time_limit(make_training_env(spec, None).envs[0]) == training
    assert time_limit(make_evaluation_env(spec, 1).envs[0]) == evaluation


def test_an_episode_that_goes_in_circles_ends():
    env = make_evaluation_env(spec_of("CliffWalking-v1"), 1)
    env.reset()
    for step in range(1, EVALUATION_TIME_LIMIT + 1):
        _, _, dones, infos = env.step([0])
        assert dones[0] == (step == EVALUATION_TIME_LIMIT)
    assert infos[0]["TimeLimit.truncated"] is True
    assert infos[0]["episode"]["l"] == EVALUATION_TIME_LIMIT


# --- wrappers ------------------------------------------------------------------------------------

WRAPPED = {
    "env_wrapper": [
        {"envs.wrappers.TerminationReward": {"reward": 5}},
        "envs.wrappers.OneHotObservation",
    ],
    "train_env_wrapper": [{"envs.wrappers.ScaleReward": {"scale": 0.5}}],
}


def test_wrappers_stand_in_their_order():
    spec = spec_of("FrozenLake-v1", WRAPPED)
    both = [OneHotObservation, TerminationReward]
    training, evaluation = make_training_env(spec, None), make_evaluation_env(spec, 1)
    # Monitor is inside: it records the rewards of the environment itself.
    assert layers(training.envs[0])[:4] == [ScaleReward, *both, Monitor]
    assert layers(evaluation.envs[0])[:3] == [*both, Monitor]
    assert layers(make_single_env(spec, training=True))[:3] == [ScaleReward, *both]
    assert layers(make_single_env(spec))[:2] == both
    assert training.observation_space.shape == evaluation.observation_space.shape == (16,)


def test_rewards_are_changed_for_training_and_recorded_unchanged():
    scaled = {"envs.wrappers.ScaleReward": {"scale": 0.5}}
    entry = {"env_kwargs": {"desc": ["SG"]}, "train_env_wrapper": scaled}
    spec = spec_of("Warehouse-v0", entry)
    made = {50.0: make_training_env(spec, None), 100.0: make_evaluation_env(spec, 1)}
    for reward, env in made.items():
        env.reset()
        _, rewards, dones, infos = env.step([3])
        assert (rewards[0], dones[0]) == (reward, True)
        assert infos[0]["episode"]["r"] == 100.0


def test_a_wrapper_put_innermost_is_inside_monitor():
    made = []

    def wrap(env):
        made.append(ScaleReward(env, 2.0))
        return made[-1]

    env = make_evaluation_env(spec_of("FrozenLake-v1", WRAPPED), 2, wrap_innermost=wrap)
    assert [single.get_wrapper_attr("scale") for single in env.envs] == [2.0, 2.0]
    chain = layers(env.envs[0])
    assert chain.index(ScaleReward) == chain.index(Monitor) + 1
    assert len(made) == 2


def test_a_wrapper_that_does_not_fit_is_told_in_one_line():
    spec = spec_of("CartPole-v1", {"env_wrapper": "envs.wrappers.OneHotObservation"})
    with pytest.raises(UserError, match="OneHotObservation needs Discrete observations"):
        make_single_env(spec)


# --- vectorised environments ---------------------------------------------------------------------


@pytest.mark.parametrize(
    ("given", "training", "evaluation"),
    [
        (True, (True, True, 0.9), (True, False, 0.9)),
        ({"norm_obs": False}, (False, True, 0.9), (False, False, 0.9)),
        ({"norm_reward": False, "gamma": 0.5}, (True, False, 0.5), (True, False, 0.5)),
    ],
)
def test_normalisation(given, training, evaluation):
    spec = spec_of("CartPole-v1", {"normalize": given, "gamma": 0.9, "n_envs": 2})
    env, eval_env = make_training_env(spec, None), make_evaluation_env(spec, 1)
    assert isinstance(env, VecNormalize)
    assert isinstance(eval_env, VecNormalize)
    assert (env.norm_obs, env.norm_reward, env.gamma) == training
    assert (eval_env.norm_obs, eval_env.norm_reward, eval_env.gamma) == evaluation
    assert (env.training, eval_env.training) == (True, False)


def test_evaluation_leaves_the_statistics_alone_and_reports_rewards_as_they_are():
    eval_env = make_evaluation_env(
        spec_of("CartPole-v1", {"normalize": True}), 1, render_mode="rgb_array"
    )
    assert eval_env.get_attr("render_mode") == ["rgb_array"]
    eval_env.reset()
    before = eval_env.obs_rms.mean.copy()
    rewards = [eval_env.step([0])[1][0] for _ in range(5)]
    assert rewards == [1.0] * 5
    np.testing.assert_array_equal(eval_env.obs_rms.mean, before)
    for env in (
        make_training_env(spec_of("CartPole-v1", {"normalize": False}), None),
        make_evaluation_env(spec_of("CartPole-v1"), 1),
    ):
        assert type(env) is DummyVecEnv


def test_observations_are_stacked_outside_of_normalisation():
    spec = spec_of("CartPole-v1", {"frame_stack": 3, "normalize": {"norm_reward": False}})
    for env in (make_training_env(spec, None), make_evaluation_env(spec, 1)):
        assert isinstance(env, VecFrameStack)
        assert isinstance(env.venv, VecNormalize)
        assert env.observation_space.shape == (12,)
        first = env.reset()
        np.testing.assert_array_equal(first[0, :8], 0)
        second, _, _, _ = env.step([0])
        np.testing.assert_array_equal(second[0, 4:8], first[0, 8:])


def test_pictures_are_turned_for_networks():
    """Networks want the channels first, whoever made the environment."""
    gym.register("Picture-v0", entry_point=Picture)
    try:
        env = make_evaluation_env(spec_of("Picture-v0"), 1)
    finally:
        del gym.registry["Picture-v0"]
    assert env.observation_space.shape == (3, 36, 40)
    assert env.reset().shape == (1, 3, 36, 40)


class Picture(gym.Env):
    observation_space = gym.spaces.Box(0, 255, (36, 40, 3), np.uint8)
    action_space = gym.spaces.Discrete(2)

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        return np.zeros((36, 40, 3), np.uint8), {}


def test_the_kind_of_vectorised_environment_is_for_training_alone(monkeypatch):
    class Parallel(DummyVecEnv):
        """Stands in for the one that starts processes."""

    monkeypatch.setattr(vec_env, "SubprocVecEnv", Parallel)
    spec = spec_of("FrozenLake-v1", vec_env="subproc")
    assert type(make_training_env(spec, None)) is Parallel
    assert type(make_evaluation_env(spec, 1)) is DummyVecEnv


# --- names ---------------------------------------------------------------------------------------


def test_environments_are_known_by_name_with_or_without_their_module():
    check_env_id("Warehouse-v0")
    check_env_id("envs:Warehouse-v0")
    with pytest.raises(UserError, match=r"unknown environment 'Warehose-v0': .*'Warehouse-v0'"):
        check_env_id("Warehose-v0")
    with pytest.raises(UserError, match=r"not imported .*: add --gym-packages no_such_module"):
        check_env_id("no_such_module:Warehouse-v0")


@pytest.mark.parametrize(
    ("env_id", "kwargs", "complaint"),
    [
        ("FrozenLake-v1", {"slippery": True}, "slippery"),
        ("Warehouse-v0", {"slip": 2}, "slip"),
        ("Warehouse-v0", {"desc": "no_such_map.txt"}, "no_such_map.txt"),
        ("FrozenLake-v1", {"map_name": "9x9"}, "9x9"),
    ],
)
def test_wrong_arguments_are_told_in_one_line(env_id, kwargs, complaint):
    with pytest.raises(UserError, match=complaint) as caught:
        make_env(env_id, kwargs)
    assert str(caught.value).startswith(f"{env_id}: ")
    assert "\n" not in str(caught.value)


# --- files that arguments name -------------------------------------------------------------------

ROWS = ["S..", ".#.", "..G"]


@pytest.fixture
def map_file(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "map.txt").write_text("S..\n.#.\n..G\n")


@pytest.mark.usefixtures("map_file")
@pytest.mark.parametrize("env_id", ["Warehouse-v0", "MineMaze-v0", "envs:Warehouse-v0"])
@pytest.mark.parametrize("key", ["env_kwargs", "train_env_kwargs", "eval_env_kwargs"])
def test_a_maps_rows_take_the_place_of_its_path(env_id, key):
    settings = {"gamma": 0.9, key: {"desc": "map.txt", "slip": 0.1}}
    read = {"gamma": 0.9, key: {"desc": ROWS, "slip": 0.1}}
    assert with_maps_read(env_id, settings) == read
    assert settings[key]["desc"] == "map.txt"
    settings[key]["desc"] = "S..\n.#.\n..G"
    assert with_maps_read(env_id, settings) == read


@pytest.mark.usefixtures("map_file")
def test_what_is_no_map_file_is_left_alone_and_a_missing_one_is_named():
    rows = {"env_kwargs": {"desc": ROWS}, "eval_env_kwargs": None}
    assert with_maps_read("Warehouse-v0", rows) == rows
    assert with_maps_read("Warehouse-v0", {}) == {}
    lake = {"env_kwargs": {"desc": "map.txt"}}
    assert with_maps_read("FrozenLake-v1", lake) == lake
    with pytest.raises(UserError, match=r"Warehouse-v0: desc: cannot read the map file no\.txt"):
        with_maps_read("Warehouse-v0", {"env_kwargs": {"desc": "no.txt"}})


@pytest.mark.usefixtures("map_file")
def test_a_log_is_found_from_other_folders(tmp_path):
    settings = {"env_kwargs": {"log": "pulls.csv"}, "eval_env_kwargs": {"log": "/a.csv"}}
    found = with_logs_located("ReplayBandit-v0", settings)
    place = str(tmp_path / "pulls.csv")
    assert found == {"env_kwargs": {"log": place}, "eval_env_kwargs": {"log": "/a.csv"}}
    assert settings["env_kwargs"]["log"] == "pulls.csv"
    assert with_logs_located("FrozenLake-v1", settings) == settings
    assert with_logs_located("ReplayBandit-v0", {"env_kwargs": None}) == {"env_kwargs": None}


# --- memory --------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("key", "wrapper", "argument"),
    [
        ("env_wrapper", "gymnasium.wrappers.FrameStackObservation", "stack_size"),
        ("vec_env_wrapper", "stable_baselines3.common.vec_env.VecFrameStack", "n_stack"),
    ],
)
def test_stacks_of_wrappers_are_bounded(key, wrapper, argument):
    spec = spec_of("CartPole-v1", {key: {wrapper: {argument: 10**9}}})
    with pytest.raises(UserError, match=f"{argument} must be at most 10,000"):
        make_evaluation_env(spec, 1)


class Greedy(gym.Env):
    def __init__(self):
        np.empty(2**50)


@pytest.mark.parametrize(
    ("algo", "entry", "said"),
    [
        ("ppo", {"n_envs": 10**9}, "n_envs 1,000,000,000 would take 18,626 GB of memory at least"),
        ("ppo", {"n_steps": 10**12}, "Unable to allocate"),
        ("dqn", {"buffer_size": 10**12}, "Unable to allocate"),
        ("ppo", {"policy_kwargs": "dict(net_arch=[1000000, 1000000])"}, "allocate memory"),
        ("ppo", {"env_id": "Greedy-v0"}, r"Greedy-v0: .*allocate"),
    ],
)
def test_numbers_beyond_all_memory_end_in_one_line_and_leave_nothing(
    tmp_path, monkeypatch, algo, entry, said
):
    greedy = gym.envs.registration.EnvSpec("Greedy-v0", Greedy, max_episode_steps=9)
    monkeypatch.setitem(gym.registry, "Greedy-v0", greedy)
    raw = {"n_timesteps": 10, **entry}
    env_id = raw.pop("env_id", "CartPole-v1")
    spec = TrainSpec(algo, env_id, split(raw), raw, seed=0, log_folder=tmp_path / "logs")
    with pytest.raises(UserError, match=said) as caught:
        train(spec, Console(quiet=True), {}, "")
    assert "\n" not in str(caught.value)
    assert not (tmp_path / "logs").exists()
