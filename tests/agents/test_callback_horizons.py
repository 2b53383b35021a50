"""Callbacks act at the same time steps, and see the same agent, in both engines."""

import json
import zipfile

import numpy as np
import pytest
from stable_baselines3.common.callbacks import (
    BaseCallback,
    CallbackList,
    CheckpointCallback,
    ConvertCallback,
    EvalCallback,
    EveryNTimesteps,
    LogEveryNTimesteps,
    ProgressBarCallback,
    StopTrainingOnMaxEpisodes,
    StopTrainingOnRewardThreshold,
)
from stable_baselines3.common.env_util import make_vec_env
from stable_baselines3.common.logger import configure

from agents import load_algorithm
from agents.common.callbacks import (
    NEVER,
    BlockCallback,
    EpisodeBudget,
    Horizon,
    calls_until_multiple,
    horizon,
    members,
    unknown_callbacks,
)
from pipeline.callbacks import EpisodeCheckpoint, EvaluationCallback, StepCheckpoint
from pipeline.evaluation.sampled import Evaluation
from pipeline.runs import Run

ENGINES = ("interpreted", "compiled")
VOLATILE = {"time/fps", "time/time_elapsed"}


def snapshot(model):
    """What a callback can see of the agent."""
    return {
        "steps": model.num_timesteps,
        "tables": model.policy.q_tables.numpy().tobytes(),
        "visits": model.policy.visit_counts.numpy().tobytes(),
        "generator": model.rng.bit_generator.state,
        "progress": model._current_progress_remaining,
        "rate": model.exploration_rate,
        "episodes": model._episode_num,
        "updates": model._n_updates,
        "error": model.mean_td_error,
        "observations": model._last_obs.tolist(),
        "pending actions": model._next_actions.tolist(),
        "returns": [(info["r"], info["l"]) for info in model.ep_info_buffer],
    }


class Recorder(BaseCallback):
    """Notes what it sees whenever the callback that it is part of acts."""

    def __init__(self):
        super().__init__()
        self.seen = []

    def _on_step(self):
        step = {
            name: self.locals[name].tolist() for name in ("new_obs", "actions", "dones", "rewards")
        }
        infos = [
            {
                "truncated": bool(info["TimeLimit.truncated"]),
                "terminal": info.get("terminal_observation"),
                "episode": None if "episode" not in info else info["episode"]["r"],
            }
            for info in self.locals["infos"]
        ]
        self.seen.append({**snapshot(self.model), **step, "infos": infos})
        return True


class Watcher(BlockCallback):
    """Acts on every fortieth call."""

    def __init__(self):
        super().__init__()
        self.seen = []

    def horizon(self):
        return Horizon(calls=calls_until_multiple(self.n_calls, 40))

    def _on_step(self):
        if self.n_calls % 40 == 0:
            self.seen.append((self.num_timesteps, self.locals["new_obs"].tolist()))
        return True


def every_kind(folder, evaluated):
    """One callback of every kind that the compiled engine knows."""
    env = make_vec_env("FrozenLake-v1", 1, seed=9)

    def evaluator(model):
        evaluated.append(snapshot(model))
        return Evaluation(np.array([float(len(evaluated))]), np.array([1]), None)

    run = Run.claim(folder / "logs", "sarsa", "FrozenLake-v1")
    return [
        EvalCallback(env, eval_freq=90, n_eval_episodes=2, log_path=str(folder), verbose=0),
        CheckpointCallback(110, str(folder), name_prefix="library"),
        EveryNTimesteps(70, Recorder()),
        LogEveryNTimesteps(130),
        EvaluationCallback(run, env, evaluator, 55),
        StepCheckpoint(85, folder / "steps"),
        EpisodeCheckpoint(9, folder / "episodes"),
        ProgressBarCallback(),
        CallbackList([Watcher(), StopTrainingOnMaxEpisodes(60)]),
    ]


