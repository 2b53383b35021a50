"""``audit``: its flags, the algorithm that they select, and its verdict in words."""

from __future__ import annotations

import argparse
import sys
from typing import TYPE_CHECKING, Any

from rl_yardstick.commands import cli
from rl_yardstick.commands.cli import OneLineParser, flag, shared, whole_number
from rl_yardstick.commands.terminal import TextConsole, say
from rl_yardstick.pipeline.errors import UserError

if TYPE_CHECKING:
    from rl_yardstick.diagnosis.subjects import Subject

SPACES = ("discrete", "box")
KINDS = ("q_learning", "off_policy_monte_carlo", "sarsa", "expected_sarsa", "actor_critic")

EPILOG = """\
examples:
  python -m rl_yardstick audit --algo qlearning
  python -m rl_yardstick audit --algo my_agents.py:MyQLearning --kind q_learning
  python -m rl_yardstick audit --script my_script.py:train --kind sarsa

A script's function is train(make_env, seed, gamma, steps, ...). It returns an object with act(obs),
the action where it is evaluated, and values(obs), a number or one for each action.

Exit code: 0 if it is right, 1 if it is wrong, 2 if it cannot be read.
"""


def build_parser() -> OneLineParser:
    """The flags."""
    words = "Measure the backup of an implementation, and name its fault if it has a known one."
    kinds = f"the kind of algorithm (default: as its class or name): {', '.join(KINDS)}"
    flags = (
        *shared("--gym-packages", "--hyperparams"),
        flag("--kind", kinds, choices=[*KINDS, "policy_gradient"], metavar="KIND"),
        flag("--observations", "numbers or vectors (default: what works)", choices=SPACES),
        flag("--seeds", "trainings (default: 3, or 2 of networks)", whole_number(1, 100)),
        *shared("--json"),
    )
    parser = OneLineParser(words, EPILOG, {"": flags})
    what = parser.add_mutually_exclusive_group(required=True)
    what.add_argument("--algo", help="agent (train.py --list), or a class of yours: module:Class")
    what.add_argument("--script", metavar="NAME", help="a function that trains: module:function")
    return parser


def main() -> int:
    """Audit an algorithm; return the exit code."""
    args = build_parser().parse_args()
    console = TextConsole()
    with console.status("loading the libraries"):
        import torch as th

        th.set_num_threads(1)  # networks as small as these are slower with two
        subject = subject_of(args)
        from rl_yardstick.diagnosis.audit import audit
    with console.status(f"training {subject.name}"):
        verdict = audit(subject, args.seeds or 0)
    for line in verdict.lines():
        say(console, line)
    cli.write_result(args, verdict.as_json())
    return verdict.exit_code


def subject_of(args: argparse.Namespace) -> Subject:
    """The algorithm that the arguments select; imports its module."""
    from rl_yardstick.pipeline.settings import check_agent, parse_assignments

    module, _, attribute = (args.script or "").rpartition(":")
    args.gym_packages = [*args.gym_packages, *([module] if module else [])]
    cli.import_typed(args)
    from rl_yardstick.diagnosis.subjects import ClassSubject, ScriptSubject
    from rl_yardstick.pipeline.components import module_name

    typed: dict[str, Any] = parse_assignments(args.hyperparams, "-params")
    if args.script is None:
        check_agent(args.algo)
        return ClassSubject(args.algo, typed, args.kind, args.observations)
    function = getattr(sys.modules.get(module_name(module)), attribute, None)
    if not callable(function):
        raise UserError(f"--script takes module:function, and there is no function {args.script}")
    return ScriptSubject(args.script, function, typed, args.kind, args.observations)
