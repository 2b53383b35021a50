"""What settings do to a training, what it leaves, and what a trained agent is played on."""

import builtins
import gc
import io
import pickle
import re
import signal
import subprocess
import sys
from pathlib import Path
from types import SimpleNamespace

import gymnasium as gym
import numpy as np
import pytest
import torch as th
from rich.console import Console
from stable_baselines3 import HerReplayBuffer
from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.envs import BitFlippingEnv
from stable_baselines3.common.noise import VectorizedActionNoise
from stable_baselines3.common.vec_env import unwrap_vec_normalize

from pipeline import loading_libraries
from pipeline.environments import make_training_env
from pipeline.errors import UserError
from pipeline.models.choose import ChosenModel, with_statistics
from pipeline.models.load import ModelFile
from pipeline.playing import playing_env
from pipeline.preparation import load_for_optimizer
from pipeline.settings.hyperparams import split
from pipeline.stopping import stops_noticed
from pipeline.train_spec import TrainSpec
from pipeline.training import carry_out, prepare, train


def spec_of(folder, env_id="FrozenLake-v1", n_timesteps=600, entry=None, **fields):
    entry = {"n_timesteps": n_timesteps, **(entry or {})}
    fields = {"pictures": False, "eval_freq": -1, **fields}
    return TrainSpec("qlearning", env_id, split(entry), entry, seed=0, log_folder=folder, **fields)


def train_to(folder, console=None, **fields):
    spec = spec_of(folder, **fields)
    return train(spec, console or Console(quiet=True), {}, "train.py")


class Trouble(BaseCallback):
    """Raises at the three hundredth step."""

    def __init__(self, error):
        super().__init__()
        self.error = error

    def _on_step(self):
        if self.num_timesteps == 300:
            raise self.error
        return True


@pytest.mark.parametrize("every", [-1, 10])
def test_checkpoints_after_so_many_episodes(tmp_path, every):
    run = train_to(tmp_path, save_every_n_episodes=every).run
    lines = (run.path / "0.monitor.csv").read_text().splitlines()[2:]
    ends = np.cumsum([int(line.split(",")[1]) for line in lines])
    expected = ends[every - 1 :: every].tolist() if every > 0 else []
    assert [int(path.stem.split("_")[2]) for path in run.checkpoints()] == expected


@pytest.mark.parametrize(("verbose", "shown"), [(0, False), (1, False), (2, True)])
def test_the_librarys_tables_are_for_those_who_ask(tmp_path, capsys, verbose, shown):
    train_to(tmp_path, verbose=verbose, log_interval=1)
    assert ("| time/" in capsys.readouterr().out) is shown


@pytest.mark.parametrize("error", [KeyboardInterrupt(), RuntimeError("thin ice")])
def test_a_bar_lets_go_of_the_terminal_whatever_happens(tmp_path, monkeypatch, error):
    monkeypatch.setattr("pipeline.settings.components.callbacks", lambda *args: [Trouble(error)])
    file = io.StringIO()
    console = Console(file=file, force_terminal=True, color_system=None)
    try:
        state = train_to(tmp_path, console).state
    except RuntimeError:
        state = "failed"
    assert state == ("interrupted" if isinstance(error, KeyboardInterrupt) else "failed")
    # The cursor that was hidden, by the bar and by what came after it, is shown again.
    codes = re.findall(r"\x1b\[\?25[hl]", file.getvalue())
    assert codes == ["\x1b[?25l", "\x1b[?25h"] * (2 if state == "interrupted" else 1)


@pytest.mark.parametrize("stopped", [False, True])
def test_results_are_told_before_anything_is_drawn(tmp_path, stopped):
    """A stop while pictures are drawn costs the pictures, and nothing that was found out."""
    told, file = [], io.StringIO()
    spec = spec_of(tmp_path, pictures=True, eval_freq=300)

    def tell(outcome):
        run = outcome.run
        told.append((outcome.state, run.read_info()["state"], run.curve_path.exists()))
        if stopped:
            signal.raise_signal(signal.SIGINT)

    with stops_noticed():
        training = prepare(spec, Console(file=file, width=200), {}, "train.py")
        outcome = carry_out(training, tell)
    assert told == [("finished", "running", False)]
    info = outcome.run.read_info()
    assert outcome.state == info["state"] == ("interrupted" if stopped else "finished")
    assert outcome.run.curve_path.exists() is not stopped
    assert info["final"]["mean_return"] == outcome.final.mean_return
    assert ("stopped while drawing: the run counts as interrupted" in file.getvalue()) is stopped


# --- playing --------------------------------------------------------------------------------------


def chosen_of(spec, statistics=None):
    chosen = ChosenModel(ModelFile(Path("no.zip"), b"", {}), spec, None)
    return chosen if statistics is None else with_statistics(chosen, statistics)


