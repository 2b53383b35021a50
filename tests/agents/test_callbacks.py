"""Callbacks and logs beside compiled trainings: the same steps, agents and records."""

import csv
import json
import zipfile

import numpy as np
import pytest
from stable_baselines3 import DQN
from stable_baselines3.common.callbacks import (
    BaseCallback,
    CallbackList,
    CheckpointCallback,
    EvalCallback,
    EveryNTimesteps,
    LogEveryNTimesteps,
    ProgressBarCallback,
    StopTrainingOnMaxEpisodes,
)
from stable_baselines3.common.logger import configure

from rl_yardstick.agents.common.callbacks import (
    BlockCallback,
    Horizon,
    calls_until_multiple,
    members,
)
from rl_yardstick.pipeline.callbacks import EpisodeCheckpoint, EvaluationCallback, StepCheckpoint
from rl_yardstick.pipeline.evaluation.sampled import Evaluation
from rl_yardstick.pipeline.runs import Run
from tests.agents.trainings import LAKE, environment, make, state_of

ENGINES = ("interpreted", "compiled")
OF_THE_CLOCK = {"time/fps", "time/time_elapsed"}


def without_clock(record):
    return {key: value for key, value in record.items() if key not in OF_THE_CLOCK}


def lake(engine="compiled", n_envs=1, name="qlearning", **kwargs):
    return make(name, environment(LAKE, n_envs, seed=0), seed=0, engine=engine, **kwargs)


# --- every callback ------------------------------------------------------------------------------


def snapshot(model):
    """What a callback can see of the agent; environments are behind where nobody looks at them."""
    return {key: value for key, value in state_of(model).items() if " of " not in key}


class Recorder(BaseCallback):
    """Notes what it sees whenever the callback that it is part of acts."""

    def __init__(self):
        super().__init__()
        self.seen = []

    def _on_step(self):
        names = ("new_obs", "actions", "dones", "rewards")
        step = {name: self.locals[name].tolist() for name in names}
        infos = [
            (bool(info["TimeLimit.truncated"]), info.get("terminal_observation"),
             info.get("episode", {}).get("r"))
            for info in self.locals["infos"]
        ]  # fmt: skip
        self.seen.append({**snapshot(self.model), **step, "infos": infos})
        return True


class Watcher(BlockCallback):
    """Acts on every fortieth call; records something, and reads what is there."""

    def __init__(self):
        super().__init__()
        self.seen = []

    def horizon(self):
        return Horizon(calls=calls_until_multiple(self.n_calls, 40))

    def _on_step(self):
        if self.n_calls % 40 == 0:
            there = dict(self.logger.name_to_value)
            self.seen.append((self.num_timesteps, self.locals["new_obs"].tolist(), there))
            self.logger.record("mine", self.n_calls)
            self.logger.record_mean("mean", self.n_calls)
        return True


def every_kind(folder, evaluated):
    """One callback of every kind that the compiled engine knows."""
    env = environment(LAKE, 1, seed=9)

    def evaluator(model):
        evaluated.append(snapshot(model))
        return Evaluation(np.array([float(len(evaluated))]), np.array([1]), None)

    run = Run.claim(folder / "logs", "sarsa", LAKE)
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


def saved(path):
    """What a checkpoint holds, but for the name of the engine and the times."""
    with zipfile.ZipFile(path) as archive:
        data = json.loads(archive.read("data"))
        assert archive.read("policy.pth")
    for name in ("engine", "engine_in_use", "ep_info_buffer"):
        data.pop(name)
    return data


def trained(engine, folder):
    """Everything that happened in a training with all callbacks."""
    for name in ("steps", "episodes"):
        (folder / name).mkdir(parents=True)
    model, evaluated = lake(engine, 3, "sarsa", exploration_final_eps=0.3), []
    model.set_logger(configure(str(folder / "log"), ["json"]))
    callbacks = every_kind(folder, evaluated)
    model.learn(2000, callback=callbacks, log_interval=11)
    model.logger.close()
    assert model.engine_in_use.startswith(engine)
    evaluations = np.load(folder / "evaluations.npz")
    lines = (folder / "log" / "progress.json").read_text().splitlines()
    everyone = [member for callback in callbacks for member in members(callback)]
    return {
        "evaluated": evaluated,
        "recorded": callbacks[2].callback.seen,
        "watched": callbacks[-1].callbacks[0].seen,
        "evaluations": evaluations["timesteps"].tolist(),
        "results": evaluations["results"].tolist(),
        "files": {str(p.relative_to(folder)): saved(p) for p in folder.rglob("*_steps.zip")},
        "log": [without_clock(json.loads(line)) for line in lines],
        "calls": [(type(each).__name__, each.n_calls, each.num_timesteps) for each in everyone],
        "bar": callbacks[-2].pbar.n,
        "steps": model.num_timesteps,
    }


# The library's progress bar rests on an experimental one.
@pytest.mark.filterwarnings("ignore::tqdm.std.TqdmExperimentalWarning")
def test_every_callback_at_the_same_steps(tmp_path):
    interpreted, compiled = (trained(engine, tmp_path / engine) for engine in ENGINES)
    for name, happened in interpreted.items():
        assert compiled[name] == happened, name
    # All of them did act.
    assert 300 < interpreted["steps"] < 2000
    for name in ("recorded", "watched", "evaluations", "evaluated", "log"):
        assert len(interpreted[name]) >= 3, name
    folders = {name.rpartition("/")[0] for name in interpreted["files"]}
    assert folders == {"", "steps", "episodes"}


# --- when callbacks act --------------------------------------------------------------------------


class Sparse(BlockCallback):
    def __init__(self, every, answers=()):
        super().__init__()
        self.every_n_steps = every
        self.answers, self.seen = list(answers), []

    def _on_step(self):
        self.seen.append(self.num_timesteps)
        return self.answers.pop(0) if self.answers else True


def test_a_sparse_callback_can_stop_the_training():
    for engine in ENGINES:
        model = lake(engine).learn(2_000, callback=Sparse(100, [True, True, False]))
        assert model.num_timesteps == 300
    with pytest.raises(ValueError, match=r"Sparse.every_n_steps must be a number from 1 on"):
        lake().learn(10, callback=Sparse(0))
    # Algorithms of the library ask at these steps too.
    callback = Sparse(20)
    DQN("MlpPolicy", "CartPole-v1", learning_starts=1000).learn(70, callback=callback)
    assert callback.seen == [20, 40, 60]


# --- logs ----------------------------------------------------------------------------------------


LOGGED = {  # agent, how many environments, and settings
    "a window": ("sarsa", 2, {"stats_window_size": 5}),
    "noise": ("qlearning", 1, {"exploration": "gaussian_noise", "noise_std": 3.0}),
    "gradients": ("reinforce", 1, {}),
}


@pytest.mark.parametrize("case", LOGGED)
def test_logs_of_both_engines_are_the_same(case, tmp_path):
    name, n_envs, settings = LOGGED[case]
    found = []
    for engine in ENGINES:
        model = lake(engine, n_envs, name, **settings)
        model.set_logger(configure(str(tmp_path / engine), ["csv"]))
        model.learn(2000, log_interval=5)
        model.learn(500, log_interval=5, reset_num_timesteps=False)
        assert model.engine_in_use.startswith(engine)
        model.logger.close()
        with (tmp_path / engine / "progress.csv").open() as file:
            found.append([without_clock(row) for row in csv.DictReader(file)])
    assert found[0] == found[1]
    assert len(found[0]) >= 2
