"""What flags refuse: odd values, flags that there are not, and what was meant."""

import argparse
import inspect
import io
from pathlib import Path

import pytest
from hypothesis import given
from hypothesis import strategies as st
from rich.console import Console

from agents import ALGORITHMS, load_algorithm
from commands import compare, enjoy, train
from commands.cli import (
    INSTEAD,
    LARGEST,
    SET_BY_FLAGS,
    check_device,
    folder_name,
    hint,
    number_at_least_zero,
    whole_number,
)
from commands.compare import study_spec
from commands.enjoy import model_request
from commands.train import train_spec
from pipeline.environments import make_env
from pipeline.errors import OTHER_NAMES, UserError, did_you_mean
from pipeline.training import carry_out, prepare

# --- every flag with every odd value: it has a meaning, or it is refused in one line --------------


ODD = ("0", "-1", "-5", "7", "1e5", "100_000", "9" * 30, "1e999999999", "-1e999999999", "\u0663")
ODD = (*ODD, "1.5", "nan", "sNaN", "inf", "-inf", "", " ", "text", "a:b", "/", "..")
BASES = {
    train: ["--algo", "random", "--env", "FrozenLake-v1", "-n", "5"],
    enjoy: ["--algo", "random", "--env", "FrozenLake-v1"],
    compare: ["--algos", "random", "--env", "FrozenLake-v1", "-n", "5"],
}
REQUESTS = {train: train_spec, enjoy: model_request, compare: study_spec}


def parsers():
    return {module: module.build_parser() for module in BASES}


# But for --gym-packages, whose modules are imported for good.
FLAGS = [
    (module, action.option_strings[-1])
    for module, parser in parsers().items()
    for action in parser._actions
    if action.option_strings and action.nargs != 0 and action.dest != "gym_packages"
]


@pytest.mark.parametrize(("module", "flag"), FLAGS)
def test_an_odd_value_has_a_meaning_or_is_refused_in_one_line(module, flag, capsys):
    for value in ODD:
        base = BASES[module]
        if flag == "--n-episodes" and module is not enjoy:
            base = base[:-2]
        refusal = ""
        try:
            REQUESTS[module](module.build_parser().parse_args([*base, f"{flag}={value}"]))
        except UserError as error:
            refusal = f"{error}\n"
        except SystemExit:
            refusal = capsys.readouterr().err
        assert refusal.count("\n") == bool(refusal)


TRAIN, ENJOY, COMPARE = train, enjoy, compare
MEANINGS = [
    (TRAIN, "-n", {"1e5": 100_000, "100_000": 100_000, "-1": -1}, "0 -5 1.5 nan inf text 1e13"),
    (TRAIN, "--n-episodes", {"1e3": 1000, "-1": -1}, "0 -2"),
    (TRAIN, "--seed", {"-1": -1, "0": 0, "4294967295": 2**32 - 1}, "-7 4294967296 1.5"),
    (TRAIN, "--num-threads", {"-1": -1, "0": 0, "4": 4}, "-2 1025 text"),
    (TRAIN, "--eval-freq", {"-1": -1, "0": 0, "-3": -3, "1e4": 10_000}, "1.5 nan"),
    (TRAIN, "--eval-episodes", {"1": 1}, "0 -1"),
    (TRAIN, "--n-eval-envs", {"1": 1}, "0 -1"),
    (TRAIN, "--save-freq", {"-3": -3, "0": 0, "1e4": 10_000}, "1.5"),
    (TRAIN, "--log-interval", {"-1": -1, "-2": -2, "4": 4}, "0 -3"),
    (TRAIN, "--verbose", {"0": 0, "2": 2}, "-1 3 7"),
    (ENJOY, "--seed", {"-1": -1, "3": 3}, "-7"),
    (ENJOY, "--num-threads", {"-1": -1, "0": 0}, "-2"),
    (COMPARE, "-n", {"1e5": 100_000}, "0 -1"),
    (COMPARE, "--n-episodes", {"1e2": 100}, "0 -1"),
    (COMPARE, "--seeds", {"1e1": 10}, "0 -1 1000001"),
    (COMPARE, "--jobs", {"-1": -1, "0": 0, "3": 3}, "-2 4097"),
    (COMPARE, "--margin", {"0": 0.0, "0.5": 0.5}, "-1 nan inf"),
    (COMPARE, "--episodes-table", {"10": 10}, "0"),
    (COMPARE, "--render-every", {"0": 0, "10": 10}, "-1"),
    (COMPARE, "--name", {"my study": "my study"}, ".. a/b / CON a:b nul.txt"),
]