def trained(engine, folder, n_envs):
    """Everything that happened in a training with all callbacks."""
    for name in ("steps", "episodes"):
        (folder / name).mkdir(parents=True)
    env = make_vec_env("FrozenLake-v1", n_envs, seed=0)
    model = load_algorithm("sarsa")(env=env, seed=0, engine=engine, exploration_final_eps=0.3)
    model.set_logger(configure(str(folder / "log"), ["json"]))
    evaluated = []
    callbacks = every_kind(folder, evaluated)
    model.learn(2000, callback=callbacks, log_interval=11)
    model.logger.close()
    assert model.engine_in_use.startswith(engine)
    return {
        "evaluated": evaluated,
        "recorded": callbacks[2].callback.seen,
        "watched": callbacks[-1].callbacks[0].seen,
        "evaluations": np.load(folder / "evaluations.npz")["timesteps"].tolist(),
        "results": np.load(folder / "evaluations.npz")["results"].tolist(),
        "files": {str(p.relative_to(folder)): saved(p) for p in folder.rglob("*_steps.zip")},
        "log": [
            {key: value for key, value in json.loads(line).items() if key not in VOLATILE}
            for line in (folder / "log" / "progress.json").read_text().splitlines()
        ],
        "calls": [
            (type(member).__name__, member.n_calls, member.num_timesteps)
            for callback in callbacks
            for member in members(callback)
        ],
        "bar": callbacks[-2].pbar.n,
        "steps": model.num_timesteps,
    }


def saved(path):
    """What a checkpoint holds, but for the name of the engine and the times."""
    with zipfile.ZipFile(path) as archive:
        data = json.loads(archive.read("data"))
        assert archive.read("policy.pth")
    for name in ("engine", "engine_in_use", "ep_info_buffer"):
        data.pop(name)
    return data


# The library's progress bar rests on an experimental one.
@pytest.mark.filterwarnings("ignore::tqdm.std.TqdmExperimentalWarning")
@pytest.mark.parametrize("n_envs", [1, 3])
def test_every_callback_at_the_same_steps(n_envs, tmp_path):
    interpreted, compiled = (trained(engine, tmp_path / engine, n_envs) for engine in ENGINES)
    for name, happened in interpreted.items():
        assert compiled[name] == happened, name
    # All of them did act.
    assert 300 < interpreted["steps"] < 2000 + n_envs
    for name in ("recorded", "watched", "evaluations", "evaluated", "log"):
        assert len(interpreted[name]) >= 3, name
    folders = {name.rpartition("/")[0] for name in interpreted["files"]}
    assert folders == {"", "steps", "episodes"}


# --- which callbacks are known -------------------------------------------------------------------


class Foreign(BaseCallback):
    def _on_step(self):
        return True


class LoudCheckpoint(CheckpointCallback):
    """A subclass may do anything on any step."""


def test_unknown_callbacks_are_named(tmp_path):
    env = make_vec_env("FrozenLake-v1", 1)
    known = [EveryNTimesteps(5, Foreign()), EpisodeBudget(3), ConvertCallback(None)]
    unknown = [
        Foreign(),
        LoudCheckpoint(5, str(tmp_path)),
        ConvertCallback(lambda *_: True),
        CallbackList([CallbackList([StopTrainingOnRewardThreshold(1.0)])]),
    ]
    assert unknown_callbacks(CallbackList([*known, EvalCallback(env)])) == []
    assert unknown_callbacks(CallbackList([*known, *unknown])) == [
        "Foreign",
        "LoudCheckpoint",
        "ConvertCallback",
        "StopTrainingOnRewardThreshold",
    ]


@pytest.mark.parametrize(
    ("n_calls", "frequency", "expected"),
    [(0, 5, 5), (1, 5, 4), (4, 5, 1), (5, 5, 5), (7, 1, 1), (3, 0, NEVER), (3, -1, NEVER)],
)
def test_calls_until_multiple(n_calls, frequency, expected):
    assert calls_until_multiple(n_calls, frequency) == expected


def test_the_nearest_horizon_counts(tmp_path):
    env = make_vec_env("FrozenLake-v1", 3)
    model = load_algorithm("qlearning")(env=env)
    model.num_timesteps = 30
    callbacks = {
        # Step 40 is passed on the fourth call from now, at step 42.
        "steps": EveryNTimesteps(40, Foreign()),
        "checkpoint": CheckpointCallback(7, str(tmp_path)),
        "budget": EpisodeBudget(8),
    }
    for callback in callbacks.values():
        callback.init_callback(model)
        callback.n_calls, callback.num_timesteps = 10, 30
    assert horizon(callbacks["steps"]) == Horizon(calls=4)
    assert horizon(callbacks["checkpoint"]) == Horizon(calls=4)
    callbacks["checkpoint"].n_calls = 12
    assert horizon(callbacks["budget"]) == Horizon(episodes=8)
    assert horizon(CallbackList(list(callbacks.values()))) == Horizon(calls=2, episodes=8)
    assert horizon(CallbackList([])) == Horizon(NEVER, NEVER)
