"""Going on with a trained agent: what is brought along, and that what was checked is loaded."""

import hashlib
import io
import os
import pathlib
import pickle
import shutil
from dataclasses import replace

import numpy as np
import pytest
from rich.console import Console

from experiments.off_policy.logged_policies import read_policy
from pipeline.errors import UserError
from pipeline.models.choose import ModelRequest, agent_to_continue, choose_model, model_of_run
from pipeline.models.find import model_at, replay_buffer_of, statistics_of
from pipeline.models.load import load_model, load_to_play
from pipeline.playing import playing_env
from pipeline.runs import Run
from pipeline.settings.hyperparams import split
from pipeline.train_spec import TrainSpec
from pipeline.training import prepare, train

A2C = {"policy": "MlpPolicy", "policy_kwargs": {"net_arch": [4]}, "n_envs": 2, "n_steps": 10}
DQN = {
    "policy": "MlpPolicy",
    "policy_kwargs": {"net_arch": [4]},
    "learning_starts": 10,
    "buffer_size": 500,
    "batch_size": 4,
}


def train_to(folder, algo, entry, n_timesteps=200, **fields):
    entry = {**entry, "n_timesteps": n_timesteps}
    fields = {"pictures": False, "eval_episodes": 2, "n_eval_envs": 1, "verbose": 0, **fields}
    spec = TrainSpec(
        algo, "CartPole-v1", split(entry), entry, 0, log_folder=folder, device="cpu", **fields
    )
    return train(spec, Console(quiet=True), {}, "train.py").run


def read(path):
    return pickle.loads(path.read_bytes())


def seen(path):
    """How many observations the statistics are of, the start of 1e-4 left out."""
    return round(read(path).obs_rms.count)


@pytest.fixture(scope="module")
def normalised(tmp_path_factory):
    """A run of 200 steps with checkpoints after 60, 120 and 180."""
    entry = {**A2C, "normalize": {"clip_obs": 3.0}}
    logs = tmp_path_factory.mktemp("logs")
    return train_to(logs, "a2c", entry, save_freq=60, eval_freq=40)


def test_each_model_has_the_statistics_of_its_moment(normalised):
    # Two observations at the beginning, and two for each step of both environments.
    assert seen(normalised.vecnormalize_path) == 202
    for n_steps in (60, 120, 180):
        path = normalised.path / f"rl_model_vecnormalize_{n_steps}_steps.pkl"
        assert seen(path) == n_steps + 2
    assert seen(normalised.path / "best_model_vecnormalize.pkl") in range(42, 203, 40)


@pytest.mark.parametrize(
    ("which", "name"),
    [
        ("final", "CartPole-v1/vecnormalize.pkl"),
        ("best", "best_model_vecnormalize.pkl"),
        ("last checkpoint", "rl_model_vecnormalize_180_steps.pkl"),
        (60, "rl_model_vecnormalize_60_steps.pkl"),
    ],
)
def test_a_model_is_played_on_its_own_statistics(normalised, which, name):
    logs = normalised.path.parent.parent
    request = ModelRequest(algo="a2c", env_id="CartPole-v1", log_folder=logs, which=which)
    assert choose_model(request).statistics.path == normalised.path / name
    # And likewise by its path.
    path = choose_model(request).path
    assert choose_model(ModelRequest(path, log_folder=logs)).statistics.path.samefile(
        normalised.path / name
    )


def test_old_folders_have_those_of_the_end_alone(tmp_path):
    for name in ("best_model.zip", "rl_model_60_steps.zip", "other_60_steps.zip", "X-v0.zip"):
        assert statistics_of(tmp_path / name, Run(tmp_path, "X-v0")) is None
    (tmp_path / "X-v0").mkdir()
    end = tmp_path / "X-v0" / "vecnormalize.pkl"
    end.touch()
    for name in ("best_model.zip", "rl_model_60_steps.zip", "X-v0.zip"):
        assert statistics_of(tmp_path / name, Run(tmp_path, "X-v0")) == end
    own = tmp_path / "other_vecnormalize_60_steps.pkl"
    own.touch()
    assert statistics_of(tmp_path / "other_60_steps.zip", Run(tmp_path, "X-v0")) == own


@pytest.mark.parametrize(("model", "before"), [("", 202), ("rl_model_60_steps", 62)])
def test_statistics_go_on(normalised, tmp_path, model, before):
    agent = model_at(normalised.path / model)
    # The entry says nothing of normalisation: the agent has been trained on it all the same.
    run = train_to(tmp_path, "a2c", A2C, 40, trained_agent=agent, eval_freq=-1)
    # Two for the new beginning.
    assert seen(run.vecnormalize_path) == before + 42
    statistics = read(run.vecnormalize_path)
    assert (statistics.clip_obs, statistics.norm_reward) == (3.0, True)
    assert run.recorded_spec()["hyperparams"]["normalize"]["clip_obs"] == 3.0
    request = ModelRequest(algo="a2c", env_id="CartPole-v1", log_folder=tmp_path)
    assert choose_model(request).spec.hyperparams.normalize["clip_obs"] == 3.0


def test_what_the_new_entry_says_of_normalisation_wins(normalised, tmp_path):
    entry = {**A2C, "normalize": {"clip_obs": 4.0}, "gamma": 0.5}
    run = train_to(tmp_path, "a2c", entry, 40, trained_agent=normalised.model_path, eval_freq=-1)
    statistics = read(run.vecnormalize_path)
    assert (statistics.clip_obs, statistics.gamma, seen(run.vecnormalize_path)) == (4.0, 0.5, 244)


