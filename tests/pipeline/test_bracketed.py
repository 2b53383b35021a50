"""Sampled returns measured by a bracket: by both ends, and where one holds alone."""

import io
import json
from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
from rich.console import Console

from commands.enjoy import print_returns
from commands.terminal import describe
from envs.brackets import OptimumBracket
from pipeline.evaluation import sampled
from pipeline.evaluation.sampled import Evaluation, Yardstick, bracketed_yardstick
from pipeline.settings.hyperparams import split
from pipeline.train_spec import TrainSpec
from pipeline.training import train

POLE = Yardstick(optimum=500.0, baseline=20.0, at_least=480.0)


def spec_of(env_id="Pendulum-v1", **entry):
    entry = {"n_timesteps": 400, **entry}
    few = {"eval_episodes": 2, "final_episodes": 3, "pictures": False, "verbose": 0}
    return TrainSpec("random", env_id, split(entry), entry, seed=0, **few)


def played(*returns, yardstick=POLE):
    lengths = np.full(len(returns), 7)
    return Evaluation(np.array(returns, float), lengths, None).measured_by(yardstick)


def test_the_upper_end_measures_and_the_lower_stands_beside_it():
    figures = played(260.0, 260.0).summary()
    assert (figures["optimum"], figures["optimum_at_least"]) == (500, 480)
    assert (figures["gap"], figures["gap_at_least"]) == (240, 220)
    assert figures["score"] == 0.5
    assert figures["score_at_most"] == pytest.approx(240 / 460)
    assert not figures["exact"]
    assert "beats_optimum" not in figures


def test_a_known_optimum_has_one_end():
    figures = played(80.0, yardstick=Yardstick(100.0, 60.0)).summary()
    assert figures["score"] == 0.5
    assert not {"optimum_at_least", "gap_at_least", "score_at_most"} & figures.keys()


def test_it_is_said_to_be_a_bracket():
    assert describe(played(260.0, 260.0)) == (
        "return 260.00 ± 0.00 over 2 episodes, optimum between 480.00 and 500.00, "
        "best random or constant policy 20.00, score 0.50 to 0.52 (bracketed)"
    )
    assert describe(played(20.0, 20.0)).endswith("score 0.00 (bracketed)")


def test_more_than_any_policy_can_reach_is_said_aloud_and_not_clipped():
    impossible = played(*[501.0] * 10)
    assert impossible.beats_optimum
    assert impossible.summary()["beats_optimum"] is True
    assert impossible.summary()["score"] == pytest.approx(481 / 480)
    assert "THIS IS MORE THAN ANY POLICY CAN REACH" in describe(impossible)


def test_what_is_played_is_measured_too():
    console = Console(file=io.StringIO(), width=200)
    show = SimpleNamespace(returns=[-700.0, -600.0], lengths=[200, 200])
    print_returns(console, spec_of(), show)
    said = "return -650.00 ± 50.00 over 2 episodes, length 200.0\n"
    assert console.file.getvalue().startswith(
        f"{said}optimum between -140.86 and -134.44, best random"
    )
    print_returns(console, spec_of(env_kwargs={"g": 5.0}), show)
    assert console.file.getvalue().endswith(said)
    assert console.file.getvalue().count("\n") == 3


@pytest.mark.parametrize(
    "returns",
    [
        [500.0] * 10,  # the end itself
        [500.0000004] * 10,  # as Monitor rounds
        [490.0, 530.0] * 5,  # starts that were easy
        [530.0] * 9,  # of so few all may have been
    ],
)
def test_chance_and_rounding_are_no_alarm(returns):
    evaluation = played(*returns)
    assert not evaluation.beats_optimum
    assert "MORE THAN" not in describe(evaluation)


def test_a_known_optimum_raises_no_alarm():
    known = Yardstick(100.0, 60.0)
    assert not played(*[120.0] * 10, yardstick=known).beats_optimum


@pytest.mark.parametrize(
    ("entry", "holds"),
    [
        ({}, True),
        ({"normalize": True, "frame_stack": 2}, True),
        ({"train_env_kwargs": {"g": 5.0}}, True),
        ({"env_kwargs": {"g": 10.0}}, True),
        ({"env_kwargs": {"g": 5.0}}, False),
        ({"eval_env_kwargs": {"g": 5.0}}, False),
        ({"env_kwargs": {"max_episode_steps": 100}}, False),
        ({"env_wrapper": {"envs.wrappers.ScaleReward": {"scale": 0.5}}}, False),
        ({"env_wrapper": "gymnasium.wrappers.FlattenObservation"}, True),
        ({"vec_env_wrapper": "stable_baselines3.common.vec_env.VecMonitor"}, False),
    ],
)
def test_where_a_bracket_holds(entry, holds):
    assert (bracketed_yardstick(spec_of(**entry)) is not None) == holds


def test_elsewhere_nothing_is_made_to_find_out(monkeypatch):
    monkeypatch.delattr(sampled, "make_single_env")
    assert bracketed_yardstick(spec_of("FrozenLake-v1")) is None


def train_and_read(spec, folder):
    outcome = train(replace(spec, log_folder=folder), Console(quiet=True), {}, "")
    return json.loads(outcome.run.info_path.read_text())["final"]


def test_a_run_records_the_bracket(tmp_path):
    final, known = train_and_read(spec_of(), tmp_path), bracketed_yardstick(spec_of())
    assert (final["optimum"], final["optimum_at_least"]) == (known.optimum, known.at_least)
    assert final["baseline"] == known.baseline
    assert final["score"] == pytest.approx(known.score(final["mean_return"]))
    assert not final["exact"]


def test_a_run_under_another_gravity_records_none(tmp_path):
    final = train_and_read(spec_of(env_kwargs={"g": 5.0}), tmp_path)
    assert not {"optimum", "baseline", "gap", "score", "optimum_at_least"} & final.keys()


def test_a_run_that_beats_the_bracket_says_so(tmp_path, monkeypatch):
    wrong = OptimumBracket(lower=-5000.0, upper=-4000.0, baseline=-6000.0)
    monkeypatch.setattr(sampled, "optimum_bracket", lambda env: wrong)
    final = train_and_read(replace(spec_of(), final_episodes=10), tmp_path)
    assert final["beats_optimum"] is True
    assert final["score"] > 1
