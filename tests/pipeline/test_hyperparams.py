"""Files of hyperparameters: rl_zoo3's load unchanged; the shipped ones make agents that fit."""

from pathlib import Path

import gymnasium as gym
import numpy as np
import pytest
import yaml
from gymnasium.spaces import Box

from rl_yardstick.agents import ALGORITHMS, load_algorithm
from rl_yardstick.envs.known_models import transition_model
from rl_yardstick.pipeline.agent_settings import (
    check_fit,
    resolved_spec,
    training_follows,
    without_auto,
)
from rl_yardstick.pipeline.environments import make_single_env
from rl_yardstick.pipeline.errors import UserError
from rl_yardstick.pipeline.evaluation.exact import discount_note, exact_evaluator
from rl_yardstick.pipeline.settings import hyperparams
from rl_yardstick.pipeline.settings.components import (
    action_noise,
    build_algorithm_kwargs,
    callbacks,
    default_policy,
    vec_wrapper_factory,
)
from rl_yardstick.pipeline.settings.hyperparams import (
    SPECIAL_KEYS,
    TUNED_ON,
    entry_names,
    override,
    read_hyperparams,
    seeds_tuned_on,
    split,
)
from rl_yardstick.pipeline.settings.values import constructor_parameters
from rl_yardstick.pipeline.settings.yaml import read_yaml
from tests.peers.peer_environment import peer_folder

ZOO = peer_folder("rl_zoo3") / "hyperparams"
ZOO_FILES = sorted(ZOO.glob("*.yml"))
FOLDER = Path(hyperparams.__file__).parents[2] / "hyperparams"
FILES = sorted(FOLDER.glob("*.yml"))
READ = {path.stem: read_yaml(path) for path in FILES}
SPECIALISTS = {"angle"}  # whose entries stand in for no others


# --- rl_zoo3's own files -------------------------------------------------------------------------


@pytest.mark.parametrize("path", ZOO_FILES, ids=lambda path: path.stem)
def test_rl_zoo3_entries_load_unchanged(path):
    algo, read = path.stem, read_yaml(path)
    assert read == yaml.safe_load(path.read_text())
    assert entry_names(algo, path) == [name for name in read if name not in {"default", "atari"}]
    for env_id, raw in read.items():
        hyperparams = split(raw, env_id)
        assert hyperparams.n_timesteps == int(float(raw["n_timesteps"]))
        assert hyperparams.n_envs == raw.get("n_envs", 1)
        if algo == "her":  # it says of itself that it is no longer used
            continue
        if (algo, env_id) == ("ppo_lstm", "default"):
            # A slip that rl_zoo3 stumbles over itself: RecurrentPPO knows no MlpPolicy.
            with pytest.raises(UserError, match="'MlpPolicy': did you mean 'MlpLstmPolicy'"):
                build_algorithm_kwargs(load_algorithm(algo), hyperparams.algorithm, algo)
            continue
        built = build_algorithm_kwargs(load_algorithm(algo), hyperparams.algorithm, env_id)
        # Nothing is left over, and nothing is lost.
        assert built.keys() == raw.keys() - set(SPECIAL_KEYS)
        noise = action_noise(hyperparams, Box(-1, 1, (3,)))
        assert noise.keys() == ({"action_noise"} if "noise_type" in raw else set())


# --- which entry ---------------------------------------------------------------------------------

ENTRIES = """\
default: {gamma: 0.1}
atari: {gamma: 0.2}
CartPole-v1: {gamma: 0.3}
CliffWalking-v1: {gamma: 0.4}
CliffWalkingSlippery-v1: {gamma: 0.5}
FrozenLake-v1: {gamma: 0.6}
FrozenLake8x8-v1: {gamma: 0.7}
"""


@pytest.fixture
def file(tmp_path):
    def write(text):
        (tmp_path / "mine.yml").write_text(text)
        return tmp_path / "mine.yml"

    return write


@pytest.mark.parametrize(
    ("env_id", "kwargs", "gamma"),
    [
        ("CartPole-v1", None, 0.3),
        ("envs:Warehouse-v0", None, 0.1),
        ("ale_py:ALE/Pong-v5", None, 0.2),
        # An environment has its entry by whichever of its names.
        ("gymnasium:CliffWalking-v1", {"is_slippery": True}, 0.5),
        ("FrozenLake-v1", {"map_name": "8x8"}, 0.6),  # FrozenLake8x8-v1 has another time limit
    ],
)
def test_which_entry_is_taken(file, env_id, kwargs, gamma):
    assert read_hyperparams("sarsa", env_id, file(ENTRIES), kwargs) == {"gamma": gamma}


# --- the seeds that entries were tuned on --------------------------------------------------------

