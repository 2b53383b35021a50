"""Callbacks of a run: evaluation as the library's, budgets, checkpoints, exploration."""

import csv
from functools import partial

import gymnasium as gym
import numpy as np
import pytest
import torch as th
from stable_baselines3 import DQN
from stable_baselines3.common.callbacks import (
    BaseCallback,
    CallbackList,
    EvalCallback,
    StopTrainingOnNoModelImprovement,
    StopTrainingOnRewardThreshold,
)
from stable_baselines3.common.env_util import make_vec_env
from stable_baselines3.common.logger import configure
from stable_baselines3.common.monitor import Monitor
from stable_baselines3.common.utils import LinearSchedule
from stable_baselines3.common.vec_env import VecNormalize

from agents import load_algorithm
from agents.common.callbacks import EpisodeBudget
from pipeline import callbacks as callbacks_module
from pipeline.callbacks import (
    EpisodeCheckpoint,
    EvaluationCallback,
    ExponentialExploration,
    StepCheckpoint,
)
from pipeline.evaluation.sampled import Evaluation, evaluate
from pipeline.models.find import checkpoint_file
from pipeline.runs import Run

TINY_DQN = {"buffer_size": 200, "batch_size": 4, "learning_starts": 20, "seed": 0}
TINY_DQN |= {"policy_kwargs": {"net_arch": [4]}}


def make(name, env, **kwargs):
    algorithm = load_algorithm(name)
    return algorithm(next(iter(algorithm.policy_aliases)), env, **{"seed": 0, **kwargs})


def evaluation_of(*returns, lengths=None, successes=None):
    return Evaluation(
        np.array(returns, dtype=np.float64),
        np.array(lengths or [1] * len(returns)),
        None if successes is None else np.array(successes),
    )


@pytest.fixture
def run(tmp_path):
    return Run.claim(tmp_path / "logs", "qlearning", "Warehouse-v0")


# --- evaluation ----------------------------------------------------------------------------------


# Five moves to the goal: a return of 96 at best.
SMALL_WAREHOUSE = ("envs:Warehouse-v0", {"desc": ["S...", ".##.", "...G"], "max_episode_steps": 20})
CLIFF = ("CliffWalking-v1", {"max_episode_steps": 50})


def train_with(callback, folder, env_id, env_kwargs, n_envs=1, steps=1000):
    env = make_vec_env(env_id, n_envs, seed=0, env_kwargs=env_kwargs)
    model = make("qlearning", env, learning_rate=0.5, exploration_initial_eps=0.3)
    model.set_logger(configure(str(folder), ["csv"]))
    model.learn(steps, callback=callback, log_interval=None)
    model.logger.close()
    with (folder / "progress.csv").open() as file:
        rows = list(csv.DictReader(file))
    # What the two callbacks themselves log, and when.
    names = [name for name in rows[0] if name.startswith("eval/")] + ["time/total_timesteps"]
    return model, [{name: row[name] for name in names} for row in rows]


def library_callback(env, folder, **kwargs):
    return EvalCallback(
        env,
        n_eval_episodes=3,
        log_path=str(folder),
        best_model_save_path=str(folder),
        verbose=0,
        **kwargs,
    )


def own_callback(env, run, **kwargs):
    return EvaluationCallback(run, env, partial(evaluate, env=env, n_episodes=3, seed=99), **kwargs)


