"""From flags to specifications, and the flags of rl_zoo3."""

import ast
import re
from dataclasses import fields
from pathlib import Path

import pytest

from commands import compare, enjoy, train
from commands.compare import study_spec
from commands.enjoy import model_request
from commands.train import build_parser, train_spec
from experiments.plan import plan
from experiments.study import StudySpec
from pipeline.environments import training_changes
from pipeline.errors import UserError
from pipeline.train_spec import TrainSpec
from tests.peers.peer_environment import peer_folder

# --- from flags to specifications: a flag reaches the field that has its name ---------------------


TRAIN = ["--algo", "qlearning", "--env", "FrozenLake-v1", "-n", "60"]
COMPARE = ["--algos", "qlearning", "--env", "FrozenLake-v1", "-n", "60"]


@pytest.mark.parametrize(
    ("words", "name", "value"),
    [
        (["--seed", "7"], "seed", 7),
        (["--eval-freq", "-1"], "eval_freq", -1),
        (["--eval-episodes", "3"], "eval_episodes", 3),
        (["--eval-episodes", "3"], "final_episodes", 3),
        (["--n-eval-envs", "2"], "n_eval_envs", 2),
        (["--save-freq", "9"], "save_freq", 9),
        (["--vec-env", "subproc"], "vec_env", "subproc"),
        (["--device", "cpu"], "device", "cpu"),
        (["--num-threads", "2"], "num_threads", 2),
        (["--log-interval", "4"], "log_interval", 4),
        (["--verbose", "0"], "verbose", 0),
        (["--progress"], "progress", True),
        (["--uuid"], "unique_id", True),
    ],
)
def test_a_flag_of_train_reaches_the_specification(words, name, value):
    args = train.build_parser().parse_args([*TRAIN, *words])
    assert getattr(train_spec(args), name) == value


def test_the_page_that_plays_a_training(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)

    def spec_of(*words):
        return train_spec(train.build_parser().parse_args([*TRAIN, *words]))

    page = ("--watch-learning", "page.html")
    assert (spec_of(*page).watch_learning, spec_of(*page).watch_episodes) == (Path("page.html"), 0)
    assert spec_of(*page, "--watch-episodes", "3").watch_episodes == 3
    for words, complaint in [
        (("--watch-episodes", "3"), "says how much --watch-learning shows: give that too"),
        (("--watch-learning", "page.pdf"), "writes a .html file, not 'page.pdf'"),
        (("--watch-learning", "no/page.html"), "there is no folder no"),
        (("--watch-learning", "/proc/page.html"), "nothing can be written in /proc: No such file"),
    ]:
        with pytest.raises(UserError, match=complaint):
            spec_of(*words)
    (tmp_path / "page.html").mkdir()
    with pytest.raises(UserError, match=r"page\.html is a folder"):
        spec_of(*page)


def test_without_flags_a_run_is_the_default_one():
    spec = train_spec(train.build_parser().parse_args(TRAIN))
    own = {"algo", "env_id", "hyperparams", "saved_hyperparams", "seed"}
    # A study has the same number of episodes in all its runs; a run by itself as few as will do.
    assert (spec.eval_episodes, spec.final_episodes) == (None, None)
    own |= {"eval_episodes", "final_episodes", "origins"}
    assert {
        key.name: getattr(spec, key.name) for key in fields(TrainSpec) if key.name not in own
    } == {key.name: key.default for key in fields(TrainSpec) if key.name not in own}


@pytest.mark.parametrize(
    ("words", "name", "value"),
    [
        (["--seeds", "3"], "n_seeds", 3),
        (["--metric", "best"], "metric", "best"),
        (["--margin", "0.5"], "margin", 0.5),
        (["--episodes-table", "5"], "episodes_table", 5),
        (["--render-every", "6"], "render_every", 6),
        (["--watch-learning"], "learning_pages", True),
        ([], "figures", ("png", "svg")),
        (["--figures", "pdf", "png"], "figures", ["pdf", "png"]),
        (["--name", "mine"], "name", "mine"),
        (["--quick"], "is_quick", True),
        (["--quick"], "n_seeds", 2),
        ([], "is_quick", False),
        ([], "n_seeds", StudySpec.n_seeds),
        ([], "metric", "final"),
    ],
)
def test_a_flag_of_compare_reaches_the_study(words, name, value):
    study = study_spec(compare.build_parser().parse_args([*COMPARE, *words]))
    assert getattr(study, name) == value


def test_everybody_is_trained_on_the_environment_as_it_comes(tmp_path):
    words = ["--env", "Warehouse-v0", "--algos", "ppo", "qlearning"]
    for flags, changed in ((), {"ppo"}), (["--as-it-comes"], set()):
        study = study_spec(compare.build_parser().parse_args([*words, *flags]))
        planned = plan(study, tmp_path)
        assert {one.agent for one in planned if training_changes(one.spec)} == changed


def test_what_a_study_says_of_its_runs_reaches_them(tmp_path):
    study = StudySpec(
        "s",
        "S",
        study_spec(compare.build_parser().parse_args(COMPARE)).agents,
        study_spec(compare.build_parser().parse_args(COMPARE)).environments,
        n_seeds=1,
        eval_freq=11,
        eval_episodes=13,
        gym_packages=("gymnasium",),
    )
    (planned,) = plan(study, tmp_path)
    spec = planned.spec
    assert (spec.eval_freq, spec.eval_episodes, spec.gym_packages) == (11, 13, ("gymnasium",))


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


# --- what may be typed beside --resume: nothing that the run has already, not even as it has it----


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
    for action in build_parser()._actions:
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


# --- the page for those who come from rl_zoo3 is complete, and says what is so --------------------


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
    ours = {
        flag
        for action in COMMANDS[command].build_parser()._actions
        for flag in action.option_strings
    }
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
