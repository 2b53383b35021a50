"""From flags to specifications: what values mean, what is refused, and the flags of rl_zoo3."""

import argparse
import ast
import inspect
import io
import re
from dataclasses import fields
from pathlib import Path

import pytest
from hypothesis import given
from hypothesis import strategies as st
from rich.console import Console

from agents import ALGORITHMS, load_algorithm
from commands import compare, enjoy, train
from commands.cli import (
    INSTEAD,
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
from experiments.plan import plan
from experiments.study import StudySpec
from pipeline.environments import make_env, training_changes
from pipeline.errors import OTHER_NAMES, UserError, did_you_mean
from pipeline.train_spec import TrainSpec
from pipeline.training import carry_out, prepare
from tests.peers.peer_environment import peer_folder

TRAIN, ENJOY, COMPARE = train, enjoy, compare


def options(module):
    """All flags of a command."""
    return {f for action in module.build_parser()._actions for f in action.option_strings}


def trained(*words):
    base = ["--algo", "qlearning", "--env", "FrozenLake-v1", "-n", "60"]
    return train_spec(train.build_parser().parse_args([*base, *words]))


def compared(*words):
    base = ["--algos", "qlearning", "--env", "FrozenLake-v1", "-n", "60"]
    return study_spec(compare.build_parser().parse_args([*base, *words]))


# --- A flag reaches the field that has its name.


def test_flags_of_train_reach_the_specification():
    given = {"seed": 7, "eval_freq": -1, "eval_episodes": 3, "n_eval_envs": 2, "save_freq": 9}
    given |= {"vec_env": "subproc", "device": "cpu", "num_threads": 2, "log_interval": 4}
    words = [
        word for name, value in given.items() for word in (f"--{name}".replace("_", "-"), value)
    ]
    spec = trained(*map(str, words), "--verbose", "0", "--progress", "--uuid")
    given |= {"verbose": 0, "progress": True, "unique_id": True, "final_episodes": 3}
    assert {name: getattr(spec, name) for name in given} == given


def test_without_flags_a_run_is_the_default_one():
    spec = trained()
    # A study has the same number of episodes in all its runs; a run by itself as few as will do.
    assert (spec.eval_episodes, spec.final_episodes) == (None, None)
    own = {"algo", "env_id", "hyperparams", "saved_hyperparams", "seed", "origins"}
    others = {f.name: f.default for f in fields(TrainSpec) if f.name not in own}
    others |= {"eval_episodes": None, "final_episodes": None}
    assert {name: getattr(spec, name) for name in others} == others


def test_flags_of_compare_reach_the_study():
    usual = {"figures": ("png", "svg"), "is_quick": False, "metric": "final"}
    usual |= {"n_seeds": StudySpec.n_seeds}
    study = compared()
    assert {name: getattr(study, name) for name in usual} == usual
    given = {"n_seeds": 3, "metric": "best", "margin": 0.5, "episodes_table": 5, "render_every": 6}
    given |= {"name": "mine", "learning_pages": True, "figures": ["pdf", "png"]}
    words = "--seeds 3 --metric best --margin 0.5 --episodes-table 5 --render-every 6 --name mine"
    study = compared(*words.split(), "--watch-learning", "--figures", "pdf", "png")
    assert {name: getattr(study, name) for name in given} == given
    assert (compared("--quick").is_quick, compared("--quick").n_seeds) == (True, 2)


def test_the_page_that_plays_a_training(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)

    page = ("--watch-learning", "page.html")
    assert (trained(*page).watch_learning, trained(*page).watch_episodes) == (Path("page.html"), 0)
    assert trained(*page, "--watch-episodes", "3").watch_episodes == 3
    for words, complaint in [
        (("--watch-episodes", "3"), "says how much --watch-learning shows: give that too"),
        (("--watch-learning", "page.pdf"), "writes a .html file, not 'page.pdf'"),
        (("--watch-learning", "no/page.html"), "there is no folder no"),
        (("--watch-learning", "/proc/page.html"), "nothing can be written in /proc: No such file"),
    ]:
        with pytest.raises(UserError, match=complaint):
            trained(*words)
    (tmp_path / "page.html").mkdir()
    with pytest.raises(UserError, match=r"page\.html is a folder"):
        trained(*page)


def test_everybody_is_trained_on_the_environment_as_it_comes(tmp_path):
    words = ["--env", "Warehouse-v0", "--algos", "ppo", "qlearning"]
    for flags, changed in ((), {"ppo"}), (["--as-it-comes"], set()):
        study = study_spec(compare.build_parser().parse_args([*words, *flags]))
        planned = plan(study, tmp_path)
        assert {one.agent for one in planned if training_changes(one.spec)} == changed


@pytest.mark.parametrize(
    ("words", "which"),
    [
        ([], "final"),
        (["--load-best"], "best"),
        (["--load-checkpoint", "500"], 500),
        (["--load-checkpoint", "0"], 0),
        (["--load-last-checkpoint"], "last checkpoint"),
    ],
)
def test_which_model_is_played(words, which):
    assert model_request(enjoy.build_parser().parse_args(words)).which == which


# --- Every flag with every odd value: it has a meaning, or it is refused in one line.

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
        ["--num-threads", "-1", "--eval-freq", "-5", "--log-interval", "1e12", "--seed", "-1"],
        ["--num-threads", "0", "--eval-freq", "0", "--save-freq", "-3", "--seed", "4294967295"],
        ["--eval-episodes", "1", "--n-eval-envs", "1e3", "-params", "n_envs:2e0"],
        ["--log-interval", "-2", "--verbose", "2"],
    ],
)
def test_what_is_taken_trains(words, tmp_path):
    words = [*BASES[train], "-f", str(tmp_path), "-tb", str(tmp_path / "tb"), *words]
    spec = train_spec(train.build_parser().parse_args(words))
    outcome = carry_out(prepare(spec, Console(file=io.StringIO()), {}, ""))
    assert outcome.n_steps in (5, 6)
    # TensorBoard calls a run after its agent.
    assert [path.name for path in (tmp_path / "tb" / "FrozenLake-v1").iterdir()] == ["random_1"]