@pytest.mark.parametrize(
    ("world", "n_envs", "steps", "says_success"),
    [(SMALL_WAREHOUSE, 3, 500, True), (CLIFF, 1, 6000, False)],
    ids=["Warehouse", "CliffWalking"],
)
def test_evaluations_are_written_as_the_library_writes_them(
    run, tmp_path, n_envs, world, steps, says_success
):
    """Nothing is random in these environments, so that both see the same episodes."""

    def eval_env():
        return make_vec_env(world[0], 1, env_kwargs=world[1])

    freq = steps // n_envs // 15
    library = library_callback(eval_env(), tmp_path / "library", eval_freq=freq)
    _, expected_log = train_with(library, tmp_path / "library", *world, n_envs, steps)
    own = own_callback(eval_env(), run, eval_freq=freq)
    model, log = train_with(own, tmp_path / "own", *world, n_envs, steps)

    expected = np.load(tmp_path / "library" / "evaluations.npz")
    written = np.load(run.evaluations_path)
    assert written.files == expected.files
    assert ("successes" in written.files) == says_success
    for name in expected.files:
        assert written[name].dtype == expected[name].dtype
        np.testing.assert_array_equal(written[name], expected[name])
    # There was something to tell apart.
    assert len(np.unique(expected["results"])) > 1
    assert own.best_mean_reward == library.best_mean_reward
    assert own.last_mean_reward == library.last_mean_reward
    assert log == expected_log

    best = type(model).load(run.best_model_path)
    expected_best = type(model).load(tmp_path / "library" / "best_model.zip")
    assert th.equal(best.policy.q_tables, expected_best.policy.q_tables)
    assert best.num_timesteps == expected_best.num_timesteps == own.best_timesteps
    means = expected["results"].mean(axis=1)
    assert own.best_timesteps == expected["timesteps"][means.argmax()]


@pytest.mark.parametrize(
    "stop",
    [
        lambda: StopTrainingOnNoModelImprovement(max_no_improvement_evals=3, min_evals=2),
        lambda: StopTrainingOnRewardThreshold(reward_threshold=96, verbose=0),
    ],
    ids=["no improvement", "threshold"],
)
def test_stop_conditions_act_as_in_the_library(run, tmp_path, stop):
    def eval_env():
        return make_vec_env(SMALL_WAREHOUSE[0], 1, env_kwargs=SMALL_WAREHOUSE[1])

    own = own_callback(eval_env(), run, eval_freq=20, callback_after_eval=stop())
    model, _ = train_with(own, tmp_path / "own", *SMALL_WAREHOUSE, steps=20_000)
    library = library_callback(
        eval_env(), tmp_path / "library", eval_freq=20, callback_after_eval=stop()
    )
    expected, _ = train_with(library, tmp_path / "library", *SMALL_WAREHOUSE, steps=20_000)
    assert model.num_timesteps == expected.num_timesteps
    assert 20 < model.num_timesteps < 20_000


def scripted(run, evaluations, eval_freq=10, **kwargs):
    """An evaluation callback that is told what comes out."""
    outcomes = iter(evaluations)
    env = make_vec_env("FrozenLake-v1", 1)
    return EvaluationCallback(run, env, lambda model: next(outcomes), eval_freq, **kwargs)


def test_the_best_model_is_the_first_of_the_best(run):
    returns = [0.1, 0.5, 0.5, 0.2, 0.4]
    callback = scripted(run, [evaluation_of(r, r) for r in returns])
    model = make("qlearning", "FrozenLake-v1").learn(50, callback=callback)
    assert callback.best_timesteps == 20
    assert callback.best_mean_reward == 0.5
    assert callback.last_evaluation.mean_return == callback.last_mean_reward == 0.4
    assert type(model).load(run.best_model_path).num_timesteps == 20
    assert np.load(run.evaluations_path)["timesteps"].tolist() == [10, 20, 30, 40, 50]


@pytest.mark.parametrize(("pause", "left"), [(0.0, [1, 2]), (1e9, [1, 1])])
def test_files_are_there_soon_after_each_evaluation(run, monkeypatch, pause, left):
    """A run that is killed leaves what it has found until then, or until a second before."""
    monkeypatch.setattr(callbacks_module, "SECONDS_BETWEEN_WRITES", pause)
    seen = []

    class Look(BaseCallback):
        def _on_step(self):
            path = run.evaluations_path
            seen.append(len(np.load(path)["timesteps"]) if path.exists() else 0)
            return True

    evaluations = [
        evaluation_of(1, 3, lengths=[4, 5], successes=[True, False]),
        evaluation_of(0, 1, lengths=[6, 7], successes=[True, True]),
    ]
    callbacks = CallbackList([scripted(run, evaluations), Look()])
    make("qlearning", "FrozenLake-v1").learn(20, callback=callbacks)
    assert seen == [0] * 9 + [left[0]] * 10 + [left[1]]
    written = np.load(run.evaluations_path)
    assert written["results"].tolist() == [[1, 3], [0, 1]]
    assert written["ep_lengths"].tolist() == [[4, 5], [6, 7]]
    assert written["successes"].tolist() == [[True, False], [True, True]]
    assert sorted(path.name for path in run.path.iterdir()) == [
        "Warehouse-v0",
        "best_model.zip",
        "evaluations.npz",
        "run.json",
    ]


