"""What is said of a run, and what the lists of agents and environments hold, to the letter."""

import io
import sys
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from uuid import uuid4

import numpy as np
import pytest
from rich.console import Console

from agents import ALGORITHMS
from commands import terminal
from commands.terminal import TextConsole, describe
from commands.train import (
    describe_pulls,
    print_header,
    print_lists,
    print_outcome,
    watch_command,
)
from machine_code import WorkTime
from pipeline.evaluation.sampled import Evaluation, Yardstick
from pipeline.runs import Run
from pipeline.settings.hyperparams import split
from pipeline.train_spec import TrainSpec
from pipeline.user_modules import UserModule


@pytest.fixture(autouse=True)
def typed(monkeypatch):
    """How the command was begun."""
    words = ["train.py"]
    monkeypatch.setattr(sys, "argv", words)
    return words


def console_of(width=200):
    return Console(file=io.StringIO(), width=width)


def spec_of(log_folder="logs", **entry):
    return TrainSpec(
        "qlearning", "Lake-v1", split(entry), entry, seed=7, log_folder=Path(log_folder)
    )


SAMPLED = Evaluation(np.array([1.0, 3.0]), np.array([5.0, 7.0]), successes=None)
EXACT = Evaluation(
    np.array([70.0]),
    np.array([9.0]),
    successes=np.array([0.875]),
    exact_std=1.0,
    yardstick=Yardstick(optimum=80.0, baseline=-20.0),
)


def outcome_of(**changes):
    fields = {
        "run": Run(Path("logs/qlearning/Lake-v1_3"), "Lake-v1"),
        "state": "finished",
        "n_steps": 12_345,
        "taken": WorkTime(2.0, 1.5),
        "final": None,
        "best_return": None,
        "best_timesteps": 0,
        "best_episodes": 0,
        "evaluating": WorkTime(3.0, 0.5),
        "evaluation_steps": 0,
        "engine": None,
        "pulls": None,
    }
    return SimpleNamespace(**{**fields, **changes})


def pulls_of(**changes):
    fields = {
        "n_pulls": 1500,
        "regret": None,
        "optimal": 0.0,
        "reward": None,
        "n_matched": 0,
    }
    return SimpleNamespace(**{**fields, **changes})


def printed(outcome, spec):
    console = console_of()
    print_outcome(console, spec, outcome)
    return [line.rstrip() for line in console.file.getvalue().splitlines()]


def test_evaluations_in_words():
    assert describe(SAMPLED) == "return 2.00 ± 1.00 over 2 episodes"
    assert describe(EXACT) == (
        "return 70.00 (exact), success 87.5%, optimum 80.00, "
        "best random or constant policy -20.00, score 0.90"
    )


@pytest.mark.parametrize(
    ("pulls", "words"),
    [
        (pulls_of(), "not known: none of 1,500 pulls is in the log"),
        (
            pulls_of(reward=0.25, n_matched=1200),
            "not known; reward 0.2500 a pull over the 1,200 of 1,500 that are in the log",
        ),
        (
            pulls_of(regret=1234.5, optimal=0.97),
            "1,234.50 over 1,500 pulls; a best arm in 97% of the last 100",
        ),
        (
            pulls_of(regret=0.0, optimal=1.0, n_pulls=40),
            "0.00 over 40 pulls; a best arm in 100% of the last 40",
        ),
    ],
)
def test_pulls_in_words(pulls, words):
    assert describe_pulls(pulls) == words


def test_a_run_with_nothing_to_tell():
    assert printed(outcome_of(), spec_of()) == [
        "trained  12,345 steps in 1.5 s of processor time (8,230 steps/s)",
        "files    logs/qlearning/Lake-v1_3",
        "watch    python enjoy.py --algo qlearning --env Lake-v1",
    ]