@pytest.mark.parametrize("text", ["1e5", "100000.0"])
def test_a_budget_in_settings_may_be_written_as_a_float(text, tmp_path):
    path = tmp_path / "own.yml"
    path.write_text(f"default:\n  n_timesteps: {text}\n")
    for where in (["-params", f"n_timesteps:{text}"], ["-conf", str(path)]):
        words = ["--algo", "random", "--env", "FrozenLake-v1", *where]
        spec = train_spec(train.build_parser().parse_args(words))
        assert spec.hyperparams.n_timesteps == 100_000


@pytest.mark.parametrize("device", ["nonsense", "", "cuda:99"])
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


# --- A flag that there is not is answered with what was meant.


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
        (TRAIN, "--gamma", "-params gamma:VALUE "),
        (TRAIN, "--gamma --seed 3", "-params gamma:VALUE "),
        (TRAIN, "--alpha 0.1 --algo qlearning", "-params learning_rate:0.1 "),
        (TRAIN, "--alpha 0.1 --algo linucb", "-params alpha:0.1 "),
        (TRAIN, "--epsilon 0.1 --algo dqn", "-params exploration_final_eps:0.1 "),
        (TRAIN, "--epsilon 0.1 --algo epsilon_greedy", "-params exploration_"),
        (TRAIN, "--tie-breaking first --algo qlearning", "-params tie_breaking:first "),
        (TRAIN, "--n-steps 128", "-params n_steps:128 "),
        (TRAIN, "--n-steps 128 --algo qlearning", "did you mean '--n-timesteps'?"),
        (TRAIN, "--net-arch [64]", '-params policy_kwargs:"dict(net_arch=[64, 64])" '),
        (TRAIN, "--timesteps 5", "did you mean '--n-timesteps'?"),
        (TRAIN, "--episodes 5", "did you mean '--n-episodes'?"),
        (TRAIN, "--algorithm dqn", "did you mean '--algo'?"),
        (TRAIN, "--num_threads 2", "did you mean '--num-threads'?"),
        (TRAIN, "--folder x", "did you mean '--log-folder'?"),
        (TRAIN, "-yaml x.yml", "did you mean '--conf-file'?"),
        (TRAIN, "--n-jobs 2", "not searched for here"),
        (TRAIN, "--wandb-entity=me", "-tb DIR writes TensorBoard logs"),
        (ENJOY, "--render-mode human", "did you mean '--render'?"),
        (ENJOY, "--log-folder x", "did you mean '--folder'?"),
        (ENJOY, "--video x.gif", "did you mean '--record'?"),
        (ENJOY, "--gamma 0.9", "a matter of training: train with -params gamma:VALUE "),
        (COMPARE, "--seed 3", "did you mean '--seeds'?"),
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


def hyperparameters():
    installed = [algo for algo, entry in ALGORITHMS.items() if entry.is_installed]
    return {p for algo in installed for p in inspect.signature(load_algorithm(algo)).parameters}