def test_no_evaluation_but_those_asked_for(run):
    callback = scripted(run, [evaluation_of(2.0)], eval_freq=0)
    make("qlearning", "FrozenLake-v1").learn(50, callback=callback)
    assert callback.last_evaluation is None
    assert not run.evaluations_path.exists()
    assert callback.evaluate_now() is True
    assert callback.last_evaluation.mean_return == 2.0
    assert np.load(run.evaluations_path)["timesteps"].tolist() == [50]


def test_evaluation_sees_the_normalisation_of_training(run):
    env = VecNormalize(make_vec_env("CartPole-v1", 1, seed=0), norm_reward=False)
    eval_env = VecNormalize(make_vec_env("CartPole-v1", 1), training=False, norm_reward=False)
    seen = []

    def evaluator(model):
        seen.append(eval_env.obs_rms.mean.copy())
        return evaluation_of(len(seen))

    callback = EvaluationCallback(run, eval_env, evaluator, 25)
    make("random", env).learn(50, callback=callback)
    assert not np.array_equal(*seen)
    np.testing.assert_array_equal(seen[1], env.obs_rms.mean)
    # The statistics belong to the best model, and lie where they are looked for.
    loaded = VecNormalize.load(
        str(checkpoint_file(run.best_model_path, "vecnormalize")), make_vec_env("CartPole-v1", 1)
    )
    np.testing.assert_array_equal(loaded.obs_rms.mean, seen[1])


# --- budgets -------------------------------------------------------------------------------------


class Record(BaseCallback):
    """Notes at each step the progress, and how many episodes had ended before it."""

    def __init__(self):
        super().__init__()
        self.progress = []
        self.ended = [0]

    def _on_step(self):
        self.progress.append(self.model._current_progress_remaining)
        self.ended.append(self.ended[-1] + int(np.sum(self.locals["dones"])))
        return True


@pytest.mark.parametrize(("name", "n_envs"), [("qlearning", 1), ("sarsa", 3), ("dqn", 3)])
def test_an_episode_budget_ends_training_and_drives_the_schedules(name, n_envs):
    n_episodes = 20
    kwargs = TINY_DQN if name == "dqn" else {}
    model = make(name, make_vec_env("FrozenLake-v1", n_envs, seed=0), **kwargs)
    record = Record()
    model.learn(10**12, callback=CallbackList([record, EpisodeBudget(n_episodes)]))
    # It ends with the step in which the last episode does, whatever else ends in the same step.
    assert record.ended[-2] < n_episodes <= record.ended[-1]
    assert model.num_timesteps == n_envs * len(record.progress)
    for step, progress in enumerate(record.progress):
        assert progress == pytest.approx(1 - record.ended[step] / n_episodes, abs=1e-9)


# --- checkpoints ---------------------------------------------------------------------------------


def checkpoint_steps(folder):
    names = [path.name for path in folder.glob("*")]
    assert all(name.startswith("rl_model_") and name.endswith("_steps.zip") for name in names)
    return sorted(int(name.split("_")[2]) for name in names)


@pytest.mark.parametrize(
    ("n_envs", "every", "steps"),
    [
        (1, 50, [50, 100, 150, 200]),
        (1, 70, [70, 140]),
        # The first step at or after each multiple.
        (3, 50, [51, 102, 150, 201]),
        (3, 60, [60, 120, 180]),
        (3, 2, list(range(3, 202, 3))),
        (1, 500, []),
    ],
)
def test_checkpoints_by_steps(tmp_path, n_envs, every, steps):
    model = make("qlearning", make_vec_env("FrozenLake-v1", n_envs, seed=0))
    model.learn(200, callback=StepCheckpoint(every, tmp_path))
    assert checkpoint_steps(tmp_path) == steps
    for n in steps[:2]:
        loaded = type(model).load(tmp_path / f"rl_model_{n}_steps.zip")
        assert loaded.num_timesteps == n