def saved_statistics(spec, path):
    """The statistics of some steps of training."""
    env = make_training_env(spec, None)
    env.reset()
    for _ in range(50):
        env.step([env.action_space.sample()])
    unwrap_vec_normalize(env).save(path)
    return unwrap_vec_normalize(env).obs_rms.mean.copy()


@pytest.mark.parametrize("further", [{}, {"frame_stack": 2}])
def test_observations_are_normalised_as_in_training_and_rewards_left_alone(tmp_path, further):
    spec = spec_of(tmp_path, "CartPole-v1", entry={"normalize": {"clip_obs": 0.5}, **further})
    mean = saved_statistics(spec, tmp_path / "vecnormalize.pkl")
    # The file says how observations are normalised, whatever else is known of the run.
    unsaid = spec_of(tmp_path, "CartPole-v1", entry=further)
    env = playing_env(chosen_of(unsaid, tmp_path / "vecnormalize.pkl"), None)
    env.seed(0)
    obs = env.reset()
    assert obs.shape == (1, 4 * further.get("frame_stack", 1))
    for _ in range(20):
        obs, reward, _, _ = env.step([env.action_space.sample()])
        assert reward.tolist() == [1.0]
        assert abs(obs).max() <= 0.5
    # Watching teaches nothing.
    assert unwrap_vec_normalize(env).obs_rms.mean.tolist() == mean.tolist()
    env.close()


def test_statistics_that_are_broken_or_of_other_observations(tmp_path):
    spec = spec_of(tmp_path, "CartPole-v1", entry={"normalize": True})
    path = tmp_path / "vecnormalize.pkl"
    for content, complaint in (
        (b"broken", r"vecnormalize\.pkl cannot be read"),
        (pickle.dumps(["a list"]), "holds no statistics of VecNormalize"),
    ):
        path.write_bytes(content)
        with pytest.raises(UserError, match=complaint):
            playing_env(chosen_of(spec, path), None)
    saved_statistics(spec, path)
    with pytest.raises(UserError, match=r"of shape \(4,\); the environment gives \(2,\)"):
        playing_env(chosen_of(spec_of(tmp_path, "MountainCar-v0"), path), None)


def test_frames_are_kept_over_the_ends_of_episodes(tmp_path):
    env = playing_env(chosen_of(spec_of(tmp_path)), "ansi")
    env.seed(0)
    env.reset()
    steps, ends = 0, 0
    while ends < 3:
        _, _, done, _ = env.step([2])
        steps, ends = steps + 1, ends + int(done[0])
    # One for each step, and one for the beginning of each episode.
    assert len(env.env_method("render")[0]) == steps + ends + 1
    # They are handed over once.
    assert env.env_method("render")[0] == []
    env.close()


def test_what_cannot_be_drawn_so_is_refused(tmp_path):
    # Gymnasium has its say first.
    said = pytest.warns(UserWarning, match="not in the possible render_modes")
    with said, pytest.raises(UserError, match="CartPole-v1 cannot be rendered as ansi"):
        playing_env(chosen_of(spec_of(tmp_path, "CartPole-v1")), "ansi")


TINY = {"policy": "MlpPolicy", "policy_kwargs": {"net_arch": [4]}, "buffer_size": 1000}


def prepared(folder, algo, env_id, **entry):
    entry = {**TINY, **entry}
    spec = TrainSpec(
        algo, env_id, split(entry), entry, seed=0, log_folder=folder, eval_freq=-1, pictures=False
    )
    return prepare(spec, Console(quiet=True), {}, "train.py")


@pytest.mark.parametrize("n_envs", [1, 2])
def test_noise_is_added_to_what_the_policy_does(tmp_path, n_envs):
    """A policy that learns nothing, and its actions as they stand in the buffer."""
    noise = {"noise_type": "normal", "noise_std": 0.1}
    still = {"learning_rate": 0.0, "learning_starts": 0, "n_timesteps": 500 * n_envs}
    training = prepared(tmp_path, "td3", "Pendulum-v1", n_envs=n_envs, **noise, **still)
    carry_out(training)
    model = training.model
    assert isinstance(model.action_noise, VectorizedActionNoise) == (n_envs > 1)
    buffer = model.replay_buffer
    observations = buffer.observations[:400].reshape(-1, 3)
    without = model.policy.scale_action(model.predict(observations, deterministic=True)[0])
    added = buffer.actions[:400].reshape(-1, 1) - without
    # Where the sum would leave [-1, 1] it is cut off: a policy near 0, so hardly anywhere.
    assert np.abs(without).max() < 0.6
    assert added.std() == pytest.approx(0.1, rel=0.1)
    assert added.mean() == pytest.approx(0, abs=0.02)


