"""Files of hyperparameters: rl_zoo3's load unchanged; the shipped ones make agents that fit."""

from pathlib import Path

import gymnasium as gym
import pytest
import yaml
from gymnasium.spaces import Box

from agents import ALGORITHMS, load_algorithm
from pipeline.agent_settings import check_fit, resolved_spec, without_auto
from pipeline.environments import make_single_env, make_training_env
from pipeline.errors import UserError
from pipeline.preparation import algorithm_kwargs
from pipeline.settings import hyperparams
from pipeline.settings.components import (
    action_noise,
    build_algorithm_kwargs,
    callbacks,
    default_policy,
    vec_wrapper_factory,
)
from pipeline.settings.hyperparams import (
    SPECIAL_KEYS,
    TUNED_ON,
    ComponentSpec,
    Hyperparams,
    NoEntryError,
    check_algorithm_kwargs,
    entry_names,
    override,
    read_hyperparams,
    seeds_tuned_on,
    split,
)
from pipeline.settings.values import ScheduleSpec, constructor_parameters
from pipeline.settings.yaml import read_yaml
from tests.peers.peer_environment import peer_folder

ZOO = peer_folder("rl_zoo3") / "hyperparams"
ZOO_FILES = sorted(ZOO.glob("*.yml"))
# her.yml says of itself that it is no longer used: it is of an algorithm that there is no more.
ZOO_READ = {p.stem: yaml.safe_load(p.read_text()) for p in ZOO_FILES if p.stem != "her"}
FOLDER = Path(hyperparams.__file__).parents[2] / "hyperparams"
FILES = sorted(FOLDER.glob("*.yml"))
READ = {path.stem: read_yaml(path) for path in FILES}
SPECIALISTS = {"angle"}  # whose entries stand in for no others


# --- rl_zoo3's own files -------------------------------------------------------------------------


@pytest.mark.usefixtures("files_parsed_once")
@pytest.mark.parametrize("algo", ZOO_READ)
def test_rl_zoo3_entries_load_unchanged(algo):
    for env_id, entry in ZOO_READ[algo].items():
        raw = read_hyperparams(algo, env_id, ZOO / f"{algo}.yml")
        assert raw == entry
        hyperparams = split(raw)
        assert hyperparams.n_timesteps == int(float(raw["n_timesteps"]))
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


@pytest.mark.parametrize("path", ZOO_FILES, ids=lambda path: path.stem)
def test_the_entries_of_every_rl_zoo3_file_are_found_and_understood(path):
    read = read_yaml(path)
    for env_id, raw in read.items():
        assert split(raw, env_id).n_envs == raw.get("n_envs", 1)
    names = [name for name in read if name not in {"default", "atari"}]
    assert entry_names(path.stem, path) == names != []


def test_rl_zoo3_cartpole_word_for_word():
    hyperparams = split(read_hyperparams("ppo", "CartPole-v1", ZOO / "ppo.yml"))
    assert (hyperparams.n_timesteps, hyperparams.n_envs) == (100_000, 8)
    parameters = constructor_parameters(load_algorithm("ppo"))
    assert check_algorithm_kwargs(hyperparams.algorithm, parameters, "ppo") == {
        "policy": "MlpPolicy",
        "n_steps": 32,
        "batch_size": 256,
        "gae_lambda": 0.8,
        "gamma": 0.98,
        "n_epochs": 20,
        "ent_coef": 0.0,
        "learning_rate": ScheduleSpec("linear", 0.001, 0.0),
        "clip_range": ScheduleSpec("linear", 0.2, 0.0),
    }


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
        ("gymnasium:CartPole-v1", None, 0.3),
        ("Warehouse-v0", None, 0.1),
        ("envs:Warehouse-v0", None, 0.1),
        ("Nowhere-v0", {"is_slippery": True}, 0.1),
        ("ALE/Pong-v5", None, 0.2),
        ("ale_py:ALE/Pong-v5", None, 0.2),
        ("PongNoFrameskip-v4", None, 0.2),
        # An environment has its entry by whichever of its names.
        ("CliffWalking-v1", {"is_slippery": True}, 0.5),
        ("gymnasium:CliffWalking-v1", {"is_slippery": True}, 0.5),
        ("CliffWalking-v1", {"is_slippery": False}, 0.4),
        ("CliffWalking-v1", None, 0.4),
        ("CliffWalking-v1", {"is_slippery": True, "render_mode": None}, 0.4),
        ("FrozenLake-v1", {"map_name": "8x8"}, 0.6),  # FrozenLake8x8-v1 has another time limit
    ],
)
def test_which_entry_is_taken(file, env_id, kwargs, gamma):
    assert read_hyperparams("sarsa", env_id, file(ENTRIES), kwargs) == {"gamma": gamma}


