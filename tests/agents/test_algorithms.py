"""What Stable-Baselines3 demands of an algorithm, for every hand-written agent."""

import json
import pickle
import zipfile

import gymnasium as gym
import numpy as np
import pytest
import torch as th
from stable_baselines3.common.callbacks import (
    BaseCallback,
    CallbackList,
    CheckpointCallback,
    EvalCallback,
    LogEveryNTimesteps,
    StopTrainingOnMaxEpisodes,
    StopTrainingOnNoModelImprovement,
    StopTrainingOnRewardThreshold,
)
from stable_baselines3.common.env_util import make_vec_env
from stable_baselines3.common.evaluation import evaluate_policy
from stable_baselines3.common.logger import configure
from stable_baselines3.common.monitor import Monitor
from stable_baselines3.common.vec_env import DummyVecEnv, SubprocVecEnv, VecNormalize

from agents import ALGORITHMS, load_algorithm
from agents.common.schedules import ExponentialSchedule

TABULAR = [name for name, entry in ALGORITHMS.items() if entry.family == "tabular"]
# Others explore in a way of their own.
EXPLORERS = [
    name for name in TABULAR if "exploration" in load_algorithm(name).__signature__.parameters
]
LINEAR = [name for name, entry in ALGORITHMS.items() if entry.family == "linear"]
HAND_WRITTEN = [*TABULAR, *LINEAR, "random", "angle"]

pytestmark = pytest.mark.filterwarnings(
    "ignore:Training and eval env are not of the same type:UserWarning"
)


def env_id(name):
    return "CartPole-v1" if name == "angle" else "FrozenLake-v1"


def make(name, env=None, **kwargs):
    algorithm = load_algorithm(name)
    policy = next(iter(algorithm.policy_aliases))
    return algorithm(policy, env or env_id(name), **{"seed": 0, **kwargs})


def states(model):
    """Every state, or a batch of random ones where there is no end to them."""
    space = model.observation_space
    if isinstance(space, gym.spaces.Discrete):
        return np.arange(space.n)
    space.seed(0)
    return np.stack([space.sample() for _ in range(20)])


def attributes(model):
    """All that training changes, in a form that can be compared."""
    tables = {name: value.tolist() for name, value in model.policy.state_dict().items()}
    return {
        "tables": tables,
        "rng": model.rng.bit_generator.state,
        "num_timesteps": model.num_timesteps,
        "episodes": model._episode_num,
        "n_updates": model._n_updates,
        "returns": [episode["r"] for episode in model.ep_info_buffer],
    }


@pytest.mark.parametrize("name", HAND_WRITTEN)
def test_same_seed_same_training(name):
    first, second = (make(name).learn(600) for _ in range(2))
    assert attributes(first) == attributes(second)
    assert attributes(make(name, seed=1).learn(600)) != attributes(first)


@pytest.mark.parametrize("name", HAND_WRITTEN)
def test_global_generators_are_left_alone(name):
    def states():
        return np.random.get_state()[1].tolist(), th.get_rng_state().tolist()  # noqa: NPY002

    before = states()
    make(name).learn(300)
    assert states() == before


@pytest.mark.parametrize("name", ["qlearning", "sarsa", "expected_sarsa", "double_qlearning"])
def test_learning_happens(name):
    explore = 1.0 if name == "double_qlearning" else 0.1
    model = make(
        name,
        "envs:Warehouse-v0",
        learning_rate=ExponentialSchedule(0.3, 0.05),
        exploration_initial_eps=explore,
        exploration_final_eps=0.01,
        exploration_fraction=0.8,
    ).learn(100_000)
    mean_return, _ = evaluate_policy(model, Monitor(gym.make("Warehouse-v0")), 1)
    assert mean_return == 79


