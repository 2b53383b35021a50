"""The page for those who come from rl_zoo3 is complete, and says what is so."""

import ast
import re
from pathlib import Path

import pytest

from commands import enjoy, train
from tests.peers.peer_environment import peer_folder

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
