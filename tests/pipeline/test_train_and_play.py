"""What a training leaves beside its results, and what a trained agent is played on."""

import io
import pickle
import re
import signal
from pathlib import Path

import numpy as np
import pytest
from rich.console import Console
from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.vec_env import unwrap_vec_normalize

from pipeline.environments import make_training_env
from pipeline.errors import UserError
from pipeline.models.choose import ChosenModel, with_statistics
from pipeline.models.load import ModelFile
from pipeline.playing import playing_env
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


@pytest.mark.parametrize("every", [1, 10])
def test_checkpoints_after_so_many_episodes(tmp_path, every):
    run = train_to(tmp_path, save_every_n_episodes=every).run
    lines = (run.path / "0.monitor.csv").read_text().splitlines()[2:]
    ends = np.cumsum([int(line.split(",")[1]) for line in lines])
    assert [int(path.stem.split("_")[2]) for path in run.checkpoints()] == ends[
        every - 1 :: every
    ].tolist()


def test_no_checkpoints_unless_asked_for(tmp_path):
    assert train_to(tmp_path).run.checkpoints() == []


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


@pytest.mark.parametrize(
    ("content", "complaint"),
    [
        (b"broken", r"vecnormalize\.pkl cannot be read"),
        (pickle.dumps(["a list"]), "holds no statistics of VecNormalize"),
    ],
)
def test_statistics_that_are_broken(tmp_path, content, complaint):
    spec = spec_of(tmp_path, "CartPole-v1", entry={"normalize": True})
    path = tmp_path / "vecnormalize.pkl"
    path.write_bytes(content)
    with pytest.raises(UserError, match=complaint):
        playing_env(chosen_of(spec, path), None)


def test_statistics_of_other_observations(tmp_path):
    path = tmp_path / "vecnormalize.pkl"
    saved_statistics(spec_of(tmp_path, "CartPole-v1", entry={"normalize": True}), path)
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