def test_no_entry_names_the_nearest_ids_and_the_ways_out(file):
    path = file("CartPole-v1: {}\nCartPole-v0: {}\natari: {}\nTaxi-v4: {}\n")
    with pytest.raises(NoEntryError) as caught:
        read_hyperparams("ppo", "CartPol-v1", path)
    assert str(caught.value) == (
        f"{path}: no entry for 'CartPol-v1' (did you mean 'CartPole-v1' or 'CartPole-v0'?); "
        "give hyperparameters with -params, or another file with --conf-file"
    )


def test_the_usual_file_lies_beside_the_packages():
    assert read_hyperparams("ppo", "Warehouse-v0")["policy"] == "MlpPolicy"
    # An agent of the user's own has none there, and begins with its defaults.
    assert read_hyperparams("no_such_agent", "CartPole-v1") == {}
    assert entry_names("no_such_agent") == []


def test_special_keys_are_told_from_the_algorithms_arguments():
    raw = {
        "n_timesteps": "1e6",
        "n_envs": 4.0,
        "policy": "MlpPolicy",
        "gamma": "0.9",
        "normalize": "dict(norm_obs=True, norm_reward=False)",
        "env_wrapper": "envs.wrappers.OneHotObservation",
        "train_env_wrapper": [{"envs.wrappers.ScaleReward": {"scale": 0.01}}],
        "vec_env_wrapper": None,
        "env_kwargs": "dict(size=8)",
        "train_env_kwargs": {"random_start": True},
        "eval_env_kwargs": {"max_episode_steps": 200},
        "frame_stack": 4,
        "monitor_kwargs": {"info_keywords": ["is_success"]},
        "noise_type": "normal",
        "noise_std": "0.1",
    }
    assert split(raw) == Hyperparams(
        n_timesteps=1_000_000,
        n_envs=4,
        normalize={"norm_obs": True, "norm_reward": False, "gamma": 0.9},
        env_wrapper=(ComponentSpec("envs.wrappers.OneHotObservation"),),
        train_env_wrapper=(ComponentSpec("envs.wrappers.ScaleReward", {"scale": 0.01}),),
        env_kwargs={"size": 8},
        train_env_kwargs={"random_start": True},
        eval_env_kwargs={"max_episode_steps": 200},
        frame_stack=4,
        monitor_kwargs={"info_keywords": ("is_success",)},
        noise_type="normal",
        noise_std=0.1,
        algorithm={"policy": "MlpPolicy", "gamma": "0.9"},
    )
    assert split({}) == Hyperparams()
    assert split({"n_episodes": 5}).n_episodes == 5


def test_one_budget_replaces_the_other():
    entry = {"n_timesteps": 100, "gamma": 0.9}
    assert override(entry, {"n_episodes": 5}) == {"gamma": 0.9, "n_episodes": 5}
    assert override(entry, {"gamma": 0.8}) == {"n_timesteps": 100, "gamma": 0.8}
    assert entry == {"n_timesteps": 100, "gamma": 0.9}


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
    assert seeds_tuned_on("dqn", "module:Cliff-v0", path) == (range(1), range(100, 102))
    assert seeds_tuned_on("dqn", "Elsewhere-v0", path) == ()
    assert read_hyperparams("dqn", "Lake-v0", path) == {"n_timesteps": 6}
    assert read_hyperparams("dqn", "tuned_on", path) == {"n_timesteps": 5}
    assert entry_names("dqn", path) == ["Lake-v0", "Cliff-v0"]
    without_default = file(TUNED.replace("default:", "Taxi-v4:"))
    with pytest.raises(NoEntryError, match="no entry for 'tuned_on'") as error:
        read_hyperparams("dqn", "tuned_on", without_default)
    assert "did you mean" not in str(error.value)
    # Who does not say is not known.
    assert seeds_tuned_on("dqn", "Lake-v0", file("default: {n_timesteps: 5}\n")) is None
    assert seeds_tuned_on("an agent of the user's", "Lake-v0") is None


