"""``audit``: its flags, the algorithm that they select, and its verdict in words."""

from __future__ import annotations

import argparse
import sys
from typing import TYPE_CHECKING, Any

from rl_yardstick.commands import cli
from rl_yardstick.commands.cli import OneLineParser, flag, shared, whole_number, with_engine
from rl_yardstick.diagnosis.faults import FAULTS, KINDS
from rl_yardstick.pipeline.errors import UserError

if TYPE_CHECKING:
    from rl_yardstick.diagnosis.audit import Verdict
    from rl_yardstick.diagnosis.subjects import Subject

WORDS = {"ok": "ok", "fault": "FAULT", "unsaid": "nothing can be said", "skipped": "skipped"}

EPILOG = """\
examples:
  python -m rl_yardstick audit --algo qlearning
  python -m rl_yardstick audit --algo my_agents:MyQLearning --kind q_learning
  python -m rl_yardstick audit --script my_script:train --kind sarsa

A script's function is train(make_env, seed, gamma, steps, ...). It returns an object with act(obs),
the action where it is evaluated, and values(obs), a number or one for each action.

Exit code: 0 if it is right, 1 if it has a fault, 2 if nothing can be said.
"""


def build_parser() -> OneLineParser:
    """The flags."""
    words = "Test an implementation for known bugs, on tiny worlds with exact values."
    spaces = ("discrete", "box")
    kinds = f"the kind of algorithm (default: as its class): {', '.join(KINDS)}"
    flags = (
        *shared("--gym-packages", "--engine", "--hyperparams"),
        flag("--kind", kinds, choices=[*KINDS], metavar="KIND"),
        flag("--observations", "numbers or vectors (default: what works)", choices=spaces),
        flag("--actions", "one of two, or a number (default: what works)", choices=spaces),
        flag("--seeds", "seeds for a probe that fails: the majority", whole_number(1, 100), 3),
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
    from rl_yardstick.commands.terminal import TextConsole, say
    from rl_yardstick.pipeline.files import write_json

    console = TextConsole()
    with console.status("loading the libraries"):
        import torch as th

        th.set_num_threads(1)  # networks as small as these are slower with two
        subject = subject_of(args)
        from rl_yardstick.diagnosis.audit import Verdict, audit
    say(console, f"audit of {subject.name}")
    findings = []
    for finding in audit(subject, range(args.seeds)):
        findings.append(finding)
        reason = "" if finding.state in ("fault", "ok") else f": {finding.text}"
        say(console, f"  {finding.probe:<36}{WORDS[finding.state]}{reason}")
    verdict = Verdict(subject.name, tuple(findings))
    for line in verdict_lines(verdict):
        say(console, line)
    if args.json is not None:
        write_json(args.json, verdict.as_json())
    return verdict.exit_code


def subject_of(args: argparse.Namespace) -> Subject:
    """The algorithm that the arguments select; imports its module."""
    from rl_yardstick.pipeline.settings import check_agent, parse_assignments

    module, _, attribute = (args.script or "").rpartition(":")
    args.gym_packages = [*args.gym_packages, *([module] if module else [])]
    cli.import_typed(args)
    from rl_yardstick.diagnosis.subjects import ClassSubject, ScriptSubject

    typed: dict[str, Any] = parse_assignments(args.hyperparams, "-params")
    wanted = args.observations, args.actions
    if args.script is None:
        check_agent(args.algo)
        typed = with_engine(args.algo, typed, args.engine)
        return ClassSubject(args.algo, typed, args.kind, wanted)
    function = getattr(sys.modules.get(module), attribute, None)
    if not callable(function):
        raise UserError(f"--script takes module:function, and there is no function {args.script}")
    if args.engine is not None:
        raise UserError("--engine: a script has none")
    return ScriptSubject(args.script, function, typed, args.kind, wanted)


def verdict_lines(verdict: Verdict) -> list[str]:
    """The verdict, in a few lines."""
    unsaid = [finding.probe for finding in verdict.findings if finding.state == "unsaid"]
    if not verdict.faults:
        if not verdict.is_right:
            return ["nothing can be said: whether its targets are right could not be decided"]
        rest = f", but for {', '.join(unsaid)}, of which nothing can be said" if unsaid else ""
        return [f"right, as far as these probes see{rest}"]
    lines = []
    for finding in verdict.faults:
        fault = FAULTS[finding.fault]
        told = f"measured: {finding.text}; right would be: {finding.right}"
        lines += [f"fault: {finding.fault}. {fault.sentence}"]
        lines += [f"  {told}", f"  see: {fault.source}"]
    return lines
