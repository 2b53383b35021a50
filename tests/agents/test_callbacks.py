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

from agents.common.callbacks import BlockCallback, Horizon, calls_until_multiple, members
from pipeline.callbacks import EpisodeCheckpoint, EvaluationCallback, StepCheckpoint
from pipeline.evaluation.sampled import Evaluation
from pipeline.runs import Run
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
        table = getattr(self.model.policy, "q_table", np.zeros(1))
        self.seen.append((self.num_timesteps, self.n_calls, float(np.sum(table))))
        return self.answers.pop(0) if self.answers else True


def both(n_envs, make):
    """What a sparse callback saw, in either engine, also where others act in between."""
    seen = {}
    for engine in ENGINES:
        callback, model = make(), lake(engine, n_envs)
        model.learn(2_000, callback=callback)
        model.learn(333, callback=callback, reset_num_timesteps=False)
        assert model.engine_in_use.startswith(engine)
        sparse = callback.callbacks[0] if isinstance(callback, CallbackList) else callback
        seen[engine] = sparse.seen
    assert seen["compiled"] == seen["interpreted"]
    return seen["compiled"]


@pytest.mark.parametrize(("n_envs", "every"), [(3, 70), (8, 3)])
def test_sparse_callbacks_are_asked_at_their_steps_and_no_others(n_envs, every):
    seen = both(n_envs, lambda: Sparse(every))
    steps = [step for step, _, _ in seen]
    last = 2 * n_envs * -(-2_000 // n_envs)
    due = dict.fromkeys(n_envs * -(-due // n_envs) for due in range(every, last, every))
    assert steps == [*due][: len(steps)]
    assert len(steps) >= 2_333 // max(every, n_envs)
    assert [calls for _, calls, _ in seen] == [step // n_envs for step in steps]
    others = [EveryNTimesteps(13, Sparse(1)), StopTrainingOnMaxEpisodes(10**6)]
    assert both(n_envs, lambda: CallbackList([Sparse(every), *others])) == seen


def test_a_sparse_callback_can_stop_the_training():
    for engine in ENGINES:
        model = lake(engine).learn(2_000, callback=Sparse(100, [True, True, False]))
        assert model.num_timesteps == 300
    for every in (0, -5, 2.5, "10"):
        with pytest.raises(ValueError, match=r"Sparse.every_n_steps must be a number from 1 on"):
            lake().learn(10, callback=Sparse(every))
    # Algorithms of the library ask at these steps too.
    callback = Sparse(20)
    DQN("MlpPolicy", "CartPole-v1", learning_starts=1000).learn(70, callback=callback)
    assert [step for step, _, _ in callback.seen] == [20, 40, 60]


# --- logs ----------------------------------------------------------------------------------------


class Own(Sparse):
    """Records something of its own now and then, which goes into the next record alone."""

    def _on_step(self):
        self.logger.record("mine", self.num_timesteps)
        self.logger.record_mean("mean", self.n_calls)
        self.logger.record("text", "said", exclude="tensorboard")
        return True


def beside():
    """What dumps the logger by itself."""
    evaluation = EvalCallback(environment(LAKE, 1, seed=9), eval_freq=701, verbose=0)
    return [evaluation, LogEveryNTimesteps(1111), Own(130)]


def events_in(folder):
    from tensorboard.backend.event_processing.event_accumulator import EventAccumulator

    found = EventAccumulator(str(folder), size_guidance={"scalars": 0}).Reload()
    tags = set(found.Tags()["scalars"]) - OF_THE_CLOCK
    return {tag: [(event.step, event.value) for event in found.Scalars(tag)] for tag in tags}


LOGGED = {  # agent, environment, how many, episodes between two records, callbacks, settings
    "callbacks": ("qlearning", LAKE, 1, 7, beside, {}),
    "a window": ("sarsa", LAKE, 2, 3, list, {"stats_window_size": 5}),
    "noise": ("qlearning", LAKE, 1, 5, list, {"exploration": "gaussian_noise", "noise_std": 3.0}),
    "gradients": ("reinforce", LAKE, 1, 5, list, {}),
}


def logs(case, engine, folder):
    """All that the logger's outputs have written of two trainings, one after the other."""
    algo, env_id, n_envs, log_interval, callbacks, settings = LOGGED[case]
    model = make(algo, environment(env_id, n_envs), engine=engine, **settings)
    model.set_logger(configure(str(folder), ["tensorboard", "csv", "json", "log"]))
    model.learn(2000, callbacks(), log_interval)
    model.learn(500, callbacks(), log_interval, reset_num_timesteps=False)
    assert model.engine_in_use.startswith(engine)
    model.logger.close()
    with (folder / "progress.csv").open() as file:
        rows = [without_clock(row) for row in csv.DictReader(file)]
    lines = (folder / "progress.json").read_text().splitlines()
    shown = [line.split() for line in (folder / "log.txt").read_text().splitlines()]
    text = [words for words in shown if words[0] == "|" and words[1] not in ("fps", "time_elapsed")]
    return events_in(folder), rows, [without_clock(json.loads(line)) for line in lines], text


@pytest.mark.parametrize("case", LOGGED)
def test_each_output_has_the_same_records(case, tmp_path):
    interpreted, compiled = (logs(case, engine, tmp_path / engine) for engine in ENGINES)
    np.testing.assert_equal(compiled, interpreted)
    assert len(compiled[1]) >= 2
    assert len(compiled[0]["rollout/ep_rew_mean"]) >= 2


class Blocks(BlockCallback):
    """Counts the blocks that it is told of."""

    every_n_steps, takes_blocks, n = 5000, True, 0

    def _on_rollout_start(self):
        self.n += 1

    def _on_step(self):
        return True


def test_blocks_are_long_though_the_log_is_due_often():
    model, blocks = lake(), Blocks()
    model.set_logger(configure(None, ["log"]))
    model.learn(10_000, log_interval=1, callback=blocks)
    assert blocks.n == 2
    model.logger.close()
