"""Files that somebody swaps for others once they have been opened: what was checked is loaded."""

import hashlib
import io
import os
import pathlib
import shutil
from dataclasses import replace

import numpy as np
import pytest
from rich.console import Console

from experiments.off_policy.logged_policies import read_policy
from pipeline.errors import UserError
from pipeline.models.choose import ModelRequest, agent_to_continue, choose_model, model_of_run
from pipeline.models.load import load_model, load_to_play
from pipeline.playing import playing_env
from pipeline.settings.hyperparams import split
from pipeline.train_spec import TrainSpec
from pipeline.training import prepare, train

RAW = {"n_timesteps": 16, "n_steps": 4, "policy": "MlpPolicy", "normalize": True}
DQN = {"n_timesteps": 16, "learning_starts": 4, "policy": "MlpPolicy", "buffer_size": 50}
TABLE = {"n_timesteps": 16}
SILENT = Console(file=io.StringIO())


def spec_of(folder, algo, env_id, raw, seed, **fields):
    rest = {"log_folder": folder, "eval_freq": -1, "eval_episodes": 1, "n_eval_envs": 1}
    rest |= {"pictures": False, "device": "cpu", "save_replay_buffer": True, **fields}
    return TrainSpec(algo, env_id, split(raw), raw, seed, **rest)


def two_runs(folder, algo, env_id, raw):
    return [
        train(spec_of(folder, algo, env_id, raw, seed), SILENT, {}, "train.py").run
        for seed in (0, 1)
    ]


@pytest.fixture(scope="module")
def runs(tmp_path_factory):
    """Two runs each of an agent with statistics, one with a replay buffer, and one of tables."""
    folder = tmp_path_factory.mktemp("logs")
    return {
        "a2c": two_runs(folder, "a2c", "CartPole-v1", RAW),
        "dqn": two_runs(folder, "dqn", "CartPole-v1", DQN),
        "ucb": two_runs(folder, "ucb", "BernoulliBandit-v0", TABLE),
    }


@pytest.fixture
def swapped(runs, tmp_path, monkeypatch):
    """A copy of an agent's first run, whose files become the second's once they are opened."""

    def copy(algo):
        genuine, other = runs[algo]
        run = replace(genuine, path=tmp_path / genuine.path.name)
        shutil.copytree(genuine.path, run.path)
        opens = []

        def open_and_swap(path, *args, **kwargs):
            number = opened(path, *args, **kwargs)
            there = pathlib.Path(f"/proc/self/fd/{number}").readlink()
            if there.is_relative_to(run.path) and there.suffix in (".zip", ".pkl"):
                opens.append(there.name)
                shutil.copyfile(other.path / there.relative_to(run.path), tmp_path / "other")
                (tmp_path / "other").replace(there)
            return number

        opened = os.open
        monkeypatch.setattr(os, "open", open_and_swap)
        return run, opens

    return copy


def weights(model):
    state = model.policy.state_dict().values()
    return np.concatenate([value.detach().numpy().ravel() for value in state])


def check_is_of(genuine, other, algo, model):
    first, second = (weights(load_model(algo, run.model_path)) for run in (genuine, other))
    np.testing.assert_array_equal(weights(model), first)
    assert not np.array_equal(first, second)


def test_playing(runs, swapped):
    run, opens = swapped("a2c")
    chosen = choose_model(ModelRequest(run.path, log_folder=run.path.parent, device="cpu"))
    env = playing_env(chosen, None)
    model = load_to_play("a2c", chosen.file, env, "cpu")
    assert sorted(opens) == ["CartPole-v1.zip", "vecnormalize.pkl"]
    genuine, other = runs["a2c"]
    check_is_of(genuine, other, "a2c", model)
    means = [
        playing_env(choose_model(ModelRequest(one.path)), None).obs_rms.mean.tolist()
        for one in (genuine, other)
    ]
    assert env.obs_rms.mean.tolist() == means[0] != means[1]


def test_a_film_of_a_run(runs, swapped):
    run, opens = swapped("a2c")
    chosen = model_of_run(run.model_path, spec_of(None, "a2c", "CartPole-v1", RAW, 0), run)
    model = load_model("a2c", chosen.file, playing_env(chosen, None), device="cpu")
    assert sorted(opens) == ["CartPole-v1.zip", "vecnormalize.pkl"]
    check_is_of(*runs["a2c"], "a2c", model)


def test_a_policy_judged_on_a_log(runs, swapped):
    run, opens = swapped("ucb")
    policy = read_policy(run.path)
    assert opens == ["BernoulliBandit-v0.zip"]
    check_is_of(*runs["ucb"], "ucb", policy.agent)


def test_going_on(runs, swapped, tmp_path):
    run, opens = swapped("dqn")
    spec = spec_of(tmp_path / "logs", "dqn", "CartPole-v1", DQN, 2, trained_agent=run.model_path)
    training = prepare(spec, SILENT, {}, "train.py")
    assert opens == ["CartPole-v1.zip", "replay_buffer.pkl"]
    genuine = runs["dqn"][0].model_path.read_bytes()
    recorded = training.run.read_info()["trained_agent_digest"]
    assert recorded == hashlib.sha256(genuine).hexdigest()
    check_is_of(*runs["dqn"], "dqn", training.model)
    training.model.env.close()
    training.eval_env.close()


def test_a_swap_before_the_training_begins_is_found(swapped, tmp_path):
    """The first look is for refusals without delay; what counts is what is loaded."""
    run, _ = swapped("dqn")
    path = agent_to_continue(run.path)
    spec = spec_of(tmp_path / "logs", "dqn", "CartPole-v1", DQN, 2, trained_agent=path)
    with pytest.raises(UserError, match=r"CartPole-v1\.zip is not as the run left it"):
        prepare(spec, SILENT, {}, "train.py")
    assert not (tmp_path / "logs").exists()