def test_a_run_with_everything():
    outcome = outcome_of(
        state="interrupted",
        engine="compiled",
        pulls=pulls_of(),
        final=SAMPLED,
        best_return=3.25,
        best_timesteps=10_000,
        best_episodes=5,
        evaluation_steps=700,
        taken=WorkTime(),
        n_steps=1000,
    )
    assert printed(outcome, spec_of("else where")) == [
        "interrupted  1,000 steps in 0.0 s of processor time (1,000,000,000,000 steps/s)",
        "engine       compiled",
        "regret       not known: none of 1,500 pulls is in the log",
        "final        return 2.00 ± 1.00 over 2 episodes",
        "best         return 3.25 over 5 episodes, first at step 10,000",
        "tests        700 steps beside training (70% of it); 0.5 s of processor time",
        "files        logs/qlearning/Lake-v1_3",
        "watch        python enjoy.py --algo qlearning --env Lake-v1 -f 'else where'",
    ]


@pytest.mark.parametrize(
    ("algo", "settings", "lines"),
    [
        ("qlearning", {"gamma": 0.9}, ["gamma=0.9  n_timesteps=9"]),
        ("qlearning", {"policy": "QTablePolicy"}, ["n_timesteps=9"]),
        ("dqn", {"policy": "MlpPolicy"}, ["policy=MlpPolicy  n_timesteps=9"]),
        (
            "qlearning",
            {"learning_rate": "exp_0.3_0.05"},
            [
                "n_timesteps=9",
                "learning_rate=exp_0.3_0.05 (falls exponentially from 0.3 to 0.05)",
            ],
        ),
        (
            "ppo",
            {"clip_range": "lin_0.2", "ent_coef": "lin_0.01_0.02"},
            [
                "n_timesteps=9",
                "clip_range=lin_0.2 (falls linearly from 0.2 to 0)",
                "ent_coef=lin_0.01_0.02 (rises linearly from 0.01 to 0.02)",
            ],
        ),
        (
            "qlearning",
            {"train_env_kwargs": {"slip": 0.1}},
            ["n_timesteps=9", "train_env_kwargs={'slip': 0.1} (in training alone)"],
        ),
    ],
)
def test_what_is_about_to_be_trained_is_explained(algo, settings, lines):
    for budget, told in (({"n_timesteps": 9}, "9 steps"), ({"n_episodes": 1500}, "1,500 episodes")):
        console = console_of()
        print_header(console, replace(spec_of(**settings, **budget), algo=algo))
        head, *found = console.file.getvalue().splitlines()
        assert head == f"{algo} on Lake-v1, seed 7, {told}"
        ((name, number),) = budget.items()
        assert found == [line.replace("n_timesteps=9", f"{name}={number}") for line in lines]


# --- lists ----------------------------------------------------------------------------------------


@pytest.fixture
def lists(monkeypatch):
    """The lines of both lists, on a wide terminal."""
    return listed(monkeypatch, 600)


def listed(monkeypatch, width):
    file = io.StringIO()
    monkeypatch.setattr(
        terminal, "table_console", lambda **more: Console(file=file, width=width, **more)
    )
    print_lists()
    return [line.rstrip() for line in file.getvalue().splitlines()]


def test_every_agent_has_a_line(lists):
    first, *agents = lists[: len(ALGORITHMS) + 1]
    width = len("agent (--algo)") + 2
    width = max(width, *(len(name) + 2 for name in ALGORITHMS))
    assert first == f"{'agent (--algo)':{width}}what it is"
    assert agents == [f"{name:{width}}{entry.summary}" for name, entry in ALGORITHMS.items()]
    # An empty line stands between the lists.
    assert lists[len(ALGORITHMS) + 1] == ""
    assert lists[len(ALGORITHMS) + 2].startswith("environment (--env)")


def test_an_environment_names_the_agents_that_are_tuned_for_it_and_those_that_fit(lists):
    (place,) = (n for n, line in enumerate(lists) if line.startswith("Warehouse-v0 "))
    tuned = lists[place].removeprefix("Warehouse-v0")
    also, fitting = lists[place + 1].split(maxsplit=1)
    assert also == "also:"
    assert {"qlearning", "sarsa", "ppo"} <= set(tuned.split())
    assert not set(tuned.split()) & set(fitting.split())
    assert set(tuned.split()) | set(fitting.split()) <= set(ALGORITHMS)
    assert lists[-2] == ""
    assert lists[-1].startswith("Any other environment registered with Gymnasium works where")


def test_the_command_to_watch_with_is_one_line_however_long():
    folder = "a folder/" * 20
    (line,) = printed(outcome_of(), spec_of(folder))[-1:]
    assert line.startswith("watch    python enjoy.py --algo qlearning --env Lake-v1 -f 'a folder/")
    assert line.endswith("a folder'")


