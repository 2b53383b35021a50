"""Search spaces: read strictly, asked by Optuna, and back from settings."""

from functools import cache
from pathlib import Path

import gymnasium as gym
import optuna
import pytest
from optuna.trial import FixedTrial

from rl_yardstick.agents import ALGORITHMS, load_algorithm
from rl_yardstick.experiments.study import AgentSpec, EnvironmentSpec, StudySpec
from rl_yardstick.pipeline import settings
from rl_yardstick.pipeline.components import constructor_arguments
from rl_yardstick.pipeline.errors import UserError
from rl_yardstick.pipeline.settings import entry_names, read_entry, read_spec, read_yaml
from rl_yardstick.tuning import search_spaces
from rl_yardstick.tuning.search_spaces import corners, read_search_space, same
from rl_yardstick.tuning.searching import open_search
from rl_yardstick.tuning.suggesting import Suggestions, shipped_entry
from rl_yardstick.tuning.tuning_spec import TuningSpec

FOLDER = settings.HYPERPARAMS / "search_spaces"
NOTHING_TO_SEARCH = {"optimal", "random", "angle", "mabwiser_thompson"}
DQN_SPACE = Path(__file__).with_name("dqn_space.yml")
MISTAKES = read_yaml(DQN_SPACE.with_name("wrong_spaces.yml"))
SEARCHED = [name for name in ALGORITHMS if name not in NOTHING_TO_SEARCH]


@pytest.fixture(scope="module", autouse=True)
def files_read_once():
    """They hold a dozen entries each, and reading them is most of what these tests take."""
    with pytest.MonkeyPatch.context() as patch:
        for module in (search_spaces, settings):
            patch.setattr(module, "read_yaml", cache(read_yaml))
        yield


@pytest.fixture
def space():
    return read_search_space("dqn", "Foo-v0", DQN_SPACE)


def shipped(algo):
    """The entries of an agent's files, both of settings and of spaces, by environment."""
    names = [*entry_names(algo), *(set(read_yaml(FOLDER / f"{algo}.yml")) - {"default"})]
    return {name: as_run(algo, name) for name in dict.fromkeys([*names, "FrozenLake-v1"])}


def as_run(algo, env_id):
    """The entry with numbers for ``auto``, as a search begins with it."""
    return shipped_entry(read_spec(algo, env_id, read_entry(algo, env_id)))


# Ranges are chosen so that what ships lies inside, but for what no range should hold.
WIDENED = {("qrdqn", "FrozenLake-v1"): ("policy_kwargs.net_arch",)}  # no hidden layer


@pytest.mark.parametrize("algo", SEARCHED)
def test_shipped_settings_are_a_trial_and_come_back(algo):
    for env_id, entry in shipped(algo).items():
        space, params = read_search_space(algo, env_id).including(entry)
        assert space.widened == WIDENED.get((algo, env_id), ())
        assert params.keys() <= space.distributions.keys()
        again = space.merged(entry, space.suggest(FixedTrial(params)))
        before, after = space.flat(entry), space.flat(again)
        for key in space.keys:
            # What is left out now exists under a condition that is not met.
            assert same(after[key], before[key]) or key not in again
        assert {*again} - {*entry} <= {key.partition(".")[0] for key in space.keys}


@pytest.mark.parametrize("algo", SEARCHED)
def test_an_agent_takes_every_end_and_every_choice(algo):
    """What entries of environments change is held against the agent where they are read."""
    algorithm, env = load_algorithm(algo), environment_for(algo)
    entry, space = as_run(algo, env.spec.id), read_search_space(algo, env.spec.id)
    for number, drawn in enumerate(corners(space)):
        spec = read_spec(algo, env.spec.id, space.merged(entry, drawn))
        kwargs = constructor_arguments(spec, algorithm, is_dict=False)
        if number < 2:
            # Room for replay takes time to make, and its size is checked already.
            algorithm(env=env, **kwargs | ({"buffer_size": 10} if "buffer_size" in kwargs else {}))
    env.close()


def tuning_of(algo, settings=(), **fields):
    agents = (AgentSpec("shipped", algo, dict(settings)),)
    places = (EnvironmentSpec("FrozenLake-v1", "FrozenLake-v1"),)
    return TuningSpec(StudySpec("s", "S", agents, places), **fields)


BATCHES = [
    ({}, {"n_steps": 32, "batch_size": 512}, {"n_steps": 32, "batch_size": 256}),
    ({}, {"n_steps": 512, "batch_size": 64}, {"n_steps": 512, "batch_size": 64}),
    ({}, {"n_steps": 25, "batch_size": 64}, {"n_steps": 25, "batch_size": 50}),
    # What the user fixes stays.
    ({"batch_size": 96, "n_steps": 32}, {"gamma": 0.9}, {"n_steps": 32, "batch_size": 96}),
]


@pytest.mark.parametrize(("fixed", "drawn", "tried"), BATCHES)
def test_batches_divide_the_buffer_of_steps(fixed, drawn, tried):
    settings, space = {"n_envs": 8, **fixed}, read_search_space("ppo", "FrozenLake-v1")
    shipped = {**as_run("ppo", "FrozenLake-v1"), **settings}
    entry = Suggestions(tuning_of("ppo", settings), space, shipped).merged(drawn)
    assert {key: entry[key] for key in tried} == tried