def test_hindsight_replay_as_rl_zoo3_writes_it(tmp_path):
    """Its entry for robots, on an environment with goals that needs no robot."""
    gym.register(
        "BitFlipping-v0", lambda: BitFlippingEnv(n_bits=3, continuous=True), max_episode_steps=3
    )
    try:
        training = prepared(
            *(tmp_path, "sac", "BitFlipping-v0"),
            n_timesteps=60,
            policy="MultiInputPolicy",
            learning_starts=20,
            train_freq=[1, "episode"],
            gradient_steps=-1,
            replay_buffer_class="HerReplayBuffer",
            replay_buffer_kwargs="dict(goal_selection_strategy='future', n_sampled_goal=4)",
        )
        outcome = carry_out(training)
    finally:
        del gym.registry["BitFlipping-v0"]
    assert outcome.state == "finished"
    assert isinstance(training.model.replay_buffer, HerReplayBuffer)
    assert training.model.replay_buffer.her_ratio == 0.8
    # As many updates as steps, after whole episodes.
    assert 0 < training.model._n_updates <= 60


@pytest.mark.parametrize("fused", [True, False])
def test_a_fused_optimizer_is_a_matter_of_settings_and_noise_none_unless_asked_for(tmp_path, fused):
    policy_kwargs = {"net_arch": [4], "optimizer_kwargs": {"fused": fused}}
    training = prepared(tmp_path, "td3", "Pendulum-v1", n_timesteps=10, policy_kwargs=policy_kwargs)
    assert training.model.actor.optimizer.defaults["fused"] is fused
    assert training.model.action_noise is None
    training.model.env.close()


def test_denormals_are_flushed_in_the_runs_that_ask_for_it(tmp_path):
    def halved():
        return float(th.tensor([1.5e-38]) / 2)

    try:
        for flushes in (True, False):
            training = prepared(
                tmp_path, "dqn", "CartPole-v1", n_timesteps=10, flush_denormal=flushes
            )
            training.model.env.close()
            assert (halved() == 0) is flushes
    finally:
        th.set_flush_denormal(False)


@pytest.fixture
def collector():
    before = gc.isenabled()
    yield
    (gc.enable if before else gc.disable)()


@pytest.mark.usefixtures("collector")
@pytest.mark.parametrize("was_on", [True, False])
def test_libraries_are_imported_without_the_collector_which_is_as_it_was_afterwards(was_on):
    (gc.enable if was_on else gc.disable)()
    with loading_libraries():
        assert not gc.isenabled()
    assert gc.isenabled() == was_on


@pytest.fixture
def imported(monkeypatch):
    """What is imported, and whether garbage was looked for meanwhile."""
    found, load = [], builtins.__import__

    def noted(name, *args):
        if name == "torch._dynamo":
            found.append(gc.isenabled())
        return load(name, *args)

    monkeypatch.setattr(builtins, "__import__", noted)
    return found


@pytest.mark.usefixtures("collector")
@pytest.mark.parametrize(
    ("fields", "expected"),
    [
        ({"optimizer": "Adam", "engine": "library"}, [False]),
        ({"optimizer": "Adam", "engine": "compiled"}, []),
        ({"optimizer": "Adam", "engine": "auto"}, []),
        ({"optimizer": None}, []),
    ],
)
def test_only_what_steps_an_optimizer_loads_what_that_needs(imported, fields, expected):
    gc.enable()
    model = SimpleNamespace(policy=SimpleNamespace(optimizer=fields.get("optimizer")))
    if "engine" in fields:
        model.engine = fields["engine"]
    load_for_optimizer(model)
    assert imported[:1] == expected  # which imports parts of itself by that name


COMPILED_TRAINING = """
import sys
from agents import load_algorithm
model = load_algorithm("ppo")("MlpPolicy", "CartPole-v1", n_steps=32, engine="compiled")
model.learn(64)
model.save(sys.argv[1])
load_algorithm("ppo").load(sys.argv[1])
print("torch._dynamo" in sys.modules)
import torch
torch._dynamo.reset()
model.policy.optimizer.zero_grad()
kept_out = getattr(torch.optim.Optimizer.zero_grad.__wrapped__, "__dynamo_disable")
print(getattr(kept_out, "func", None) is None)
"""


def test_compiled_networks_do_without_pytorchs_compiler(tmp_path):
    command = [sys.executable, "-c", COMPILED_TRAINING, str(tmp_path / "model")]
    done = subprocess.run(command, capture_output=True, text=True, check=True)
    # Once somebody has imported it, methods are kept out of it as ever.
    assert done.stdout.splitlines()[-2:] == ["False", "True"]


def test_optimizers_import_it_still(imported):
    weight = th.nn.Parameter(th.zeros(1))
    th.optim.Adam([weight]).step()
    assert imported, "if not, there is nothing to load beforehand any more"
