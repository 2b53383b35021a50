"""The hyperparameters that come with the project: every entry makes an agent that fits."""

from pathlib import Path

import gymnasium as gym
import pytest

from agents import ALGORITHMS, load_algorithm
from pipeline.agent_settings import check_fit, resolved_spec, without_auto
from pipeline.environments import make_single_env, make_training_env
from pipeline.preparation import algorithm_kwargs
from pipeline.settings import hyperparams
from pipeline.settings.components import (
    build_algorithm_kwargs,
    callbacks,
    default_policy,
    vec_wrapper_factory,
)
from pipeline.settings.hyperparams import (
    entry_names,
    override,
    read_hyperparams,
    seeds_tuned_on,
    split,
)
from pipeline.settings.values import constructor_parameters
from pipeline.settings.yaml import read_yaml

FOLDER = Path(hyperparams.__file__).parents[2] / "hyperparams"
FILES = sorted(FOLDER.glob("*.yml"))
READ = {path.stem: read_yaml(path) for path in FILES}
ENTRIES = [
    (algo, key) for algo, read in READ.items() for key in read if key != hyperparams.TUNED_ON
]

# Agents of one environment alone have no entry that stands in for others.
SPECIALISTS = {"angle"}


class Valid(gym.Env):
    """A step long, of two actions; the second is valid."""

    observation_space = gym.spaces.Discrete(2)
    action_space = gym.spaces.Discrete(2)

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        return 0, {}

    def action_masks(self):
        return [False, True]

    def step(self, action):
        return 1, float(action), True, False, {}


@pytest.fixture(autouse=True, scope="module")
def masked_env():
    gym.register("Valid-v0", Valid)
    yield
    del gym.registry["Valid-v0"]


def spec_of(algo, env_id, **changes):
    raw = override(read_hyperparams(algo, env_id), changes)
    return resolved_spec(raw, algo=algo, env_id=env_id, seed=0)


def read_as_run(algo, key):
    """An entry's settings, with numbers for ``auto``; stand-ins have no environment to ask."""
    return split(READ[algo][key]) if key == "default" else spec_of(algo, key).hyperparams


def environment_for(algo):
    """One that the agent's file names, or any that fits where the file has a default alone."""
    for env_id in [
        *entry_names(algo),
        "FrozenLake-v1",
        "CartPole-v1",
        "GaussianBandit-v0",
        "Pendulum-v1",
        "Valid-v0",
    ]:
        env = gym.make(env_id)
        fits = ALGORITHMS[algo].env_misfit(env) == ""
        env.close()
        if fits or env_id in entry_names(algo):
            return env_id
    raise LookupError(algo)


def test_every_file_is_an_agents_and_every_agent_has_one():
    assert {path.stem for path in FILES} == set(ALGORITHMS)
    names = {f"{name}.yml" for name in ALGORITHMS}
    assert {path.name for path in FOLDER.iterdir()} == {*names, "search_spaces"}


@pytest.mark.parametrize("path", FILES, ids=lambda path: path.stem)
def test_every_file_names_known_environments(path):
    names = [name for name in READ[path.stem] if name != hyperparams.TUNED_ON]
    assert set(names) - {"default"} <= set(gym.registry)
    assert entry_names(path.stem) == [name for name in names if name != "default"]
    assert ("default" in names) == (path.stem not in SPECIALISTS)


@pytest.mark.parametrize(("algo", "key"), ENTRIES)
def test_every_entry_says_how_long_to_train_and_builds_its_agents_arguments(algo, key):
    entry, spec = READ[algo][key], read_as_run(algo, key)
    assert [spec.n_timesteps, spec.n_episodes].count(None) == 1
    algorithm = load_algorithm(algo)
    given = {"policy": default_policy(algorithm, is_dict=False), **spec.algorithm}
    kwargs = build_algorithm_kwargs(algorithm, given, algo)
    assert set(kwargs) == set(given)
    assert kwargs["policy"] in algorithm.policy_aliases
    # A budget from the command line replaces the entry's.
    assert split(without_auto(override(entry, {"n_episodes": 3}))).n_timesteps is None


@pytest.mark.parametrize(("algo", "env_id"), [entry for entry in ENTRIES if entry[1] != "default"])
def test_every_entry_fits_its_environment(algo, env_id):
    spec = spec_of(algo, env_id)
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


@pytest.mark.parametrize(("algo", "key"), ENTRIES)
def test_every_entry_names_components_that_there_are(algo, key, tmp_path):
    spec = read_as_run(algo, key)
    vec_wrapper_factory(spec.vec_env_wrapper)
    assert len(callbacks(spec.callback, save_path=tmp_path)) == len(spec.callback)


@pytest.mark.parametrize("algo", ALGORITHMS)
def test_every_entry_that_somebody_chose_says_on_which_seeds(algo):
    """Those that leave everything but the policy as it is say nothing, and no stand-in does."""
    parameters = constructor_parameters(load_algorithm(algo))
    for name, key in ENTRIES:
        if name == algo and key != "default":
            settings = read_as_run(algo, key).algorithm
            chosen = [
                k for k, v in settings.items() if k != "policy" and v != parameters[k].default
            ]
            assert bool(seeds_tuned_on(algo, key)) == bool(chosen), (key, chosen)
    assert seeds_tuned_on(algo, "Other-v0") == ()


def test_no_shipped_entry_was_tuned_on_the_seeds_that_are_kept_for_judgement():
    kept = range(1000, 2000)
    for algo, key in ENTRIES:
        for seeds in seeds_tuned_on(algo, key) or ():
            assert not set(seeds) & set(kept), (algo, key)


@pytest.mark.parametrize("algo", ALGORITHMS)
def test_an_agent_takes_its_first_steps(algo):
    """One entry of each file, as it stands there."""
    spec = spec_of(algo, environment_for(algo))
    algorithm = load_algorithm(algo)
    env = make_training_env(spec, None)
    kwargs = algorithm_kwargs(spec)
    model = algorithm(env=env, device="cpu", seed=0, **kwargs).learn(2 * env.num_envs)
    assert model.num_timesteps >= 2 * env.num_envs
    env.close()


class Pair(Valid):
    """As before, shown as a dictionary."""

    observation_space = gym.spaces.Dict(a=Valid.observation_space, b=Valid.observation_space)

    def reset(self, *, seed=None, options=None):
        return dict.fromkeys("ab", 0), {}


@pytest.mark.parametrize("algo", ["dqn", "ppo", "a2c", "ppo_lstm", "trpo"])
def test_a_default_serves_dictionaries(algo, monkeypatch):
    monkeypatch.setitem(
        gym.registry, "Pair-v0", gym.envs.registration.EnvSpec("Pair-v0", Pair, max_episode_steps=3)
    )
    policy = algorithm_kwargs(spec_of(algo, "Pair-v0"))["policy"]
    assert policy == ("MultiInputLstmPolicy" if algo == "ppo_lstm" else "MultiInputPolicy")
