"""Which seeds settings were tuned on: said beside the entries of a file, never in them."""

import pytest

from agents import ALGORITHMS
from pipeline.errors import UserError
from pipeline.settings.hyperparams import (
    NoEntryError,
    entry_names,
    read_hyperparams,
    seeds_tuned_on,
)

TEXT = """\
tuned_on:
  Lake-v0: {first: 0, count: 10}
  Cliff-v0: [{first: 0, count: 1}, {first: 100, count: 2}]

default: {n_timesteps: 5}
Lake-v0: {n_timesteps: 6}
Cliff-v0: {n_timesteps: 7}
"""


@pytest.fixture
def file(tmp_path):
    def write(text):
        path = tmp_path / "mine.yml"
        path.write_text(text)
        return path

    return write


def test_each_entry_has_its_seeds_and_an_entry_that_is_not_named_has_none(file):
    path = file(TEXT)
    assert seeds_tuned_on("dqn", "Lake-v0", path) == (range(10),)
    assert seeds_tuned_on("dqn", "module:Cliff-v0", path) == (range(1), range(100, 102))
    assert seeds_tuned_on("dqn", "Elsewhere-v0", path) == ()


def test_the_seeds_are_no_hyperparameter_and_no_environment(file):
    path = file(TEXT)
    assert read_hyperparams("dqn", "Lake-v0", path) == {"n_timesteps": 6}
    assert read_hyperparams("dqn", "tuned_on", path) == {"n_timesteps": 5}
    assert entry_names("dqn", path) == ["Lake-v0", "Cliff-v0"]
    without_default = file(TEXT.replace("default:", "Taxi-v4:"))
    with pytest.raises(NoEntryError, match="no entry for 'tuned_on'") as error:
        read_hyperparams("dqn", "tuned_on", without_default)
    assert "did you mean" not in str(error.value)


def test_who_does_not_say_is_not_known(file):
    assert seeds_tuned_on("dqn", "Lake-v0", file("default: {n_timesteps: 5}\n")) is None
    assert seeds_tuned_on("an agent of the user's", "Lake-v0") is None


def test_entries_of_the_shipped_files():
    assert seeds_tuned_on("dqn", "Taxi-v4") == (range(10),)
    assert seeds_tuned_on("ppo", "Pendulum-v1") == (range(100, 101),)
    assert seeds_tuned_on("dqn", "Acrobot-v1") == ()
    assert all(seeds_tuned_on(algo, "BipedalWalker-v3") == () for algo in ALGORITHMS)


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
def test_mistakes_in_it_end_in_one_line(file, said, message):
    path = file(f"tuned_on: {said}\nLake-v0: {{n_timesteps: 6}}\n")
    for read in (seeds_tuned_on, read_hyperparams):
        with pytest.raises(UserError) as error:
            read("dqn", "Lake-v0", path)
        assert message in str(error.value)
        assert "\n" not in str(error.value)