TUNED = """\
tuned_on:
  Lake-v0: {first: 0, count: 10}
  Cliff-v0: [{first: 0, count: 1}, {first: 100, count: 2}]

default: {n_timesteps: 5}
Lake-v0: {n_timesteps: 6}
Cliff-v0: {n_timesteps: 7}
"""


def test_each_entry_has_its_seeds_which_are_no_hyperparameter_and_no_environment(file):
    path = file(TUNED)
    assert seeds_tuned_on("dqn", "Lake-v0", path) == (range(10),)
    assert seeds_tuned_on("an_agent_without_a_file", "Lake-v0") is None
    assert seeds_tuned_on("dqn", "module:Cliff-v0", path) == (range(1), range(100, 102))
    assert seeds_tuned_on("dqn", "Elsewhere-v0", path) == ()
    assert read_hyperparams("dqn", "Lake-v0", path) == {"n_timesteps": 6}
    assert read_hyperparams("dqn", "tuned_on", path) == {"n_timesteps": 5}
    assert entry_names("dqn", path) == ["Lake-v0", "Cliff-v0"]
    # Who does not say is not known.
    assert seeds_tuned_on("dqn", "Lake-v0", file("default: {n_timesteps: 5}\n")) is None


# --- the shipped files ---------------------------------------------------------------------------


def spec_of(algo, env_id):
    return resolved_spec(read_hyperparams(algo, env_id), algo=algo, env_id=env_id, seed=0)


def test_every_file_is_an_agents_and_every_agent_has_one():
    assert {path.stem for path in FILES} == set(ALGORITHMS)
    names = {f"{name}.yml" for name in ALGORITHMS}
    assert {path.name for path in FOLDER.iterdir()} == {*names, "search_spaces"}


@pytest.mark.parametrize("algo", READ)
def test_every_entry_builds_and_fits_its_agent_and_environment(algo, tmp_path):
    names = [name for name in READ[algo] if name != TUNED_ON]
    assert set(names) - {"default"} <= set(gym.registry)
    assert entry_names(algo) == [name for name in names if name != "default"]
    assert ("default" in names) == (algo not in SPECIALISTS)
    algorithm = load_algorithm(algo)
    defaults = constructor_parameters(algorithm)
    assert seeds_tuned_on(algo, "Other-v0") == ()
    for key in names:
        # With numbers for ``auto``; stand-ins have no environment to ask.
        spec = None if key == "default" else spec_of(algo, key)
        entry = split(READ[algo][key]) if spec is None else spec.hyperparams
        assert [entry.n_timesteps, entry.n_episodes].count(None) == 1
        given = {"policy": default_policy(algorithm, is_dict=False), **entry.algorithm}
        kwargs = build_algorithm_kwargs(algorithm, given, algo)
        assert set(kwargs) == set(given)
        assert kwargs["policy"] in algorithm.policy_aliases
        vec_wrapper_factory(entry.vec_env_wrapper)
        assert len(callbacks(entry.callback, save_path=tmp_path)) == len(entry.callback)
        # A budget from the command line replaces the entry's.
        changed = override(READ[algo][key], {"n_episodes": 3})
        assert split(without_auto(changed)).n_timesteps is None
        if spec is None:
            continue
        check_entry_fits(algo, spec)
        # Who leaves everything but the policy as it is says nothing of seeds.
        chosen = [k for k, v in given.items() if k != "policy" and v != defaults[k].default]
        assert bool(seeds_tuned_on(algo, key)) == bool(chosen), (key, chosen)
        for seeds in seeds_tuned_on(algo, key):
            assert not set(seeds) & set(range(1000, 2000))  # which are kept for judgement


def check_entry_fits(algo, spec):
    check_fit(spec)
    training, evaluation = make_single_env(spec, training=True), make_single_env(spec)
    # What was learnt in the one must be of use in the other.
    assert training.observation_space == evaluation.observation_space
    assert training.action_space == evaluation.action_space
    assert ALGORITHMS[algo].misfit(evaluation.observation_space, evaluation.action_space) == ""
    for env in (training, evaluation):
        env.reset(seed=0)
        env.step(env.action_space.sample())
        env.close()


# --- what ``auto`` stands for, what wins over an entry, and what a discount costs ----------------


def spec_of_entry(env_id, raw, algo="qlearning"):
    return resolved_spec(raw, algo=algo, env_id=env_id, seed=0)


SCALED = {"train_env_wrapper": {"rl_yardstick.envs.wrappers.ScaleReward": {"scale": "auto"}}}
CLIP = {"gymnasium.wrappers.ClipReward": {"min_reward": "auto"}}
SHORT = {"max_episode_steps": 200}
POOR = {"shelf_reward": -1, "step_reward": -0.01, "goal_reward": 1}


