"""A training: its callbacks, what settings do to it, what it leaves, and bandits."""

import csv
import io
from functools import partial

import gymnasium as gym
import numpy as np
import pytest
import torch as th
from rich.console import Console
from stable_baselines3 import DQN
from stable_baselines3.common.callbacks import (
    BaseCallback,
    CallbackList,
    EvalCallback,
)
from stable_baselines3.common.env_util import make_vec_env
from stable_baselines3.common.logger import configure
from stable_baselines3.common.monitor import Monitor
from stable_baselines3.common.vec_env import VecNormalize

from rl_yardstick.agents.common.callbacks import EpisodeBudget
from rl_yardstick.commands.train import describe_pulls, print_outcome
from rl_yardstick.envs.bandits import log_uniformly
from rl_yardstick.pipeline.callbacks import (
    EpisodeCheckpoint,
    EvaluationCallback,
    ExponentialExploration,
    PullSummary,
    StepCheckpoint,
    summarise_pulls,
)
from rl_yardstick.pipeline.evaluation.sampled import Evaluation, evaluate
from rl_yardstick.pipeline.models.find import checkpoint_file
from rl_yardstick.pipeline.runs import PULLS_FILE, Run
from rl_yardstick.pipeline.training import carry_out, prepare, train
from rl_yardstick.pipeline.unfinished_runs import run_of_spec
from tests.pipeline.short_runs import CART, LAKE, agent_of, spec_of

TINY_DQN = {"buffer_size": 200, "batch_size": 4, "learning_starts": 20}
TINY_DQN |= {"policy_kwargs": {"net_arch": [4]}}


def evaluation_of(mean_return):
    return Evaluation(np.array([float(mean_return)]), np.array([1]), None)


@pytest.fixture
def run(tmp_path):
    return Run.claim(tmp_path / "logs", "qlearning", "Warehouse-v0")


# --- evaluation in training ----------------------------------------------------------------------

# Five moves to the goal: a return of 96 at best.
SMALL_WAREHOUSE = ("envs:Warehouse-v0", {"desc": ["S...", ".##.", "...G"], "max_episode_steps": 20})


def train_with(callback, folder, env_id, env_kwargs, n_envs=1, steps=1000):
    env = make_vec_env(env_id, n_envs, seed=0, env_kwargs=env_kwargs)
    model = agent_of("qlearning", env, learning_rate=0.5, exploration_initial_eps=0.3)
    model.set_logger(configure(str(folder), ["csv"]))
    model.learn(steps, callback=callback, log_interval=None)
    model.logger.close()
    with (folder / "progress.csv").open() as file:
        rows = list(csv.DictReader(file))
    # What the two callbacks themselves log, and when.
    names = [name for name in rows[0] if name.startswith("eval/")] + ["time/total_timesteps"]
    return model, [{name: row[name] for name in names} for row in rows]


def both_callbacks(run, folder, env_id, env_kwargs, eval_freq):
    """Ours and the library's, which see the same episodes: nothing is random there."""
    env, other = (make_vec_env(env_id, 1, env_kwargs=env_kwargs) for _ in range(2))
    play = partial(evaluate, env=env, n_episodes=3, seed=99)
    paths = {"log_path": str(folder), "best_model_save_path": str(folder)}
    library = EvalCallback(other, n_eval_episodes=3, verbose=0, eval_freq=eval_freq, **paths)
    return EvaluationCallback(run, env, play, eval_freq=eval_freq), library


def test_evaluations_are_written_as_the_library_writes_them(run, tmp_path):
    world, n_envs, steps = SMALL_WAREHOUSE, 3, 500
    freq = steps // n_envs // 15
    own, library = both_callbacks(run, tmp_path / "library", *world, eval_freq=freq)
    _, expected_log = train_with(library, tmp_path / "library", *world, n_envs, steps)
    model, log = train_with(own, tmp_path / "own", *world, n_envs, steps)
    expected = np.load(tmp_path / "library" / "evaluations.npz")
    written = np.load(run.evaluations_path)
    assert written.files == expected.files
    assert "successes" in written.files
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


