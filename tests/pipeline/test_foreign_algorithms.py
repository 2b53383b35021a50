"""Algorithms that know nothing of this project: their arguments, their zips, their evaluation."""

import io
import json
import zipfile
from dataclasses import replace

import numpy as np
import pytest
import torch as th
from rich.console import Console
from stable_baselines3 import DQN
from stable_baselines3.common.base_class import BaseAlgorithm
from stable_baselines3.common.policies import BasePolicy

import agents
from pipeline import training
from pipeline.environments import make_evaluation_env
from pipeline.errors import UserError
from pipeline.models.load import hand_written_algorithm, load_model, read_model
from pipeline.settings.components import build_algorithm_kwargs, default_policy, needs_policy
from pipeline.settings.hyperparams import split
from pipeline.settings.values import algorithm_parameters
from pipeline.train_spec import TrainSpec


class FirstPolicy(BasePolicy):
    """Takes the action that was counted most."""

    def __init__(self, observation_space, action_space, lr_schedule=None):
        super().__init__(observation_space, action_space)
        self.register_buffer("counts", th.zeros(int(action_space.n)))

    def _predict(self, observation, deterministic=False):
        return th.full((len(observation),), int(self.counts.argmax()))


class Plain(BaseAlgorithm):
    """As a stranger writes it: no annotations, no seed, no device, no TensorBoard."""

    policy_aliases = {"FirstPolicy": FirstPolicy}  # noqa: RUF012

    def __init__(self, policy, env, weight=0.5, kind="mean", count=3, is_odd=False, choice=None):
        super().__init__(policy, env, learning_rate=0.1, support_multi_env=True)
        self.weight, self.kind, self.count = weight, kind, count
        self._setup_model()

    def _setup_model(self):
        self._setup_lr_schedule()
        self.set_random_seed(self.seed)
        self.policy = self.policy_class(self.observation_space, self.action_space, self.lr_schedule)

    def learn(
        self,
        total_timesteps,
        callback=None,
        log_interval=100,
        tb_log_name="run",
        reset_num_timesteps=True,
        progress_bar=False,
    ):
        total_timesteps, callback = self._setup_learn(
            total_timesteps, callback, reset_num_timesteps, tb_log_name, progress_bar
        )
        callback.on_training_start(locals(), globals())
        while self.num_timesteps < total_timesteps:
            actions = np.array([self.action_space.sample() for _ in range(self.n_envs)])
            _, _, dones, infos = self.env.step(actions)
            self.policy.counts[actions] += self.weight
            self.num_timesteps += self.n_envs
            callback.update_locals(locals())
            if not callback.on_step():
                break
        callback.on_training_end()
        return self


class NoPolicy(Plain):
    """Has no policy to choose, and an argument that only its base class names."""

    def __init__(self, env, **kwargs):
        super().__init__("FirstPolicy", env, **kwargs)


class Silent(Plain):
    """Calls no callback."""

    def learn(self, total_timesteps, *args, **kwargs):
        self.num_timesteps = total_timesteps
        return self


class OneByOne(Plain):
    """Takes one observation at a time."""

    def predict(self, observation, state=None, episode_start=None, deterministic=False):
        return np.array([int(np.asarray(observation).item()) % 4]), None


class Forgetful(Plain):
    """Remembers how often it was asked."""

    def predict(self, observation, state=None, episode_start=None, deterministic=False):
        return np.zeros(len(observation), int), (state or (0,))


class Dice(Plain):
    """Cannot be told to be deterministic."""

    def predict(self, observation, state=None, episode_start=None, deterministic=False):
        return np.random.default_rng().integers(4, size=len(observation)), None


class Rising(DQN):
    def __init__(self, *args, first=0.5, **kwargs):
        super().__init__(*args, **kwargs)
        self.first = first


FOREIGN = (Plain, NoPolicy, Silent, OneByOne, Forgetful, Dice, Rising)


@pytest.fixture(autouse=True)
def registered():
    before = dict(agents.ALGORITHMS)
    for cls in FOREIGN:
        agents.register(cls.__name__.lower(), f"{__name__}:{cls.__name__}")
    yield
    agents.ALGORITHMS.clear()
    agents.ALGORITHMS.update(before)


def spec_of(algo, folder, **settings):
    raw = {"n_timesteps": 60, **settings}
    spec = TrainSpec(algo, "FrozenLake-v1", split(raw), raw, seed=3, verbose=0, pictures=False)
    return replace(spec, log_folder=folder, eval_freq=20, eval_episodes=4)


def train(spec):
    return training.train(spec, Console(quiet=True), {}, "")


# --- arguments -----------------------------------------------------------------------------------


def test_arguments_behind_kwargs_are_known():
    assert {"first", "policy", "env", "gamma", "seed"} <= algorithm_parameters(Rising).keys()
    assert {"weight", "env"} <= algorithm_parameters(NoPolicy).keys()
    assert not needs_policy(NoPolicy, {"policy": "x"})
    assert needs_policy(Plain, {})
    assert not needs_policy(Plain, {"policy": "FirstPolicy"})