@pytest.mark.parametrize(
    ("others", "choice"),
    [
        ([], "--algo qlearning --env Lake-v1 -f {logs}"),
        (["Lake-v1_2"], "--algo qlearning --env Lake-v1 -f {logs}"),
        (["Lake-v1_4"], "--algo qlearning --env Lake-v1 -f {logs} --exp-id 3"),
        # Two that only the unique suffix tells apart.
        ([f"Lake-v1_3_{uuid4()}"], "{logs}/qlearning/Lake-v1_3"),
    ],
)
def test_the_command_to_watch_with_names_this_run(tmp_path, typed, others, choice):
    typed[0] = "/some where/train.py"
    spec = spec_of(tmp_path)
    for name in ("Lake-v1_3", *others):
        (tmp_path / "qlearning" / name).mkdir(parents=True)
    command = watch_command(spec, Run(tmp_path / "qlearning" / "Lake-v1_3", "Lake-v1"))
    assert command == f"python '/some where/enjoy.py' {choice.format(logs=tmp_path)}"


def test_the_command_to_watch_with_names_modules():
    modules = (UserModule("one", "one"), UserModule("./my two.py", "two", "/x/my two.py"))
    spec = replace(spec_of(), user_modules=modules)
    command = watch_command(spec, outcome_of().run)
    assert command.endswith(" --env Lake-v1 --gym-packages one './my two.py'")


@pytest.mark.parametrize(("length", "shown"), [(200, "S" * 200), (201, "S" * 200 + "...")])
def test_a_long_setting_is_cut_short_in_the_header(length, shown):
    console = console_of(1000)
    print_header(console, spec_of(env_wrapper="S" * length, n_timesteps=1))
    assert f"env_wrapper={shown}" in console.file.getvalue().replace("\n", "  ").split("  ")


# --- into a file or a pipe ------------------------------------------------------------------------


def test_redirected_no_row_is_broken_and_in_a_terminal_rows_hang():
    outcome = outcome_of(final=EXACT)
    file = io.StringIO()
    print_outcome(TextConsole(file=file, width=80, _environ={}), spec_of(), outcome)
    lines = file.getvalue().splitlines()
    assert f"final    {describe(EXACT)}" in lines
    assert [line for line in lines if line != line.rstrip()] == []
    file = io.StringIO()
    print_outcome(
        TextConsole(file=file, width=80, force_terminal=True, no_color=True, _environ={}),
        spec_of(),
        outcome,
    )
    lines = [line.rstrip() for line in file.getvalue().splitlines()]
    begins = next(place for place, line in enumerate(lines) if line.startswith("final"))
    assert len(lines[begins]) <= 80
    assert lines[begins + 1].startswith(" " * 9 + "constant policy")


@pytest.mark.parametrize("is_terminal", [False, True])
def test_redirected_no_sentence_is_broken(is_terminal):
    file = io.StringIO()
    console = TextConsole(file=file, width=20, force_terminal=is_terminal, _environ={})
    console.print("a line of more than twenty letters", highlight=False)
    assert (file.getvalue() == "a line of more than twenty letters\n") is not is_terminal


@pytest.mark.parametrize("width", [80, 100, 200])
def test_the_lists_fit_the_terminal_and_keep_every_name(width, monkeypatch):
    lines, widest = listed(monkeypatch, width), listed(monkeypatch, 2000)
    n_tables = lines.index("", len(ALGORITHMS) + 2)  # a sentence comes after them
    assert max(map(len, lines[:n_tables])) <= width
    assert sorted(" ".join(lines).split()) == sorted(" ".join(widest).split())


@pytest.mark.parametrize(("columns", "width"), [(None, 80), ("132", 132)])
def test_redirected_tables_have_80_columns(columns, width, monkeypatch, capsys):
    if columns:
        monkeypatch.setenv("COLUMNS", columns)
    else:
        monkeypatch.delenv("COLUMNS", raising=False)
    print_lists()
    lines = capsys.readouterr().out.splitlines()
    # The last is a sentence, and on one line.
    assert width - 15 < max(map(len, lines[:-1])) <= width