@pytest.mark.parametrize(("module", "flag", "taken", "refused"), MEANINGS)
def test_what_a_value_means(module, flag, taken, refused, capsys):
    parser = module.build_parser()
    (name,) = (a.dest for a in parser._actions if flag in a.option_strings)
    for text, value in taken.items():
        assert getattr(parser.parse_args([f"{flag}={text}"]), name) == value
        if not text.startswith("-"):
            assert getattr(parser.parse_args([flag, text]), name) == value
    for text in refused.split():
        with pytest.raises(SystemExit):
            parser.parse_args([f"{flag}={text}"])
        assert f"not {text!r}" in capsys.readouterr().err


@given(st.integers(-LARGEST, LARGEST))
def test_a_whole_number_is_read_as_it_is_written(number):
    read = whole_number(-LARGEST)
    assert read(str(number)) == read(f"{number:_}") == read(f"{number}.0") == number
    assert read(f"{number}e0") == number


@given(st.text() | st.floats().map(str) | st.integers().map(str))
def test_any_other_text_is_refused(text):
    for read in (whole_number(1, 100, {-1: "none"}), number_at_least_zero, folder_name):
        try:
            value = read(text)
        except argparse.ArgumentTypeError:
            continue
        if isinstance(value, int):
            assert value == -1 or 1 <= value <= 100
        assert value == text if read is folder_name else float(text) == value


@pytest.mark.parametrize(
    "words",
    [
        ["--num-threads", "-1"],
        ["--num-threads", "0"],
        ["--eval-freq", "0"],
        ["--eval-freq", "-5"],
        ["--eval-episodes", "1", "--n-eval-envs", "1e3"],
        ["--save-freq", "-3"],
        ["--log-interval", "-2", "--verbose", "2"],
        ["--log-interval", "1e12"],
        ["--seed", "4294967295"],
        ["--seed", "-1"],
        ["-params", "n_envs:2e0"],
    ],
)
def test_what_is_taken_trains(words, tmp_path):
    words = [*BASES[train], "-f", str(tmp_path), *words]
    spec = train_spec(train.build_parser().parse_args(words))
    outcome = carry_out(prepare(spec, Console(file=io.StringIO()), {}, ""))
    assert outcome.n_steps in (5, 6)


def test_tensorboard_calls_a_run_after_its_agent(tmp_path):
    words = [*BASES[train], "-f", str(tmp_path), "-tb", str(tmp_path / "tb")]
    spec = train_spec(train.build_parser().parse_args(words))
    for _ in range(2):
        carry_out(prepare(spec, Console(file=io.StringIO()), {}, ""))
    assert {path.name for path in (tmp_path / "tb" / "FrozenLake-v1").iterdir()} == {
        "random_1",
        "random_2",
    }


@pytest.mark.parametrize("text", ["1e5", "100_000", "100000.0"])
@pytest.mark.parametrize("place", ["-params", "file"])
def test_a_budget_in_settings_may_be_written_as_a_float(place, text, tmp_path):
    (tmp_path / "own.yml").write_text(f"default:\n  n_timesteps: {text}\n")
    words = ["--algo", "random", "--env", "FrozenLake-v1"]
    where = {"-params": [f"n_timesteps:{text}"], "file": [str(tmp_path / "own.yml")]}[place]
    flag = {"-params": "-params", "file": "-conf"}[place]
    args = train.build_parser().parse_args([*words, flag, *where])
    assert train_spec(args).hyperparams.n_timesteps == 100_000


@pytest.mark.parametrize("device", ["nonsense", "", "meta", "cuda:99", "-1"])
def test_a_device_that_is_not_there(device):
    with pytest.raises(UserError, match="--device: PyTorch has no"):
        check_device(device)


