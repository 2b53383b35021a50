"""Trials of rl_zoo3's searches as settings; the studies are made here, with its names."""

import json

import optuna
import pytest
from optuna.distributions import CategoricalDistribution, FloatDistribution
from optuna.storages import JournalStorage
from optuna.storages.journal import JournalFileBackend
from optuna.trial import create_trial

from rl_yardstick.commands.train import build_parser, spec_from_flags
from rl_yardstick.pipeline.errors import UserError
from rl_yardstick.pipeline.settings import from_trial
from rl_yardstick.tuning.reading import settings_of_trial

CART = "CartPole-v1"
# What rl_zoo3 stores for a trial, and the hyperparameters that it makes of it.
NOW = {"batch_size_pow": 5, "n_steps_pow": 6, "one_minus_gamma": 0.25, "one_minus_gae_lambda": 0.5}
NOW |= {"net_arch": "tiny", "activation_fn": "relu", "learning_rate": 0.001}
BEFORE = {
    "batch_size": 64,
    "n_steps": 32,
    "gamma": 0.75,
    "gae_lambda": 0.5,
    "lr_schedule": "linear",
}
BEFORE |= {"net_arch": "tiny", "activation_fn": "tanh", "learning_rate": 0.001}
TWO = {"net_arch": {"pi": [64], "vf": [64]}}
OFF_POLICY = {"one_minus_gamma": 0.25, "net_arch": "big", "train_freq": 7}
GOALS = {"n_sampled_goal": 2, "goal_selection_strategy": "final"}
GENERAL = {"gamma": 0.75, "gae_lambda": 0.5, "batch_size": 32}
TRIALS = [
    ("ppo", NOW, {**GENERAL, "n_steps": 64, "learning_rate": 0.001,
                  "policy_kwargs": {**TWO, "activation_fn": "nn.ReLU"}}),
    ("ppo", BEFORE, {**GENERAL, "n_steps": 32, "learning_rate": "lin_0.001",
                     "policy_kwargs": {**TWO, "activation_fn": "nn.Tanh", "ortho_init": False}}),
    ("dqn", {**OFF_POLICY, "subsample_steps": 3, **GOALS},
     {"gamma": 0.75, "train_freq": 7, "gradient_steps": 2, "replay_buffer_kwargs": GOALS,
      "policy_kwargs": {"net_arch": [400, 300]}}),
    ("tqc", {**OFF_POLICY, "n_quantiles": 9},
     {"gamma": 0.75, "train_freq": 7, "gradient_steps": 7,
      "policy_kwargs": {"net_arch": [400, 300], "n_quantiles": 9}}),
    ("td3", {"noise_type": None, "noise_std": 0.5, "tau": 0.25}, {"tau": 0.25}),
    ("ars", {"n_delta_pow": 3, "top_frac_size": 0.3}, {"n_delta": 8, "n_top": 2}),
]  # fmt: skip


@pytest.mark.parametrize(("algo", "params", "settings"), TRIALS)
def test_a_trial_means_what_rl_zoo3_makes_of_it(algo, params, settings):
    assert from_trial(algo, params) == settings
    assert from_trial(algo, settings) == settings


def fill(storage):
    """A study of two finished trials and one that was stopped, and another without any."""
    study = optuna.create_study(study_name="ppo", storage=storage, direction="maximize")
    for value, rate in ((1.0, 0.01), (3.0, 0.02), (None, 0.03)):
        params = {**NOW, "learning_rate": rate}
        kinds = {name: CategoricalDistribution([held]) for name, held in params.items()}
        kinds["learning_rate"] = FloatDistribution(1e-5, 1)
        state = optuna.trial.TrialState.COMPLETE if value else optuna.trial.TrialState.FAIL
        given = {"params": params, "distributions": kinds, "value": value, "state": state}
        study.add_trial(create_trial(**given))
    optuna.create_study(study_name="empty", storage=storage)