def environment_for(algo):
    for env_id in ("FrozenLake-v1", "GaussianBandit-v0", "Pendulum-v1", "Warehouse-v0"):
        env = gym.make(env_id)
        if ALGORITHMS[algo].env_misfit(env) == "":
            return env
        env.close()
    raise LookupError(algo)


def test_what_optuna_chooses_becomes_settings(space):
    same = {"n_steps": 3, "max_grad_norm": 10, "exploration_fraction": 0.25}
    params = {"learning_rate_form": "exponential", "learning_rate": 0.05, "gamma_form": "constant"}
    params |= {"learning_rate_final_share": 0.1, "one_minus_gamma": 0.005, "log2_batch_size": 6}
    params |= {"updates": "many", "policy_kwargs.net_arch": "large", "train_env_wrapper": "tenth"}
    params |= same
    settings = space.suggest(FixedTrial(params))
    found = {"learning_rate": "exp_0.05_0.005", "gamma": 0.995, "batch_size": 64, **same}
    found |= {"train_freq": 4, "gradient_steps": 8, "policy_kwargs.net_arch": [64, 64]}
    found |= {"train_env_wrapper": {"rl_yardstick.envs.wrappers.ScaleReward": {"scale": 0.1}}}
    assert settings == found
    settings = space.merged({}, settings)
    assert settings["policy_kwargs"] == {"net_arch": [64, 64]}
    assert close(space.including(settings)[1], params)
    assert params.keys() == space.distributions.keys()


def test_what_does_not_exist_leaves_the_entry(space):
    settings = {"max_grad_norm": 1, "policy_kwargs.net_arch": [32]}
    entry = {"n_timesteps": 10, "exploration_fraction": 0.5}
    entry["policy_kwargs"] = {"net_arch": [8], "activation_fn": "nn.ReLU"}
    merged = space.merged(entry, settings)
    assert "exploration_fraction" not in merged
    assert merged["policy_kwargs"] == {"net_arch": [32], "activation_fn": "nn.ReLU"}
    assert merged["n_timesteps"] == 10
    # Nor does what an environment's entry takes out of the space.
    other = read_search_space("dqn", "Taxi-v4", DQN_SPACE)
    assert {*space.keys} - {*other.keys} == {"n_steps"}


def test_every_setting_leads_back_to_itself(space):
    study = optuna.create_study(sampler=optuna.samplers.RandomSampler(0))
    for _ in range(30):
        trial = study.ask()
        settings = space.suggest(trial)
        wider, params = space.including(space.merged({}, settings))
        assert wider == space
        assert close(params, trial.params)
        assert space.suggest(FixedTrial(params)) == settings


def close(first, second):
    """Equal, but for the digits after the sixth."""
    return first == {
        name: pytest.approx(value, rel=1e-5) if isinstance(value, float) else value
        for name, value in second.items()
    }


def test_settings_outside_widen_the_space(space):
    entry = {"learning_rate": 0.5, "gamma": 0.5, "batch_size": 100, "max_grad_norm": 5}
    entry |= {"train_freq": 2, "gradient_steps": 2}
    entry |= {"train_env_wrapper": {"rl_yardstick.envs.wrappers.ScaleReward": {"scale": 7}}}
    falling = space.including({**entry, "learning_rate": "falling"})[1]
    assert falling["learning_rate_form"] == "falling"
    wider, params = space.including(entry)
    assert params["learning_rate"] == 0.5
    assert params["one_minus_gamma"] == 0.5
    assert params["batch_size_form"] == 100
    assert params["updates"] == params["train_env_wrapper"] == "shipped"
    assert params["max_grad_norm"] == 5
    assert params["policy_kwargs.net_arch"] == "shipped"
    again = wider.merged(entry, wider.suggest(FixedTrial(params)))
    assert again == {**entry, "n_steps": 1, "policy_kwargs": {"net_arch": None}}
    widened = {*entry, "updates", "policy_kwargs.net_arch"} - {"train_freq", "gradient_steps"}
    assert set(wider.widened) == widened
    assert wider.including(entry)[0] == wider


@pytest.mark.parametrize(("text", "message"), MISTAKES)
def test_a_mistake_is_one_line_that_says_where(tmp_path, text, message):
    path = tmp_path / "space.yml"
    path.write_text(text, encoding="utf-8")
    with pytest.raises(UserError) as error:
        open_search(tuning_of("dqn", search_space=path), tmp_path)
    assert message in str(error.value)
    assert "space.yml" in str(error.value)
    assert "\n" not in str(error.value)
    assert [*tmp_path.iterdir()] == [path]


def test_where_there_is_nothing_to_search(tmp_path):
    for algo in NOTHING_TO_SEARCH:
        with pytest.raises(UserError, match=f"nothing to search for {algo}"):
            read_search_space(algo, "CartPole-v1")
    # An agent of one's own brings its file.
    with pytest.raises(UserError, match="--search-space FILE"):
        read_search_space("mine", "CartPole-v1")
    with pytest.raises(UserError, match="there is no such file"):
        read_search_space("dqn", "CartPole-v1", tmp_path / "none.yml")