@pytest.mark.parametrize(
    ("env_id", "kwargs", "complaint"),
    [
        ("FrozenLake-v1", {"map_name": "9x9"}, "unknown map_name '9x9': known are 4x4, 8x8"),
        ("FrozenLake-v1", {"map_name": 0}, "unknown map_name '0': known are 4x4, 8x8"),
        ("FrozenLake-v1", {"map_name": float("nan")}, "unknown map_name 'nan'"),
        ("FrozenLake-v1", {"slippery": 1}, "unknown argument 'slippery': did you mean 'is_slip"),
        ("FrozenLake-v1", {"desc": []}, "(expected 2, got 1) (with desc=[])"),
        ("Taxi-v4", {"rainy_probability": "x"}, "'float' and 'str' (with rainy_probability='x')"),
        ("Warehouse-v0", {"slip": 2}, "slip must be a finite number"),
        ("CartPole-v1", {"x": 1}, "known are sutton_barto_reward, max_episode_steps"),
        ("CartPole-v1", {"render_mode": 1}, "(with render_mode=1)"),
    ],
)
def test_arguments_of_environments(env_id, kwargs, complaint):
    with pytest.raises(UserError) as caught:
        make_env(env_id, kwargs)
    assert str(caught.value).startswith(f"{env_id}: ")
    assert complaint in str(caught.value)
    assert "environment creator" not in str(caught.value)


def test_a_random_seed_to_play_with():
    words = ["--seed", "-1", "--algo", "random", "--env", "FrozenLake-v1"]
    args = enjoy.build_parser().parse_args(words)
    seeds = {model_request(args).seed for _ in range(5)}
    assert len(seeds) == 5
    assert min(seeds) >= 0