def test_normalisation_can_be_turned_off(normalised, tmp_path):
    entry = {**A2C, "normalize": False}
    run = train_to(tmp_path, "a2c", entry, 40, trained_agent=normalised.model_path, eval_freq=-1)
    assert not run.vecnormalize_path.exists()
    request = ModelRequest(algo="a2c", env_id="CartPole-v1", log_folder=tmp_path)
    assert choose_model(request).statistics is None


def test_the_end_is_judged_on_the_statistics_of_the_end(tmp_path, monkeypatch):
    judged = []

    def note(self, model):
        judged.append(round(self.env.obs_rms.count))
        raise RuntimeError("judged")

    evaluator = "pipeline.evaluation.sampled.SampledEvaluator"
    monkeypatch.setattr(f"{evaluator}.at_the_end", note)
    with pytest.raises(RuntimeError, match="judged"):
        train_to(tmp_path, "a2c", {**A2C, "normalize": True}, eval_freq=80)
    assert judged == [202]


# --- replay buffers ------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def replayed(tmp_path_factory):
    logs = tmp_path_factory.mktemp("logs")
    return train_to(logs, "dqn", DQN, save_freq=80, save_replay_buffer=True, eval_freq=-1)


def test_replay_buffers_lie_where_the_library_and_rl_zoo3_have_them(replayed):
    names = sorted(path.name for path in replayed.path.glob("*.pkl"))
    assert names == [
        "replay_buffer.pkl",
        "rl_model_replay_buffer_160_steps.pkl",
        "rl_model_replay_buffer_80_steps.pkl",
    ]
    assert read(replayed.path / "replay_buffer.pkl").pos == 200


@pytest.mark.parametrize(
    ("model", "name"),
    [
        ("CartPole-v1.zip", "replay_buffer.pkl"),
        ("rl_model_80_steps.zip", "rl_model_replay_buffer_80_steps.pkl"),
        ("best_model.zip", "replay_buffer.pkl"),
    ],
)
def test_the_replay_buffer_of_a_model(replayed, model, name):
    assert replay_buffer_of(replayed.path / model) == replayed.path / name


def test_a_replay_buffer_goes_on(replayed, tmp_path):
    run = train_to(
        tmp_path, "dqn", DQN, 50, trained_agent=replayed.model_path, save_replay_buffer=True
    )
    before, after = (read(one.path / "replay_buffer.pkl") for one in (replayed, run))
    # An update follows every fourth step, and training ends with one.
    assert after.pos == 252
    np.testing.assert_array_equal(after.observations[:200], before.observations[:200])


def test_playing_needs_no_replay_buffer(replayed):
    request = ModelRequest(replayed.model_path, log_folder=replayed.path, device="cpu")
    chosen = choose_model(request)
    env = playing_env(chosen, None)
    assert load_to_play("dqn", chosen.path, env).replay_buffer.buffer_size == 1
    env.close()


def test_a_replay_buffer_of_other_environments(replayed, tmp_path):
    logs, entry = tmp_path / "above" / "logs", {**DQN, "n_envs": 2}
    with pytest.raises(UserError, match=r"filled by 1 environments at once.* n_envs:1"):
        train_to(logs, "dqn", entry, 50, trained_agent=replayed.model_path)
    assert not logs.exists()


def test_the_kind_of_buffer_follows_the_new_entry(tmp_path):
    """Returns of several steps take another kind, which the library writes into the zip."""
    first = train_to(tmp_path, "dqn", {**DQN, "n_steps": 3}, 40, eval_freq=-1)
    fields = {"trained_agent": first.model_path, "eval_freq": -1, "save_replay_buffer": True}
    for n_steps, kind in ((1, "ReplayBuffer"), (2, "NStepReplayBuffer")):
        run = train_to(tmp_path, "dqn", {**DQN, "n_steps": n_steps}, 20, **fields)
        buffer = read(run.path / "replay_buffer.pkl")
        assert (type(buffer).__name__, getattr(buffer, "n_steps", 1)) == (kind, n_steps)
    fields["trained_agent"] = run.model_path
    said = "holds a NStepReplayBuffer with n_steps 2; these hyperparameters need a ReplayBuffer"
    with pytest.raises(UserError, match=said):
        train_to(tmp_path, "dqn", {**DQN, "n_steps": 1}, 20, **fields)


def test_none_is_kept_unless_asked_for_or_where_there_is_none(tmp_path):
    for algo, entry, asked in (("dqn", DQN, False), ("a2c", A2C, True)):
        run = train_to(
            tmp_path, algo, entry, 40, save_freq=20, save_replay_buffer=asked, eval_freq=-1
        )
        assert not list(run.path.glob("*.pkl"))


SMALL_A2C = {"n_timesteps": 16, "n_steps": 4, "policy": "MlpPolicy", "normalize": True}
SMALL_DQN = {"n_timesteps": 16, "learning_starts": 4, "policy": "MlpPolicy", "buffer_size": 50}
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
        "a2c": two_runs(folder, "a2c", "CartPole-v1", SMALL_A2C),
        "dqn": two_runs(folder, "dqn", "CartPole-v1", SMALL_DQN),
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
    chosen = model_of_run(run.model_path, spec_of(None, "a2c", "CartPole-v1", SMALL_A2C, 0), run)
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
    spec = spec_of(
        tmp_path / "logs", "dqn", "CartPole-v1", SMALL_DQN, 2, trained_agent=run.model_path
    )
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
    spec = spec_of(tmp_path / "logs", "dqn", "CartPole-v1", SMALL_DQN, 2, trained_agent=path)
    with pytest.raises(UserError, match=r"CartPole-v1\.zip is not as the run left it"):
        prepare(spec, SILENT, {}, "train.py")
    assert not (tmp_path / "logs").exists()