LAKE_OF_SEVEN = {"reward_schedule": (7, -3, 0)}


@pytest.mark.parametrize(
    ("env_id", "raw", "value"),
    [
        ("FrozenLake-v1", {"gamma": "auto"}, 0.995),
        # Ten times the shortest way of 18 moves.
        ("RandomWarehouse-v0", {"gamma": "auto"}, 0.9972222),
        ("CliffWalking-v1", {"gamma": "auto", "eval_env_kwargs": SHORT}, 0.9975),
        ("RandomWarehouse-v0", {"n_timesteps": "auto_1000", "env_kwargs": {"size": 30}}, 3_600_000),
        ("Warehouse-v0", {"learning_rate": "auto", "n_timesteps": "auto"}, "exp_0.3_0.004"),
        ("FrozenLake-v1", {"initial_q": "auto", "env_kwargs": LAKE_OF_SEVEN}, 7.0),
        ("Warehouse-v0", {"value_bound": "auto", "env_kwargs": POOR}, 1.0),
    ],
)
def test_the_word_becomes_a_number_of_the_environment(env_id, raw, value):
    spec = spec_of_entry(env_id, raw)
    entry, key = spec.saved_hyperparams, next(iter(raw))
    assert spec.hyperparams == split(entry)
    assert entry[key] == value
    assert set(spec.origins) == {name for name in raw if raw[name] != entry[name]}
    assert spec.origins[key].startswith("auto")
    assert list(entry) == list(raw)


def test_the_dearest_step_of_training_costs_a_tenth_of_the_goal():
    wrappers = [CLIP, SCALED["train_env_wrapper"]]
    spec = spec_of_entry("Warehouse-v0", {"train_env_wrapper": wrappers})
    model = transition_model(make_single_env(spec, training=True))
    possible = model.reward[model.prob > 0]
    assert np.unique(possible[possible != 0]) == pytest.approx((-0.1, -0.01, 1))
    assert set(spec.origins) == {"train_env_wrapper"}


class Unknown(gym.Env):
    """Nobody knows its model."""

    observation_space = action_space = gym.spaces.Discrete(2)

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        return 0, {}


@pytest.mark.parametrize(
    ("env_id", "raw", "said"),
    [
        ("Warehouse-v0", {"gamma": "auto_5"}, "gamma: 'auto_5' is not auto"),
        (
            "Warehouse-v0",
            {"n_timesteps": "auto_0"},
            "n_timesteps: 'auto_0' is not auto, or auto_1000",
        ),
        ("Unknown-v0", {"initial_q": "auto"}, "initial_q: auto needs an environment whose model"),
        ("Unknown-v0", SCALED, "scale: auto needs an environment whose model is known"),
        ("Unknown-v0", {"train_env_wrapper": CLIP}, "min_reward: auto needs an environment whose"),
        ("CartPole-v1", {"n_timesteps": "auto"}, "qlearning does not fit CartPole-v1"),
    ],
)
def test_what_cannot_be_worked_out_is_refused(env_id, raw, said):
    gym.register("Unknown-v0", Unknown)
    try:
        with pytest.raises(UserError, match=said):
            spec_of_entry(env_id, raw)
    finally:
        del gym.registry["Unknown-v0"]


def test_what_is_asked_for_wins_over_an_entrys_variant_for_training():
    variant = {"random_start": True, "shelf_reward": -10}
    for shelf, more, kept, is_told in (
        (-1, {}, {"random_start": True}, True),
        (-10, {}, {"random_start": True}, False),
        (-1, {"train_env_kwargs": {"shelf_reward": -10}}, variant, False),  # for training too
    ):
        typed = {"env_kwargs": {"shelf_reward": shelf}, **more}
        entry = {**typed, "train_env_kwargs": variant}
        found, told = training_follows(entry, typed)
        assert found == {**entry, "train_env_kwargs": kept}
        line = "without shelf_reward: -10, because"
        assert told["train_env_kwargs"].startswith(line) if is_told else told is None


DEAR = "at gamma 0.99 even exact planning scores 0.00 here; 0.9995: 1.00 (gamma: auto)"


@pytest.mark.parametrize(
    ("slip", "gamma", "note"),
    [
        (0.2, 0.99, DEAR),
        (0.2, 0.9995, None),
        (0.0, 0.5, None),  # the shortest way is the best at any discount
    ],
)
def test_what_a_discount_costs_is_planned_exactly(slip, gamma, note):
    spec = spec_of_entry("Warehouse-v0", {"n_timesteps": 1, "env_kwargs": {"slip": slip}})
    assert discount_note(spec, exact_evaluator(spec), gamma) == note