@pytest.mark.parametrize("name", HAND_WRITTEN)
@pytest.mark.parametrize("n_envs", [1, 3])
def test_counts_steps_and_episodes_over_all_environments(name, n_envs):
    seen = []

    class CountDones(BaseCallback):
        def _on_step(self):
            seen.append(int(self.locals["dones"].sum()))
            return True

    env = make_vec_env(env_id(name), n_envs, seed=0)
    model = make(name, env).learn(200, callback=CountDones())
    assert model.num_timesteps == -(-200 // n_envs) * n_envs
    assert len(seen) == model.num_timesteps // n_envs
    assert model._episode_num == sum(seen) > 0


@pytest.mark.parametrize("name", HAND_WRITTEN)
def test_learning_in_two_calls_is_learning_in_one(name):
    explores = "exploration_decay" in load_algorithm(name).__signature__.parameters
    constant = {"exploration_decay": "constant"} if explores else {}
    once = make(name, **constant).learn(700)
    twice = make(name, **constant).learn(400).learn(300, reset_num_timesteps=False)
    assert attributes(once) == attributes(twice)


@pytest.mark.parametrize("name", HAND_WRITTEN)
def test_zip_holds_no_pickle_and_brings_everything_back(name, tmp_path):
    model = make(name).learn(500)
    model.save(tmp_path / "agent")
    with zipfile.ZipFile(tmp_path / "agent.zip") as archive:
        text = archive.read("data").decode()
        assert ":serialized:" not in text
        json.loads(text)
        with archive.open("policy.pth") as file:
            th.load(file, weights_only=True)
    loaded = type(model).load(tmp_path / "agent.zip")
    assert attributes(loaded) == attributes(model)
    if name != "random":
        expected = model.predict(states(model), deterministic=True)[0]
        np.testing.assert_array_equal(
            loaded.predict(states(model), deterministic=True)[0], expected
        )
    ours = model.predict(states(model))[0]
    np.testing.assert_array_equal(loaded.predict(states(model))[0], ours)


@pytest.mark.parametrize("name", HAND_WRITTEN)
def test_loaded_agent_goes_on_learning(name, tmp_path):
    model = make(name).learn(500)
    model.save(tmp_path / "agent")
    env = make_vec_env(env_id(name), 2, seed=1)
    loaded = type(model).load(tmp_path / "agent", env=env)
    loaded.learn(200, reset_num_timesteps=False)
    assert loaded.num_timesteps == 700
    assert loaded.n_envs == 2


def test_a_table_of_another_agent_is_refused(tmp_path):
    make("sarsa").save(tmp_path / "agent")
    with pytest.raises(ValueError, match="does not hold a QLearning"):
        load_algorithm("qlearning").load(tmp_path / "agent")


def test_a_schedule_that_is_a_function_is_saved_as_its_value(tmp_path):
    model = make("qlearning", learning_rate=lambda progress: 0.25 * progress).learn(500)
    with pytest.warns(UserWarning, match="learning_rate is a Python function"):
        model.save(tmp_path / "agent")
    loaded = type(model).load(tmp_path / "agent")
    assert loaded.learning_rate == pytest.approx(0.0, abs=1e-3)


def test_schedules_travel_in_the_zip(tmp_path):
    model = make("qlearning", learning_rate=ExponentialSchedule(0.5, 0.1), seed=None)
    model.save(tmp_path / "agent")
    loaded = type(model).load(tmp_path / "agent")
    assert loaded.lr_schedule(0.5) == pytest.approx((0.5 * 0.1) ** 0.5)


@pytest.mark.parametrize("name", HAND_WRITTEN)
def test_parameters_can_be_read_and_set(name):
    trained, fresh = make(name).learn(500), make(name)
    fresh.set_parameters(trained.get_parameters())
    for key, value in trained.policy.state_dict().items():
        assert th.equal(fresh.policy.state_dict()[key], value)


@pytest.mark.parametrize("name", HAND_WRITTEN)
def test_set_env_begins_a_new_episode(name):
    model = make(name).learn(100)
    env = make_vec_env(env_id(name), 1, seed=5)
    model.set_env(env)
    assert model._last_obs is None
    model.learn(100, reset_num_timesteps=False)
    assert model.get_env() is env
    assert model.num_timesteps == 200


@pytest.mark.parametrize("name", HAND_WRITTEN)
def test_library_callbacks(name, tmp_path):
    stop = StopTrainingOnNoModelImprovement(max_no_improvement_evals=2, min_evals=1)
    evaluation = EvalCallback(
        Monitor(gym.make(env_id(name))),
        eval_freq=50,
        n_eval_episodes=2,
        best_model_save_path=str(tmp_path),
        log_path=str(tmp_path),
        callback_after_eval=stop,
        verbose=0,
    )
    callbacks = CallbackList(
        [evaluation, CheckpointCallback(100, str(tmp_path)), LogEveryNTimesteps(100)]
    )
    model = make(name)
    model.set_logger(configure(str(tmp_path / "log"), ["csv"]))
    model.learn(300, callback=callbacks)
    model.logger.close()
    assert (tmp_path / "best_model.zip").exists()
    assert (tmp_path / "rl_model_100_steps.zip").exists()
    assert len(np.load(tmp_path / "evaluations.npz")["timesteps"]) >= 2
    header = (tmp_path / "log" / "progress.csv").read_text().splitlines()[0]
    assert "eval/mean_reward" in header
    assert "time/total_timesteps" in header


@pytest.mark.parametrize("name", HAND_WRITTEN)
def test_stopping_callbacks(name):
    model = make(name).learn(10_000, callback=StopTrainingOnMaxEpisodes(max_episodes=3))
    assert model._episode_num == 3
    evaluation = EvalCallback(
        Monitor(gym.make(env_id(name))),
        eval_freq=10,
        n_eval_episodes=1,
        callback_on_new_best=StopTrainingOnRewardThreshold(reward_threshold=-1, verbose=0),
        verbose=0,
    )
    assert make(name).learn(10_000, callback=evaluation).num_timesteps == 10


@pytest.mark.filterwarnings("ignore::tqdm.TqdmExperimentalWarning")
@pytest.mark.parametrize("name", HAND_WRITTEN)
def test_progress_bar_and_tensorboard(name, tmp_path):
    model = make(name, tensorboard_log=str(tmp_path))
    model.learn(200, log_interval=1, progress_bar=True)
    model.logger.close()
    assert list(tmp_path.glob("*/events.out.tfevents.*"))


@pytest.mark.parametrize("name", HAND_WRITTEN)
def test_training_under_other_vec_envs(name):
    env = make_vec_env(env_id(name), 2, seed=0, vec_env_cls=SubprocVecEnv)
    parallel = make(name, env).learn(200)
    env.close()
    sequential = make(name, make_vec_env(env_id(name), 2, seed=0)).learn(200)
    assert attributes(parallel) == attributes(sequential)
    normalized = VecNormalize(make_vec_env(env_id(name), 2, seed=0), norm_obs=False)
    assert make(name, normalized).learn(200).num_timesteps == 200


@pytest.mark.parametrize("name", HAND_WRITTEN)
def test_agents_can_be_pickled(name):
    model = make(name).learn(200)
    model.env = None
    assert attributes(pickle.loads(pickle.dumps(model))) == attributes(model)


@pytest.mark.parametrize("name", HAND_WRITTEN)
def test_predict_takes_one_observation_or_many(name):
    model = make(name)
    batch = states(model)
    for deterministic in (True, False):
        many, _ = model.predict(batch, deterministic=deterministic)
        assert many.shape == (len(batch),)
        one, _ = model.predict(batch[0], deterministic=deterministic)
        assert one.shape == ()
        assert model.action_space.contains(int(one))


def test_dummy_vec_env_of_an_unmonitored_environment():
    model = make("qlearning", DummyVecEnv([lambda: gym.make("FrozenLake-v1")]))
    assert model.learn(100).num_timesteps == 100