def test_evaluation_sees_the_normalisation_of_training(run):
    env = VecNormalize(make_vec_env(CART, 1, seed=0), norm_reward=False)
    eval_env = VecNormalize(make_vec_env(CART, 1), training=False, norm_reward=False)
    seen = []

    def evaluator(model):
        seen.append(eval_env.obs_rms.mean.copy())
        return evaluation_of(len(seen))

    callback = EvaluationCallback(run, eval_env, evaluator, 25)
    agent_of("random", env).learn(50, callback=callback)
    assert not np.array_equal(*seen)
    np.testing.assert_array_equal(seen[1], env.obs_rms.mean)
    # The statistics belong to the best model, and lie where they are looked for.
    path = checkpoint_file(run.best_model_path, "vecnormalize")
    loaded = VecNormalize.load(str(path), make_vec_env(CART, 1))
    np.testing.assert_array_equal(loaded.obs_rms.mean, seen[1])


# --- budgets, checkpoints, exploration -----------------------------------------------------------


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


@pytest.mark.parametrize(("name", "n_envs"), [("qlearning", 1), ("dqn", 3)])
def test_an_episode_budget_ends_training_and_drives_the_schedules(name, n_envs):
    n_episodes = 20
    kwargs = TINY_DQN if name == "dqn" else {}
    model = agent_of(name, make_vec_env(LAKE, n_envs, seed=0), **kwargs)
    record = Record()
    model.learn(10**12, callback=CallbackList([record, EpisodeBudget(n_episodes)]))
    # It ends with the step in which the last episode does, whatever else ends in the same step.
    assert record.ended[-2] < n_episodes <= record.ended[-1]
    assert model.num_timesteps == n_envs * len(record.progress)
    for step, progress in enumerate(record.progress):
        assert progress == pytest.approx(1 - record.ended[step] / n_episodes, abs=1e-9)


def checkpoint_steps(folder):
    names = [path.name for path in folder.glob("*")]
    assert all(name.startswith("rl_model_") and name.endswith("_steps.zip") for name in names)
    return sorted(int(name.split("_")[2]) for name in names)