def test_all_hyperparameters_are_known_by_name():
    missed = {
        name
        for name in hyperparameters() - SET_BY_FLAGS
        if f"-params {name}:" not in hint([f"--{name}"], ["--hyperparams"], [])
    }
    assert missed == set()


def test_what_is_answered_is_not_here():
    assert (options(TRAIN) | options(ENJOY)).isdisjoint(INSTEAD)


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
    meant = {name for names in OTHER_NAMES.values() for name in names}
    assert meant - hyperparameters() == {"n_timesteps", "n_episodes", "n_envs"}


# --- What may be typed beside --resume: nothing that the run has already, not even as it has it.


ALLOWED = {
    "--save-state-every": "30s",
    "--keep-state": None,
    "--gym-packages": "math",
    "--log-folder": "logs",
    "--verbose": "0",
    "--progress": None,
}
OTHERS = {
    "--engine": "auto",
    "--eval-freq": "5",
    "--eval-episodes": "5",
    "--hyperparams": "gamma:0.9",
    "--env-kwargs": "a:1",
    "--eval-env-kwargs": "a:1",
    "--conf-file": "some.yml",
    "--trained-agent": "some.zip",
    "--tensorboard-log": "logs",
}


def flags():
    """All flags, each with a value where it takes one: where it can be, what it is by default."""
    for action in train.build_parser()._actions:
        flag = action.option_strings[-1]
        if flag not in ("--help", "--list", "--resume"):
            value = ALLOWED.get(flag, OTHERS.get(flag, str(action.default)))
            yield flag, None if action.nargs == 0 else value


@pytest.mark.parametrize(("flag", "value"), list(flags()))
def test_every_flag_beside_resume(type_in_own_folder, own_folder, flag, value):
    (own_folder / "run").mkdir()
    words = [flag] if value is None else [flag, value]
    code, _, said = type_in_own_folder("train.py", "--resume", "run", *words)
    assert (code, said.count("\n")) == (2, 1)
    refusal = f"{flag} cannot be given with --resume: the run has its own"
    assert (refusal in said) == (flag not in ALLOWED), said
    assert not list((own_folder / "run").iterdir())


def test_which_run_is_said_by_its_folder_or_by_its_agent_and_environment(type_in_own_folder):
    code, _, said = type_in_own_folder("train.py", "--algo", "ppo", "--resume")
    assert (code, said.count("\n")) == (2, 1)
    assert "no run of ppo on CartPole-v1 in logs was interrupted" in said


# --- The page for those who come from rl_zoo3 is complete, and says what is so.


PAGE = Path(__file__).parents[2] / "docs" / "from-rl-zoo3.md"
COMMANDS = {"train": train, "enjoy": enjoy}
FLAG = re.compile(r"`(--?[a-zA-Z][\w-]*)")


def flags_of_rl_zoo3(command):
    """The option strings of each argument, read off its source."""
    calls = [
        node
        for node in ast.walk(ast.parse((peer_folder("rl_zoo3") / f"{command}.py").read_text()))
        if isinstance(node, ast.Call) and getattr(node.func, "attr", "") == "add_argument"
    ]
    return {tuple(argument.value for argument in call.args) for call in calls}


def rows(command):
    """The cells of the command's table, without its head."""
    section = PAGE.read_text().split(f"\n## {command}\n")[1].split("\n## ")[0]
    lines = [line for line in section.splitlines() if line.startswith("|")]
    return [[cell.strip() for cell in line.strip("|").split("|")] for line in lines[2:]]


@pytest.mark.parametrize("command", COMMANDS)
def test_each_flag_has_its_row(command):
    expected = flags_of_rl_zoo3(command)
    assert len(expected) > 20
    found = [tuple(FLAG.findall(first)) for first, _ in rows(command)]
    assert len(found) == len(set(found))
    assert set(found) == expected


@pytest.mark.parametrize("command", COMMANDS)
def test_what_is_said_to_be_here_is_here(command):
    ours = options(COMMANDS[command])
    for theirs, here in rows(command):
        assert set(FLAG.findall(here)) <= ours, theirs
        assert FLAG.match(here) or here.startswith(("the same", "no", "what")), theirs


def test_what_is_said_not_to_be_here_is_answered(capsys):
    refused = [FLAG.findall(theirs) for theirs, here in rows("train") if here.startswith("no")]
    assert len(refused) > 15
    for flag in (flag for flags in refused for flag in flags):
        with pytest.raises(SystemExit):
            train.build_parser().parse_args([flag, "1"])
        err = capsys.readouterr().err
        assert err.count("\n") == 1
        assert re.search(rf"unknown argument {flag} 1: .*not", err)