@pytest.fixture(params=["sqlite:///zoo studies.db", "zoo.log"])
def storage(request, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    is_log = request.param.endswith(".log")
    fill(JournalStorage(JournalFileBackend(request.param)) if is_log else request.param)
    return request.param


def test_a_study_gives_its_best_trial_or_another_and_stays_as_it_is(storage, tmp_path):
    before = {path.name: path.read_bytes() for path in tmp_path.iterdir()}
    for number, chosen, rate in ((None, 1, 0.02), (0, 0, 0.01), (2, 2, 0.03)):
        words = ["--env", CART, "--storage", storage, "--study-name", "ppo", "--device", "cpu"]
        words += [] if number is None else ["--trial-id", str(number)]
        args = build_parser().parse_args([*words, "-params", "n_epochs:3"])
        spec = spec_from_flags(args)
        assert (args.study_name, args.trial_id) == ("ppo", chosen)
        found = spec.algorithm
        assert (found["learning_rate"], found["n_steps"], found["n_epochs"]) == (rate, 64, 3)
        assert found["policy_kwargs"] == {**TWO, "activation_fn": "nn.ReLU"}
    for name, trial, said in (
        (None, None, "has 2 studies: give --study-name, one of ppo, empty"),
        ("pop", None, "has no study 'pop': did you mean 'ppo'"),
        ("empty", None, "empty has no best trial: give --trial-id"),
        ("ppo", 3, "ppo has 3 trials, and no 3"),
    ):
        with pytest.raises(UserError, match=said):
            settings_of_trial("ppo", storage, name, trial)
    assert {path.name: path.read_bytes() for path in tmp_path.iterdir()} == before


WRONG = {
    "none.log": "none.log: no such file",
    "sqlite:///none.db": "none.db: no such file",
    "mysql://me@host/x.log": "--storage is sqlite:///FILE or a journal FILE.log",
    "zoo.db": "--storage is sqlite:///FILE or a journal FILE.log",
    "empty.log": "has 0 studies",
    "wrong.log": "holds no Optuna study",
    "sqlite:///wrong.log": "holds no Optuna study: file is not a database",
    "sqlite:///empty.log": "holds no Optuna study",
}


@pytest.mark.parametrize("place", WRONG)
def test_what_holds_no_study_is_refused_and_not_made(place, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "empty.log").touch()
    (tmp_path / "wrong.log").write_text('{"op_code": 4, "worker_id": "x"}\n' * 200)
    with pytest.raises(UserError, match=WRONG[place]) as refused:
        settings_of_trial("ppo", place, None, None)
    assert str(refused.value).isprintable()
    assert {path.name for path in tmp_path.iterdir()} == {"empty.log", "wrong.log"}
    assert (tmp_path / "empty.log").read_bytes() == b""


def test_a_file_of_one_trial_or_of_one_run_is_a_conf_file(tmp_path):
    for text, n_steps in ((json.dumps(NOW), 64), ("n_steps: 16\nnormalize: 'dict(gamma=0.5)'", 16)):
        (tmp_path / "best.yml").write_text(text)
        words = ["--env", CART, "--conf-file", str(tmp_path / "best.yml"), "-n", "9"]
        spec = spec_from_flags(build_parser().parse_args(words))
        assert spec.algorithm["n_steps"] == n_steps
    for text, said in (
        ("n_steps_pow: 1000000000\ngamma: 1", "n_steps_pow: must be a number from 0 to 63"),
        ("gamma: 1\nnet_arch: tinny", "has no net_arch 'tinny': did you mean 'tiny'"),
        ("gamma: 1\ntop_frac_size: 1", "best.yml: these are no hyperparameters"),
        ("Acrobot-v1: {gamma: 1}", "no entry for 'CartPole-v1'"),
    ):
        (tmp_path / "best.yml").write_text(text)
        with pytest.raises(UserError, match=said):
            spec_from_flags(build_parser().parse_args(words))