@pytest.mark.parametrize(("n_envs", "every"), [(1, 1), (3, 4)])
def test_checkpoints_by_episodes(tmp_path, n_envs, every):
    model = make("qlearning", make_vec_env("FrozenLake-v1", n_envs, seed=0))
    record = Record()
    model.learn(300, callback=CallbackList([record, EpisodeCheckpoint(every, tmp_path)]))
    counts = np.array(record.ended) // every
    expected = n_envs * np.flatnonzero(np.diff(counts)) + n_envs
    assert checkpoint_steps(tmp_path) == expected.tolist()
    assert len(expected) > 3


@pytest.mark.parametrize("n_envs", [1, 3])
def test_checkpoints_and_budgets_need_no_asking_after_each_step(tmp_path, n_envs):
    """A callback that has to be asked at each step changes nothing but the speed."""
    found = []
    for name, others in {"asked": [Record()], "unasked": []}.items():
        (tmp_path / name).mkdir()
        checkpoints = StepCheckpoint(70, tmp_path / name), EpisodeCheckpoint(4, tmp_path / name)
        env = make_vec_env("FrozenLake-v1", n_envs, seed=0)
        model = make("qlearning", env, learning_rate=LinearSchedule(0.5, 0.1, 1.0))
        callbacks = CallbackList([*others, *checkpoints, EpisodeBudget(60)])
        model.learn(10**12, callback=callbacks)
        steps = checkpoint_steps(tmp_path / name)
        saved = [type(model).load(tmp_path / name / f"rl_model_{n}_steps.zip") for n in steps]
        tables = [each.policy.q_tables.numpy().tobytes() for each in (*saved, model)]
        found.append((steps, tables, model.num_timesteps, model._current_progress_remaining))
    assert len(found[0][0]) > 5
    assert found[0] == found[1]


@pytest.mark.parametrize("number", [0, -1])
def test_a_checkpoint_every_nothing_is_refused(tmp_path, number):
    with pytest.raises(ValueError, match=f"every_n_steps must be at least 1, not {number}"):
        StepCheckpoint(number, tmp_path)
    with pytest.raises(ValueError, match=f"every_n_episodes must be at least 1, not {number}"):
        EpisodeCheckpoint(number, tmp_path)


# --- exploration ---------------------------------------------------------------------------------


@pytest.mark.parametrize(("train_freq", "gradient_steps"), [(1, 1), (4, 2)])
def test_epsilon_falls_with_each_update(train_freq, gradient_steps):
    seen = []

    class Look(BaseCallback):
        def _on_step(self):
            seen.append((self.model._n_updates, self.model.exploration_rate))
            return True

    exploration = ExponentialExploration(initial_eps=0.9, final_eps=0.2, decay=0.97)
    model = DQN(
        "MlpPolicy",
        Monitor(gym.make("FrozenLake-v1")),
        train_freq=train_freq,
        gradient_steps=gradient_steps,
        **TINY_DQN,
    )
    model.learn(150, callback=CallbackList([exploration, Look()]))
    assert len(seen) == model.num_timesteps
    # Nothing is learnt in the first 20 steps, and it takes 50 updates to come down to the floor.
    assert seen[19] == (0, 0.9)
    assert seen[-1][0] >= 50
    for n_updates, epsilon in seen:
        assert epsilon == max(0.2, 0.9 * 0.97**n_updates)
    assert {epsilon for _, epsilon in seen} >= {0.9, 0.2}


@pytest.mark.parametrize("name", ["initial_eps", "final_eps", "decay"])
@pytest.mark.parametrize("value", [-0.1, 1.1, float("nan")])
def test_exploration_out_of_range_is_refused(name, value):
    with pytest.raises(ValueError, match=f"{name} must lie between 0 and 1, not {value}"):
        ExponentialExploration(**{name: value})
