"""Single trainings on bandits: judged by regret, drawn by pull, kept when interrupted."""

import io
from pathlib import Path

import gymnasium as gym
import numpy as np
import pytest
from rich.console import Console
from stable_baselines3.common.callbacks import BaseCallback

from commands.train import describe_pulls, print_outcome
from envs.bandits import log_uniformly
from pipeline.callbacks import PullSummary, summarise_pulls
from pipeline.runs import PULLS_FILE
from pipeline.settings import hyperparams
from pipeline.train_spec import TrainSpec
from pipeline.training import train


def train_on(folder, algo, env_id, **settings):
    special = {name: settings.pop(name) for name in ("eval_freq",) if name in settings}
    raw = {"n_timesteps": 300, **settings}
    spec = TrainSpec(
        algo, env_id, hyperparams.split(raw), raw, seed=0, log_folder=Path(folder), **special
    )
    console = Console(width=160, file=io.StringIO())
    outcome = train(spec, console, {}, "train.py")
    print_outcome(console, spec, outcome)
    return outcome, console.file.getvalue()


def pulls_of(outcome):
    with np.load(outcome.run.path / PULLS_FILE) as arrays:
        return dict(arrays)


@pytest.mark.parametrize(
    ("algo", "env_id"), [("linucb", "LinearBandit-v0"), ("ucb", "GaussianBandit-v0")]
)
def test_regret_is_the_judgement_where_arms_are_drawn_anew(algo, env_id, tmp_path):
    outcome, text = train_on(tmp_path, algo, env_id)
    regret = float(pulls_of(outcome)["regrets"].sum())
    assert outcome.pulls.regret == regret > 0
    assert outcome.final is None
    assert outcome.best_return is None
    names = {path.name for path in outcome.run.path.iterdir()}
    assert {"pulls.npz", "pulls.png", "run.json"} <= names
    assert not names & {"evaluations.npz", "learning_curve.png", "best_model.zip"}
    info = outcome.run.read_info()
    assert info["regret"] == regret
    assert info["pulls"]["n_pulls"] == 300
    assert f"regret   {regret:,.2f} over 300 pulls; a best arm in" in text
    assert "of the last 100" in text
    assert (outcome.run.path / "pulls.png").read_bytes().startswith(b"\x89PNG")


def test_evaluations_can_be_asked_for_and_known_models_are_evaluated(tmp_path):
    short = {"eval_freq": 150, "env_kwargs": {"pulls": 20}}
    outcome, text = train_on(tmp_path, "ucb", "GaussianBandit-v0", **short)
    assert outcome.final is not None
    assert "final " in text
    names = {path.name for path in outcome.run.path.iterdir()}
    assert {"evaluations.npz", "learning_curve.png", "pulls.png"} <= names
    outcome, text = train_on(tmp_path, "ucb", "BernoulliBandit-v0")
    assert outcome.final.is_exact
    assert outcome.final.yardstick.optimum == pytest.approx(750)
    assert "regret " in text


def test_a_compiled_loop_keeps_no_pulls(tmp_path):
    """A tabular agent is asked after each pull, unless it was told to compile."""
    outcome, text = train_on(tmp_path / "a", "qlearning", "BernoulliBandit-v0")
    assert outcome.engine == "interpreted: PullRecorder must be asked after each step"
    assert outcome.pulls is not None
    outcome, text = train_on(tmp_path / "b", "qlearning", "BernoulliBandit-v0", engine="compiled")
    assert outcome.engine == "compiled"
    assert outcome.pulls is None
    assert "engine: compiled keeps no pulls, so that regret is not known" in text
    assert "regret" not in outcome.run.read_info()
    assert {path.name for path in outcome.run.path.iterdir()} >= {"learning_curve.png"}


class Stop(BaseCallback):
    """Ctrl-C at the hundredth pull."""

    def _on_step(self):
        if self.num_timesteps == 100:
            raise KeyboardInterrupt
        return True


def test_ctrl_c_leaves_the_pulls_so_far(tmp_path, monkeypatch):
    monkeypatch.setattr("pipeline.settings.components.callbacks", lambda *args: [Stop()])
    outcome, _ = train_on(tmp_path, "ucb", "GaussianBandit-v0")
    assert outcome.state == "interrupted"
    pulls = pulls_of(outcome)
    # The callback stands before the one that notes the pull.
    assert {array.shape for array in pulls.values()} == {(1, 99)}
    assert outcome.run.read_info()["regret"] == pytest.approx(pulls["regrets"].sum())
    assert (outcome.run.path / "pulls.png").exists()


def test_a_log_knows_no_regret(tmp_path):
    log_uniformly(gym.make("SegmentBandit-v0"), 300, 0, tmp_path / "log.csv")
    kwargs = {"log": str(tmp_path / "log.csv")}
    outcome, text = train_on(tmp_path, "ucb", "ReplayBandit-v0", env_kwargs=kwargs)
    pulls = pulls_of(outcome)
    matched = int(pulls["matched"].sum())
    assert 60 < matched < 140
    assert outcome.pulls.regret is None
    assert outcome.pulls.optimal is None
    assert outcome.pulls.reward == pytest.approx(pulls["rewards"].sum() / matched)
    assert f"over the {matched} of 300 that are in the log" in text
    assert outcome.final is None
    assert (outcome.run.path / "pulls.png").exists()


def test_pulls_summed_up_by_hand():
    pulls = {
        "rewards": np.array([[1.0, 0.0, 1.0, 0.0]], dtype=np.float32),
        "regrets": np.array([[0.0, 0.5, 0.25, 0.0]]),
        "matched": np.ones((1, 4), dtype=bool),
        "optimal": np.array([[True, False, False, True]]),
    }
    found = summarise_pulls(pulls)
    assert found == PullSummary(n_pulls=4, n_matched=4, reward=0.5, regret=0.75, optimal=0.5)
    assert describe_pulls(found) == "0.75 over 4 pulls; a best arm in 50% of the last 4"
    unknown = pulls | {"regrets": np.full((1, 4), np.nan), "matched": np.zeros((1, 4), dtype=bool)}
    found = summarise_pulls(unknown)
    assert (found.reward, found.regret, found.optimal) == (None, None, None)
    assert describe_pulls(found) == "not known: none of 4 pulls is in the log"
