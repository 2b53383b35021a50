"""Settings: every text that is read, every mistake in one line, entries, and ``auto``."""

import json

import gymnasium as gym
import numpy as np
import pytest
import yaml
from hypothesis import given
from hypothesis import strategies as st

from rl_yardstick.agents import ALGORITHMS, load_algorithm
from rl_yardstick.envs.known_models import transition_model
from rl_yardstick.pipeline import components, settings
from rl_yardstick.pipeline.components import constructor_arguments, read_signature
from rl_yardstick.pipeline.environments import check_fit, make_single_env
from rl_yardstick.pipeline.errors import UserError
from rl_yardstick.pipeline.spec import TrainSpec
from tests.peers.peer_environment import peer_folder
from tests.pipeline.short_runs import TABLES

ZOO_FILES = sorted((peer_folder("rl_zoo3") / "hyperparams").glob("*.yml"))
FILES = sorted(settings.HYPERPARAMS.glob("*.yml"))
READ = {path.stem: settings.read_yaml(path) for path in FILES}
SPECIALISTS = {"angle"}  # whose entries stand in for no others


def spec_of(algo="qlearning", env_id="FrozenLake-v1", **entry):
    return settings.read_spec(algo, env_id, {"n_timesteps": 10, **entry})


@pytest.mark.parametrize(("text", "value"), TABLES["literals"])
def test_what_is_typed(text, value):
    assert settings.literal(text) == value


PLAIN = st.none() | st.booleans() | st.integers() | st.floats(allow_nan=False) | st.text()


@given(st.recursive(PLAIN, lambda inner: st.lists(inner, max_size=3), max_leaves=9))
def test_a_literal_is_read_back_from_its_repr(value):
    if "inf" not in repr(value):
        assert settings.literal(repr(value)) == value


@given(st.text())
def test_junk_is_read_or_refused_in_one_line(text):
    settings.literal(text)
    for read, words in ((settings.parse_yaml, text), (settings.parse_assignments, [text])):
        try:
            read(words, "here")
        except UserError as error:
            (line,) = str(error).splitlines()
            assert len(line) < 600


@pytest.mark.parametrize(("algo", "entry", "said"), TABLES["mistakes"])
def test_mistakes_are_one_line(algo, entry, said):
    with pytest.raises(UserError) as caught:
        spec_of(algo, **entry)
    assert said in str(caught.value)
    assert len(str(caught.value).splitlines()) == 1


@pytest.mark.parametrize(("text", "said"), TABLES["files"])
def test_files_that_are_wrong(text, said, tmp_path):
    path = tmp_path / "mine.yml"
    path.write_text(text)
    with pytest.raises(UserError) as caught:
        settings.read_entry("ppo", "A", path)
    assert said in str(caught.value)
    assert "mine.yml" in str(caught.value)
    with pytest.raises(UserError, match="Python files are not run"):
        settings.read_entry("ppo", "A", tmp_path / "config.py")


def test_the_table_of_arguments_is_up_to_date():
    table = json.loads(components.TABLE.read_text())
    installed = {name for name, entry in ALGORITHMS.items() if entry.is_installed}
    assert set(table) == installed | set(components.WRAPPERS)
    for owner in table:
        assert table[owner] == read_signature(owner), owner


@pytest.mark.parametrize("path", ZOO_FILES, ids=lambda path: path.stem)
def test_rl_zoo3_entries_load_unchanged(path):
    algo, read = path.stem, settings.read_yaml(path)
    assert read == yaml.safe_load(path.read_text())
    if algo == "her":  # it tells of itself that it is no longer used
        return
    for env_id in read:
        entry = settings.read_entry(algo, env_id, path)
        spec = settings.read_spec(algo, env_id, entry)
        assert spec.n_timesteps == int(float(read[env_id]["n_timesteps"]))
        assert spec.n_envs == read[env_id].get("n_envs", 1)
        unused = {"noise_std"} if "noise_type" not in entry else set()
        assert spec.algorithm.keys() == entry.keys() - set(settings.SPECIAL) - unused
        if (algo, env_id) == ("ppo_lstm", "default"):
            continue  # a slip that rl_zoo3 stumbles over itself: RecurrentPPO knows no MlpPolicy
        assert constructor_arguments(spec, load_algorithm(algo), False)


@pytest.mark.parametrize(("env_id", "kwargs", "gamma"), TABLES["entries"])
def test_which_entry_is_taken(tmp_path, env_id, kwargs, gamma):
    names = ["default", "atari", "CartPole-v1", "CliffWalking-v1", "CliffWalkingSlippery-v1"]
    entries = [*names, "FrozenLake-v1", "FrozenLake8x8-v1"]
    text = yaml.dump({name: {"gamma": i / 10} for i, name in enumerate(entries)})
    (tmp_path / "mine.yml").write_text(text)
    assert settings.read_entry("sarsa", env_id, tmp_path / "mine.yml", kwargs) == {"gamma": gamma}