@pytest.mark.parametrize(
    ("said", "message"),
    [
        ("0-9", "tuned_on must map entries to seeds, not be '0-9'"),
        ("{Lake-v0: 10}", "tuned_on: Lake-v0 must be like {first: 0, count: 10}, not 10"),
        ("{Lake-v0: {first: 0}}", "tuned_on: Lake-v0 must be like"),
        ("{Lake-v0: {first: 0, count: -1}}", "tuned_on: Lake-v0 must be like"),
        ("{Lake-v0: {first: 0, count: yes}}", "tuned_on: Lake-v0 must be like"),
        ("{Lake-v0: [{first: 0, count: 1.5}]}", "tuned_on: Lake-v0 must be like"),
        ("{Lake: {first: 0, count: 1}}", "tuned_on names 'Lake', which has no entry there"),
        ("{tuned_on: {first: 0, count: 1}}", "tuned_on names 'tuned_on', which has no entry"),
    ],
)
def test_mistakes_in_seeds_end_in_one_line(file, said, message):
    path = file(f"tuned_on: {said}\nLake-v0: {{n_timesteps: 6}}\n")
    for read in (seeds_tuned_on, read_hyperparams):
        with pytest.raises(UserError) as error:
            read("dqn", "Lake-v0", path)
        assert message in str(error.value)
        assert "\n" not in str(error.value)


# --- the shipped files ---------------------------------------------------------------------------


class Valid(gym.Env):
    """A step long, of two actions; the second is valid."""

    observation_space = action_space = gym.spaces.Discrete(2)

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        return 0, {}

    def action_masks(self):
        return [False, True]

    def step(self, action):
        return 1, float(action), True, False, {}


class Pair(Valid):
    """As before, shown as a dictionary."""

    observation_space = gym.spaces.Dict(a=Valid.observation_space, b=Valid.observation_space)

    def reset(self, *, seed=None, options=None):
        return dict.fromkeys("ab", 0), {}


@pytest.fixture(autouse=True, scope="module")
def registered():
    for env in (Valid, Pair):
        gym.register(f"{env.__name__}-v0", env, max_episode_steps=3)
    yield
    for env in (Valid, Pair):
        del gym.registry[f"{env.__name__}-v0"]


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


ANY = ["FrozenLake-v1", "CartPole-v1", "GaussianBandit-v0", "Pendulum-v1", "Valid-v0"]


@pytest.mark.parametrize("algo", ALGORITHMS)
def test_an_agent_takes_its_first_steps(algo):
    """One entry of each file, as it stands there, or the default on what it fits."""
    fitting = (name for name in ANY if not ALGORITHMS[algo].env_misfit(gym.make(name)))
    spec = spec_of(algo, next(iter([*entry_names(algo)[:1], *fitting])))
    env = make_training_env(spec, None)
    kwargs = algorithm_kwargs(spec)
    model = load_algorithm(algo)(env=env, device="cpu", seed=0, **kwargs).learn(2 * env.num_envs)
    assert model.num_timesteps >= 2 * env.num_envs
    env.close()


@pytest.mark.parametrize("algo", ["dqn", "ppo", "a2c", "ppo_lstm", "trpo"])
def test_a_default_serves_dictionaries(algo):
    policy = algorithm_kwargs(spec_of(algo, "Pair-v0"))["policy"]
    assert policy == ("MultiInputLstmPolicy" if algo == "ppo_lstm" else "MultiInputPolicy")