def test_checkpoints_by_steps_and_by_episodes(tmp_path):
    for n_envs, every, steps in ((1, 70, [70, 140]), (3, 50, [51, 102, 150, 201]), (1, 500, [])):
        folder = tmp_path / f"steps {every}"  # the first step at or after each multiple
        folder.mkdir()
        model = agent_of("qlearning", make_vec_env(LAKE, n_envs, seed=0))
        model.learn(200, callback=StepCheckpoint(every, folder))
        assert checkpoint_steps(folder) == steps
    loaded = type(model).load(tmp_path / "steps 50" / "rl_model_102_steps.zip")
    assert loaded.num_timesteps == 102
    for n_envs, every in ((1, 1), (3, 4)):
        folder, record = tmp_path / f"episodes {every}", Record()
        folder.mkdir()
        model = agent_of("qlearning", make_vec_env(LAKE, n_envs, seed=0))
        model.learn(300, callback=CallbackList([record, EpisodeCheckpoint(every, folder)]))
        expected = n_envs * np.flatnonzero(np.diff(np.array(record.ended) // every)) + n_envs
        assert checkpoint_steps(folder) == expected.tolist()
        assert len(expected) > 3


def test_epsilon_falls_with_each_update():
    seen = []

    class Look(BaseCallback):
        def _on_step(self):
            seen.append((self.model._n_updates, self.model.exploration_rate))
            return True

    exploration = ExponentialExploration(initial_eps=0.9, final_eps=0.2, decay=0.97)
    rhythm = {"train_freq": 4, "gradient_steps": 2, "seed": 0}
    model = DQN("MlpPolicy", Monitor(gym.make(LAKE)), **rhythm, **TINY_DQN)
    model.learn(150, callback=CallbackList([exploration, Look()]))
    assert len(seen) == model.num_timesteps
    # Nothing is learnt in the first 20 steps, and it takes 50 updates to come down to the floor.
    assert seen[19] == (0, 0.9)
    assert seen[-1][0] >= 50
    for n_updates, epsilon in seen:
        assert epsilon == max(0.2, 0.9 * 0.97**n_updates)


# --- how it ends ---------------------------------------------------------------------------------


def test_a_run_that_is_stopped_once_more_while_it_ends_can_be_gone_on_with(tmp_path):
    def stop(outcome):
        raise KeyboardInterrupt

    training = prepare(spec_of("qlearning", log_folder=tmp_path), Console(quiet=True), {}, "")
    with pytest.raises(KeyboardInterrupt):
        carry_out(training, stop)
    assert training.run.read_info()["state"] == "interrupted"
    assert run_of_spec(training.spec, any_seed=False).path == training.run.path


# --- settings of the libraries -------------------------------------------------------------------


# --- bandits: judged by regret, drawn by pull, kept when interrupted -----------------------------


def train_on(folder, algo, env_id, **settings):
    """The outcome, its pulls, the names of its files and what is printed of it."""
    fields = {"log_folder": folder, "pictures": True, "verbose": 1}
    spec = spec_of(algo, env_id, settings, n_timesteps=300, **fields)
    console = Console(width=160, file=io.StringIO())
    outcome = train(spec, console, {}, "train.py")
    print_outcome(console, outcome)
    path = outcome.run.path
    pulls = dict(np.load(path / PULLS_FILE)) if (path / PULLS_FILE).exists() else None
    return outcome, pulls, {file.name for file in path.iterdir()}, console.file.getvalue()


def test_regret_is_the_judgement_where_arms_are_drawn_anew(tmp_path):
    outcome, pulls, names, text = train_on(tmp_path, "linucb", "LinearBandit-v0")
    regret = float(pulls["regrets"].sum())
    info = outcome.run.read_info()
    assert outcome.pulls.regret == info["regret"] == regret > 0
    assert (outcome.final, outcome.best_return, info["pulls"]["n_pulls"]) == (None, None, 300)
    assert {"pulls.npz", "pulls.png", "run.json"} <= names
    assert not names & {"evaluations.npz", "learning_curve.png", "best_model.zip"}
    assert f"regret {regret:,.2f} over 300 pulls   best arm in" in text


def test_a_log_knows_no_regret(tmp_path):
    log_uniformly(gym.make("SegmentBandit-v0"), 300, 0, tmp_path / "log.csv")
    kwargs = {"log": str(tmp_path / "log.csv")}
    outcome, pulls, names, text = train_on(tmp_path, "ucb", "ReplayBandit-v0", env_kwargs=kwargs)
    matched = int(pulls["matched"].sum())
    assert 60 < matched < 140
    assert (outcome.pulls.regret, outcome.pulls.optimal, outcome.final) == (None, None, None)
    assert outcome.pulls.reward == pytest.approx(pulls["rewards"].sum() / matched)
    assert f"over the {matched} of 300 that are in the log" in text
    assert "pulls.png" in names


def test_pulls_summed_up_by_hand():
    pulls = {
        "rewards": np.array([[1.0, 0.0, 1.0, 0.0]], dtype=np.float32),
        "regrets": np.array([[0.0, 0.5, 0.25, 0.0]]),
        "matched": np.ones((1, 4), dtype=bool),
        "optimal": np.array([[True, False, False, True]]),
    }
    found = summarise_pulls(pulls)
    assert found == PullSummary(n_pulls=4, n_matched=4, reward=0.5, regret=0.75, optimal=0.5)
    assert describe_pulls(found) == "regret 0.75 over 4 pulls   best arm in 50 % of the last 4"
    unknown = pulls | {"regrets": np.full((1, 4), np.nan), "matched": np.zeros((1, 4), dtype=bool)}
    found = summarise_pulls(unknown)
    assert (found.reward, found.regret, found.optimal) == (None, None, None)
    assert describe_pulls(found) == "regret not known: none of 4 pulls is in the log"
