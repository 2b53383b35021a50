"""Callbacks and logs beside compiled trainings: the same steps, agents and records."""

import csv
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
from stable_baselines3 import DQN
from stable_baselines3.common import callbacks as sb3
from stable_baselines3.common.logger import configure

from rl_yardstick.agents.common.callbacks import BlockCallback, members
from rl_yardstick.pipeline.callbacks import Checkpoint, EvaluationCallback
from rl_yardstick.pipeline.evaluation.yardstick import Evaluation
from rl_yardstick.pipeline.run import Run
from rl_yardstick.pipeline.spec import TrainSpec
from tests.agents.trainings import LAKE, Every, environment, make, state_of

ENGINES = ("interpreted", "compiled")
OF_THE_CLOCK = {"time/fps", "time/time_elapsed"}


def lake(engine="compiled", n_envs=1, name="qlearning", **kwargs):
    return make(name, environment(LAKE, n_envs, seed=0), seed=0, engine=engine, **kwargs)


def snapshot(model):
    """What a callback can see of the agent; environments are behind where nobody looks at them."""
    return {key: value for key, value in state_of(model).items() if " of " not in key}


class Recorder(sb3.BaseCallback):
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


def trained(engine, folder):
    """Everything that happened in a training with all callbacks that the compiled engine knows."""
    model, evaluated, watched = lake(engine, 3, "sarsa", exploration_final_eps=0.3), [], []

    def evaluator(model):
        evaluated.append(snapshot(model))
        return Evaluation(np.array([float(len(evaluated))]), np.array([1]), None)

    env, watcher = environment(LAKE, 1, seed=9), Every(40, lambda m: watched.append(snapshot(m)))
    run = Run.claim(folder / "logs", TrainSpec(algo="sarsa", env_id=LAKE, n_timesteps=1))
    steps, episodes = ({"save_path": str(folder / name)} for name in ("steps", "episodes"))
    for kwargs in (steps, episodes):
        Path(kwargs["save_path"]).mkdir(parents=True)
    callbacks = [
        sb3.EvalCallback(env, eval_freq=90, n_eval_episodes=2, log_path=str(folder), verbose=0),
        sb3.CheckpointCallback(110, str(folder), name_prefix="library"),
        sb3.EveryNTimesteps(70, recorder := Recorder()),
        sb3.LogEveryNTimesteps(130),
        EvaluationCallback(run, SimpleNamespace(env=env, evaluator=evaluator), (55, 0)),
        Checkpoint(85, **steps),
        Checkpoint(every_n_episodes=9, **episodes),
        bar := sb3.ProgressBarCallback(),
        sb3.CallbackList([watcher, sb3.StopTrainingOnMaxEpisodes(60)]),
    ]
    model.learn(2000, callback=callbacks, log_interval=11)
    assert model.engine_in_use.startswith(engine)
    evaluations = np.load(folder / "evaluations.npz")
    everyone = [member for callback in callbacks for member in members(callback)]
    return {
        "evaluated": evaluated,
        "recorded": recorder.seen,
        "watched": watched,
        "evaluations": evaluations["timesteps"].tolist(),
        "results": evaluations["results"].tolist(),
        "files": sorted(str(p.relative_to(folder)) for p in folder.rglob("*_steps.zip")),
        "calls": [(type(each).__name__, each.n_calls, each.num_timesteps) for each in everyone],
        "bar": bar.pbar.n,
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
    for name in ("recorded", "watched", "evaluations", "evaluated"):
        assert len(interpreted[name]) >= 3, name
    folders = {"/".join(name.split("/")[:-1][:1]) for name in interpreted["files"]}
    assert folders == {"", "steps", "episodes"}


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


def test_a_compiled_training_logs_once_per_block(tmp_path):
    """What it logs is what an interpreted agent comes to after as many steps."""
    settings = {"exploration_decay": "constant", "exploration_initial_eps": 0.3}
    settings |= {"stats_window_size": 5, "n_envs": 2, "name": "sarsa"}
    model, other = lake(**settings), lake("interpreted", **settings)
    model.set_logger(configure(str(tmp_path), ["csv"]))
    model.learn(2000, Sparse(500), log_interval=5)
    model.logger.close()
    rows = [*csv.DictReader((tmp_path / "progress.csv").read_text().splitlines())]
    assert len(rows) == 4
    for row in rows:
        other.learn(500, log_interval=None, reset_num_timesteps=False)
        returns, lengths = zip(*((e["r"], e["l"]) for e in other.ep_info_buffer), strict=True)
        assert {k: float(v) for k, v in row.items() if k not in OF_THE_CLOCK} == {
            "rollout/ep_rew_mean": np.mean(returns),
            "rollout/ep_len_mean": np.mean(lengths),
            "rollout/exploration_rate": 0.3,
            "time/episodes": other._episode_num,
            "time/total_timesteps": other.num_timesteps,
            "train/learning_rate": 0.1,
            "train/mean_absolute_td_error": other.mean_td_error,
            "train/n_updates": other._n_updates,
        }
