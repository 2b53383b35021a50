"""Trials of rl_zoo3's searches as settings; the studies are made here, with its names."""

import json

import optuna
import pytest
from optuna.distributions import CategoricalDistribution
from optuna.storages import JournalStorage
from optuna.storages.journal import JournalFileBackend
from optuna.trial import TrialState, create_trial

from rl_yardstick.commands.train import build_parser, spec_from_flags
from rl_yardstick.pipeline.errors import UserError
from rl_yardstick.pipeline.settings import from_trial
from rl_yardstick.tuning.reading import settings_of_trial

CART = "CartPole-v1"
# What rl_zoo3 stores for a trial, and the hyperparameters that it makes of it.
NOW = {"batch_size_pow": 5, "n_steps_pow": 6, "one_minus_gamma": 0.25, "activation_fn": "relu"}
NOW |= {"net_arch": "tiny", "learning_rate": 0.001}
BEFORE = {"batch_size": 64, "n_steps": 32, "gamma": 0.75, "activation_fn": "relu"}
BEFORE |= {"net_arch": "tiny", "learning_rate": 0.001, "lr_schedule": "linear"}
RELU = {"net_arch": {"pi": [64], "vf": [64]}, "activation_fn": "nn.ReLU"}
GENERAL = {"gamma": 0.75, "batch_size": 32}
BIG = {"one_minus_gamma": 0.25, "net_arch": "big", "train_freq": 7, "n_quantiles": 9}
GOALS = {"n_sampled_goal": 2, "goal_selection_strategy": "final"}
MADE = {"gamma": 0.75, "train_freq": 7, "policy_kwargs": {"net_arch": [400, 300], "n_quantiles": 9}}
LATE = {**GENERAL, "n_steps": 64, "learning_rate": 0.001, "policy_kwargs": RELU}
EARLY = {**GENERAL, "n_steps": 32, "learning_rate": "lin_0.001"}
TRIALS = [
    ("ppo", NOW, LATE),
    ("ppo", BEFORE, {**EARLY, "policy_kwargs": {**RELU, "ortho_init": False}}),
    ("qrdqn", {**BIG, "subsample_steps": 3}, {**MADE, "gradient_steps": 2}),
    ("tqc", {**BIG, **GOALS}, {**MADE, "gradient_steps": 7, "replay_buffer_kwargs": GOALS}),
    ("td3", {"noise_type": None, "noise_std": 0.5, "tau": 0.25}, {"tau": 0.25}),
    ("ars", {"n_delta_pow": 3, "top_frac_size": 0.3}, {"n_delta": 8, "n_top": 2}),
]


@pytest.mark.parametrize(("algo", "params", "settings"), TRIALS)
def test_a_trial_means_what_rl_zoo3_makes_of_it(algo, params, settings):
    assert from_trial(algo, params) == settings
    assert from_trial(algo, settings) == settings


@pytest.fixture(params=["sqlite:///zoo studies.db", "zoo.log"])
def storage(request, tmp_path, monkeypatch):
    """A study of two finished trials and one that failed, and another without any."""
    monkeypatch.chdir(tmp_path)
    is_log = request.param.endswith(".log")
    opened = JournalStorage(JournalFileBackend(request.param)) if is_log else request.param
    study = optuna.create_study(study_name="ppo", storage=opened, direction="maximize")
    for value, rate in ((1.0, 0.01), (3.0, 0.02), (None, 0.03)):
        params = {**NOW, "learning_rate": rate}
        kinds = {name: CategoricalDistribution([NOW[name], 0.01, 0.02, 0.03]) for name in params}
        end = {"value": value, "state": TrialState.COMPLETE if value else TrialState.FAIL}
        study.add_trial(create_trial(params=params, distributions=kinds, **end))
    optuna.create_study(study_name="empty", storage=opened)
    return request.param


def spec_of(*words):
    args = build_parser().parse_args(["--env", CART, "--device", "cpu", *words])
    return spec_from_flags(args), args


def test_a_study_gives_its_best_trial_or_another_and_stays_as_it_is(storage, tmp_path):
    before = {path.name: path.read_bytes() for path in tmp_path.iterdir()}
    for words, chosen, rate in (([], 1, 0.02), (["--trial-id", "2"], 2, 0.03)):
        typed = ["--storage", storage, "--study-name", "ppo", *words, "-params", "n_epochs:3"]
        spec, args = spec_of(*typed)
        assert (args.study_name, args.trial_id) == ("ppo", chosen)
        found = spec.algorithm
        assert (found["learning_rate"], found["n_steps"], found["n_epochs"]) == (rate, 64, 3)
        assert found["policy_kwargs"] == RELU
    for name, said in (
        (None, "has 2 studies: give --study-name, one of ppo, empty"),
        ("pop", "has no study 'pop': did you mean 'ppo'"),
        ("empty", "empty has 0 trials, and no 3"),
    ):
        with pytest.raises(UserError, match=said):
            settings_of_trial("ppo", storage, name, 3)
    with pytest.raises(UserError, match="empty has no best trial: give --trial-id"):
        settings_of_trial("ppo", storage, "empty", None)
    assert {path.name: path.read_bytes() for path in tmp_path.iterdir()} == before


WRONG = {
    "none.log": "none.log: no such file",
    "mysql://me@host/x.log": "--storage is sqlite:///FILE or a journal FILE.log, not",
    "empty.log": "has 0 studies",
    "wrong.log": "holds no Optuna study",
    "sqlite:///wrong.log": "holds no Optuna study: file is not a database",
    "sqlite:///empty.log": "holds no Optuna study",
}


def test_what_holds_no_study_is_refused_and_not_made(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "empty.log").touch()
    (tmp_path / "wrong.log").write_text('{"op_code": 4, "worker_id": "x"}\n' * 200)
    for place, said in WRONG.items():
        with pytest.raises(UserError, match=said) as refused:
            settings_of_trial("ppo", place, None, None)
        assert str(refused.value).isprintable()
    assert {path.name for path in tmp_path.iterdir()} == {"empty.log", "wrong.log"}
    assert (tmp_path / "empty.log").read_bytes() == b""


CONF = {
    json.dumps(NOW): 64,
    "n_steps: 16\nnormalize: 'dict(gamma=0.5)'": 16,
    "n_steps_pow: 1000000000\ngamma: 1": "n_steps_pow: must be a number from 0 to 63",
    "gamma: 1\nnet_arch: tinny": "has no net_arch 'tinny': did you mean 'tiny'",
    "gamma: 1\ntop_frac_size: 1": "best.yml: these are no hyperparameters",
}


@pytest.mark.parametrize("text", CONF)
def test_a_file_of_one_trial_or_of_one_run_is_a_conf_file(tmp_path, text):
    (tmp_path / "best.yml").write_text(text)
    words = ["--conf-file", str(tmp_path / "best.yml"), "-n", "9"]
    if isinstance(CONF[text], int):
        assert spec_of(*words)[0].algorithm["n_steps"] == CONF[text]
    else:
        with pytest.raises(UserError, match=CONF[text]):
            spec_of(*words)
