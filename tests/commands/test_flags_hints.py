"""A flag that there is not is answered with what was meant."""

import inspect

import pytest

from agents import ALGORITHMS, load_algorithm
from commands import compare, enjoy, train
from commands.cli import INSTEAD, SET_BY_FLAGS, hint
from pipeline.errors import OTHER_NAMES, did_you_mean

TRAIN, ENJOY, COMPARE = train, enjoy, compare


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