@pytest.mark.parametrize(
    ("given", "wanted"),
    [
        ({"weight": "1e-4"}, {"weight": 1e-4}),
        ({"weight": 2}, {"weight": 2.0}),
        ({"weight": "auto"}, {"weight": "auto"}),
        ({"weight": None}, {"weight": None}),
        ({"count": "7"}, {"count": 7}),
        ({"count": 0.5}, {"count": 0.5}),
        ({"is_odd": True, "choice": [1], "kind": "max"}, None),
    ],
)
def test_what_has_no_annotation_is_read_as_its_default(given, wanted):
    kwargs = build_algorithm_kwargs(Plain, {"policy": "FirstPolicy", **given}, "plain")
    assert kwargs == {"policy": "FirstPolicy", **(wanted or given)}


@pytest.mark.parametrize(
    ("algorithm", "kwargs", "complaint"),
    [
        (Plain, {"wieght": 1}, "unknown hyperparameter 'wieght': did you mean 'weight'?"),
        (Plain, {"policy": "Frst"}, "unknown policy 'Frst'"),
        (Rising, {"policy": "MlpPolicy", "gamma": "high"}, "gamma must be a number, not 'high'"),
        (Rising, {"policy": "MlpPolicy", "seed": 1}, "seed is set by --seed, not here"),
        (NoPolicy, {"count": 1, "env": 1}, "env is set by --env, not here"),
    ],
)
def test_a_wrong_argument_is_told(algorithm, kwargs, complaint):
    with pytest.raises(UserError) as caught:
        build_algorithm_kwargs(algorithm, {"policy": "FirstPolicy", **kwargs}, "mine")
    assert complaint in str(caught.value)


def test_the_policy_when_none_is_said():
    assert default_policy(DQN, is_dict=False) == "MlpPolicy"
    assert default_policy(DQN, is_dict=True) == "MultiInputPolicy"
    assert default_policy(Plain, is_dict=False) == "FirstPolicy"
    assert default_policy(BaseAlgorithm, is_dict=True) == "MultiInputPolicy"


# --- training and playing ------------------------------------------------------------------------


@pytest.mark.parametrize("algo", ["plain", "nopolicy", "silent"])
def test_it_is_trained_saved_and_loaded(algo, tmp_path):
    outcome = train(spec_of(algo, tmp_path, weight=0.25))
    assert outcome.final.is_exact
    spec = spec_of(algo, tmp_path)
    model = load_model(algo, outcome.run.model_path, make_evaluation_env(spec, 1), device="cpu")
    assert type(model) is {"plain": Plain, "nopolicy": NoPolicy, "silent": Silent}[algo]
    assert model.weight == 0.25
    assert model.policy.counts.sum() == (0 if algo == "silent" else 15)


def test_the_seed_counts_without_an_argument_for_it(tmp_path):
    counts = []
    for seed in (3, 3, 4):
        outcome = train(replace(spec_of("plain", tmp_path), seed=seed))
        counts.append(load_model("plain", outcome.run.model_path).policy.counts.tolist())
    assert counts[0] == counts[1] != counts[2]


@pytest.mark.parametrize(
    ("algo", "reason"),
    [
        ("onebyone", "predict takes no batch of observations (ValueError)"),
        ("forgetful", "predict remembers what it saw before"),
        ("dice", "predict draws its actions at random"),
    ],
)
def test_what_cannot_be_asked_for_all_states_is_sampled(algo, reason, tmp_path):
    console = Console(record=True, width=200, file=io.StringIO())
    outcome = training.train(spec_of(algo, tmp_path), console, {}, "")
    assert f"evaluations are sampled, not exact: {reason}" in console.export_text()
    assert not outcome.final.is_exact
    assert len(outcome.final.returns) == 100
    with np.load(outcome.run.evaluations_path) as evaluations:
        assert evaluations["results"].shape == (3, 4)


def test_a_class_that_is_none_is_told_before_anything_is_made(tmp_path):
    agents.register("typo", f"{__name__}:Typo")
    with pytest.raises(UserError, match=r"typo is registered as .*:Typo, which does not exist"):
        train(spec_of("typo", tmp_path / "logs"))
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize(
    ("says", "algo"), [("Plain", None), ("DQN", None), ("QLearning", "qlearning"), (3, None)]
)
def test_a_zip_says_what_it_is_where_it_holds_json(says, algo, tmp_path):
    path = tmp_path / "model.zip"
    with zipfile.ZipFile(path, "w") as archive:
        archive.writestr("data", json.dumps({"algorithm": says}))
        th.save({}, policy := io.BytesIO())
        archive.writestr("policy.pth", policy.getvalue())
    assert hand_written_algorithm(read_model(path)) == algo