def test_each_entry_has_the_seeds_that_it_was_tuned_on(tmp_path):
    path = tmp_path / "mine.yml"
    path.write_text(
        "tuned_on: {Lake-v0: {first: 0, count: 10}, "
        "Cliff-v0: [{first: 0, count: 1}, {first: 100, count: 2}]}\n"
        "default: {n_timesteps: 5}\nLake-v0: {n_timesteps: 6}\nCliff-v0: {n_timesteps: 7}\n"
    )
    assert settings.seeds_tuned_on("dqn", "Lake-v0", path) == (range(10),)
    assert settings.seeds_tuned_on("an_agent_without_a_file", "Lake-v0") is None
    assert settings.seeds_tuned_on("dqn", "Cliff-v0", path) == (range(1), range(100, 102))
    path.write_text("tuned_on: {Lake-v0: 5}\nLake-v0: {}\n")
    with pytest.raises(UserError, match="must map entries to seeds"):
        settings.seeds_tuned_on("dqn", "Lake-v0", path)
    path.write_text("default: {n_timesteps: 5}\n")
    assert settings.seeds_tuned_on("dqn", "Lake-v0", path) is None  # who does not tell is not known


def test_every_file_is_an_agents_and_every_agent_has_one():
    names = {f"{name}.yml" for name in ALGORITHMS}
    found = {path.name for path in settings.HYPERPARAMS.iterdir()}
    assert found == {*names, "search_spaces", "arguments.json"}


@pytest.mark.parametrize("algo", READ)
def test_every_entry_builds_and_fits_its_agent_and_environment(algo):
    names = [name for name in READ[algo] if name != settings.TUNED_ON]
    assert set(names) - {"default"} <= set(gym.registry)
    assert settings.entry_names(algo) == [name for name in names if name != "default"]
    assert ("default" in names) == (algo not in SPECIALISTS)
    for env_id in settings.entry_names(algo):
        spec = settings.read_spec(algo, env_id, settings.read_entry(algo, env_id))
        assert [spec.n_timesteps, spec.n_episodes].count(None) == 1
        assert spec.n_envs <= 32  # up to which seeds are known to lie apart
        assert constructor_arguments(spec, load_algorithm(algo), False)
        assert TrainSpec.model_validate(json.loads(spec.model_dump_json())) == spec
        # The same settings, given as an entry, are the same training.
        again = settings.read_spec(algo, env_id, spec.hyperparams)
        assert again.changed(origins={}) == spec.changed(origins={})
        check_fit(spec)
        training, evaluation = make_single_env(spec, training=True), make_single_env(spec)
        # What was learnt in the one must be of use in the other.
        assert training.observation_space == evaluation.observation_space
        assert training.action_space == evaluation.action_space
        for seeds in settings.seeds_tuned_on(algo, env_id):
            assert not set(seeds) & set(range(1000, 2000))  # which are kept for judgement


def test_settings_of_run_folders_of_rl_zoo3(tmp_path):
    path = tmp_path / "config.yml"
    path.write_text(
        "!!python/object/apply:collections.OrderedDict\n- - - n_envs\n    - 8\n"
        '  - - normalize\n    - "dict(norm_obs=True)"\n'
        "  - - freq\n    - !!python/tuple\n      - 1\n      - step\n"
    )
    found = settings.read_saved(path)
    assert found == {"n_envs": 8, "normalize": {"norm_obs": True}, "freq": [1, "step"]}
    path.write_text("!!python/object/apply:os.system ['x']\n")
    with pytest.raises(UserError, match="is no valid YAML"):
        settings.read_saved(path)


def test_a_typed_budget_replaces_the_entrys_also_in_another_unit():
    entry = {"n_timesteps": 5, "gamma": 0.9}
    assert settings.override(entry, {"n_episodes": 3}) == {"n_episodes": 3, "gamma": 0.9}
    assert settings.override(entry, {"gamma": 1.0}) == {"n_timesteps": 5, "gamma": 1.0}


def test_what_is_asked_for_wins_over_an_entrys_variant_for_training():
    variant = {"random_start": True, "shelf_reward": -10}
    for shelf, more, kept, is_told in (
        (-1, {}, {"random_start": True}, True),
        (-10, {}, {"random_start": True}, False),
        (-1, {"train_env_kwargs": {"shelf_reward": -10}}, variant, False),  # for training too
    ):
        typed = {"env_kwargs": {"shelf_reward": shelf}, **more}
        entry = {**typed, "train_env_kwargs": variant}
        found, told = settings.training_follows(entry, typed)
        assert found == {**entry, "train_env_kwargs": kept}
        assert bool(told) == is_told


CLIP = {"gymnasium.wrappers.ClipReward": {"min_reward": "auto"}}
SCALE = {"rl_yardstick.envs.wrappers.ScaleReward": {"scale": "auto"}}


@pytest.mark.parametrize(("env_id", "raw", "value"), TABLES["auto"])
def test_the_word_becomes_a_number_of_the_environment(env_id, raw, value):
    algo = "qlearning" if "value_bound" not in raw else "r_max"
    spec, key = spec_of(algo, env_id, **raw), next(iter(raw))
    assert spec.hyperparams[key] == value
    assert spec.origins[key].startswith("auto")
    assert set(spec.origins) == {name for name in raw if str(raw[name]).startswith("auto")}


def test_the_dearest_step_of_training_costs_a_tenth_of_the_goal():
    spec = spec_of("qlearning", "Warehouse-v0", train_env_wrapper=[CLIP, SCALE])
    model = transition_model(make_single_env(spec, training=True))
    possible = model.reward[model.prob > 0]
    assert np.unique(possible[possible != 0]) == pytest.approx((-0.1, -0.01, 1))
    assert set(spec.origins) == {"train_env_wrapper"}


@pytest.mark.parametrize(("env_id", "raw", "said"), TABLES["not_worked_out"])
def test_what_cannot_be_worked_out_is_refused(env_id, raw, said):
    with pytest.raises(UserError, match=said):
        spec_of("qlearning", env_id, **raw)