def test_a_folder_is_not_left_to_chance(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    for module in (train, enjoy, compare):
        with pytest.raises(SystemExit):
            module.build_parser().parse_args(["-f", ""])
    assert list(Path.cwd().iterdir()) == []


# --- a flag that there is not is answered with what was meant -------------------------------------


def answer(module, words, capsys):
    with pytest.raises(SystemExit) as end:
        module.build_parser().parse_args(words.split())
    err = capsys.readouterr().err
    assert (end.value.code, err.count("\n")) == (2, 1)
    return err


@pytest.mark.parametrize(
    ("module", "words", "meant"),
    [
        (TRAIN, "--lr 0.1", "behind -params: -params learning_rate:0.1 "),
        (TRAIN, "--learning-rate 0.1 --algo qlearning", "-params learning_rate:0.1 "),
        (TRAIN, "--learning_rate=0.1", "-params learning_rate:0.1 "),
        (TRAIN, "--gamma", "-params gamma:VALUE "),
        (TRAIN, "--gamma --seed 3", "-params gamma:VALUE "),
        (TRAIN, "--alpha 0.1 --algo qlearning", "-params learning_rate:0.1 "),
        (TRAIN, "--alpha 0.1 --algo linucb", "-params alpha:0.1 "),
        (TRAIN, "--epsilon 0.1 --algo dqn", "-params exploration_final_eps:0.1 "),
        (TRAIN, "--epsilon 0.1 --algo epsilon_greedy", "-params exploration_"),
        (TRAIN, "--tie-breaking first --algo qlearning", "-params tie_breaking:first "),
        (TRAIN, "--n-envs 4", "-params n_envs:4 "),
        (TRAIN, "--n-steps 128", "-params n_steps:128 "),
        (TRAIN, "--n-steps 128 --algo qlearning", "did you mean '--n-timesteps'?"),
        (TRAIN, "--net-arch [64]", '-params policy_kwargs:"dict(net_arch=[64, 64])" '),
        (TRAIN, "--policy MlpPolicy", "-params policy:MlpPolicy "),
        (TRAIN, "--timesteps 5", "did you mean '--n-timesteps'?"),
        (TRAIN, "--total-timesteps 5", "did you mean '--n-timesteps'?"),
        (TRAIN, "--episodes 5", "did you mean '--n-episodes'?"),
        (TRAIN, "--algorithm dqn", "did you mean '--algo'?"),
        (TRAIN, "--environment x", "did you mean '--env'?"),
        (TRAIN, "--num_threads 2", "did you mean '--num-threads'?"),
        (TRAIN, "--folder x", "did you mean '--log-folder'?"),
        (TRAIN, "-yaml x.yml", "did you mean '--conf-file'?"),
        (TRAIN, "--n-jobs 2", "not searched for here"),
        (TRAIN, "--wandb-entity=me", "-tb DIR writes TensorBoard logs"),
        (ENJOY, "--render-mode human", "did you mean '--render'?"),
        (ENJOY, "--episodes 5", "did you mean '--n-episodes'?"),
        (ENJOY, "--log-folder x", "did you mean '--folder'?"),
        (ENJOY, "--video x.gif", "did you mean '--record'?"),
        (ENJOY, "--gamma 0.9", "a matter of training: train with -params gamma:VALUE "),
        (COMPARE, "--seed 3", "did you mean '--seeds'?"),
        (COMPARE, "--algo dqn", "did you mean '--algos'?"),
        (COMPARE, "--n-jobs 2", "did you mean '--jobs'?"),
        (COMPARE, "--gamma 0.9 --algos dqn --env x", "-params gamma:VALUE "),
        (COMPARE, "x.yml --gamma 0.9", "-params gamma:0.9 "),
    ],
)
def test_what_was_meant(module, words, meant, capsys):
    assert meant in answer(module, words, capsys)


@pytest.mark.parametrize("words", [[""], ["a\nb"], ["--"], ["--lr", "a\nb"], ["-x=\n"], [" "]])
def test_whatever_is_unknown_is_told_in_one_line(words, capsys):
    with pytest.raises(SystemExit):
        TRAIN.build_parser().parse_args([*words, "--nonsense"])
    err = capsys.readouterr().err
    assert ": error: unknown argument " in err
    assert err.count("\n") == 1


def test_a_hyperparameter_of_another_agent_is_not_offered(capsys):
    assert "-params" not in answer(TRAIN, "--batch-size 4 --algo qlearning", capsys)


def test_an_abbreviation_does_not_mean_another_flag():
    assert COMPARE.build_parser().parse_args(["--seeds", "3"]).seeds == 3
    with pytest.raises(SystemExit):
        COMPARE.build_parser().parse_args(["--see", "3"])


def test_all_hyperparameters_are_known_by_name():
    named = {
        name
        for algo, entry in ALGORITHMS.items()
        if entry.is_installed
        for name in inspect.signature(load_algorithm(algo)).parameters
    }
    missed = {
        name
        for name in named - SET_BY_FLAGS
        if f"-params {name}:" not in hint([f"--{name}"], ["--hyperparams"], [])
    }
    assert missed == set()


def test_what_is_answered_is_not_here():
    flags = {
        flag
        for module in (TRAIN, ENJOY)
        for action in module.build_parser()._actions
        for flag in action.option_strings
    }
    assert flags.isdisjoint(INSTEAD)


@pytest.mark.parametrize(
    ("name", "known", "hint"),
    [
        ("lr", ["gamma", "learning_rate"], "did you mean 'learning_rate'?"),
        ("alpha", ["gamma", "learning_rate"], "did you mean 'learning_rate'?"),
        ("ALPHA", ["alphas", "learning_rate"], "did you mean 'learning_rate'?"),
        ("eps", ["exploration_final_eps", "x"], "did you mean 'exploration_final_eps'?"),
        ("alpha", ["alphas", "x"], "did you mean 'alphas'?"),
    ],
)
def test_other_names_of_the_field(name, known, hint):
    assert did_you_mean(name, known) == hint


def test_other_names_lead_to_names_that_exist():
    everything = {
        name
        for algo, entry in ALGORITHMS.items()
        if entry.is_installed
        for name in inspect.signature(load_algorithm(algo)).parameters
    }
    meant = {name for names in OTHER_NAMES.values() for name in names}
    assert meant - everything == {"n_timesteps", "n_episodes", "n_envs"}
