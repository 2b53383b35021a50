"""``audit.py``: its flags, the algorithm they select, and the output of the audit."""

from __future__ import annotations

import argparse
import json
import textwrap
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

from rl_yardstick.commands.cli import FIRST_SEED, OneLineParser, add_shared, filled, whole_number
from rl_yardstick.pipeline import loading_libraries
from rl_yardstick.pipeline.errors import UserError, one_line
from rl_yardstick.pipeline.failures import exits_as_mistakes
from rl_yardstick.pipeline.stopping import stops_noticed

if TYPE_CHECKING:
    from rl_yardstick.diagnosis.audit import Verdict
    from rl_yardstick.diagnosis.probes import Finding
    from rl_yardstick.diagnosis.subjects import Subject

# As in `diagnosis.subjects`, which takes long to import.
KINDS = (
    *("q_learning", "off_policy_monte_carlo", "sarsa", "expected_sarsa"),
    *("actor_critic", "policy_gradient"),
)

WORDS = {"ok": "ok", "fault": "FAULT", "unsaid": "nothing can be said", "skipped": "skipped"}
WIDTH = 100

EPILOG = """\
examples:
  python -m rl_yardstick audit --algo qlearning
  python -m rl_yardstick audit --algo ppo -params n_epochs:5
  python -m rl_yardstick audit --algo my_agents:MyQLearning --kind q_learning
  python -m rl_yardstick audit --script my_script:train --kind sarsa

A script's function is train(make_env, seed, gamma, steps, ...). It returns an object with act(obs),
the action where it is evaluated, and values(obs), a number or one for each action.

Exit code: 0 if it is right, 1 if it has a fault, 2 if nothing can be said.
"""


def build_parser() -> argparse.ArgumentParser:
    """The flags."""
    parser = OneLineParser(
        description="Train an algorithm on tiny worlds whose values are known exactly, and say "
        "whether it is right, or which fault it has.",
        epilog=EPILOG,
    )
    what = parser.add_mutually_exclusive_group(required=True)
    algo = "agent (see train.py --list), or a class of yours as module:Class"
    what.add_argument("--algo", type=filled, help=algo)
    script = "a function that trains, as module:function"
    what.add_argument("--script", type=filled, metavar="NAME", help=script)
    add = parser.add_argument
    add_shared(parser, "--gym-packages", "--engine")
    add_shared(parser, "--hyperparams", help="hyperparameters to change, e.g. learning_rate:0.01")
    kind = "what the algorithm claims to be (default: what its class says)"
    add("--kind", choices=KINDS, help=kind)
    spaces = "what {} (default: the first that works)"
    choices = ("discrete", "box")
    add("--observations", choices=choices, help=spaces.format("it observes: numbers or vectors"))
    add("--actions", choices=choices, help=spaces.format("it does: one of two, or a number"))
    seeds = "seeds for a probe that is not ok with the first; the majority decides (default: 3)"
    add("--seeds", type=whole_number(1, 100), default=3, metavar="N", help=seeds)
    add("--first-seed", type=FIRST_SEED, default=0, metavar="SEED", help="the first seed (0)")
    add("--json", type=filled, metavar="FILE", help="also write the findings to this file")
    return parser


def main() -> int:
    """Parse the arguments and audit; return the exit code."""
    args = build_parser().parse_args()
    with stops_noticed(), exits_as_mistakes():
        target = None if args.json is None else Path(args.json)
        if target is not None and (target.is_dir() or not target.absolute().parent.is_dir()):
            raise UserError(f"--json: {target} is no place for a file")
        from rl_yardstick.commands.terminal import TextConsole, say
        from rl_yardstick.pipeline.signs_of_life import doing

        console = TextConsole(highlight=False)
        with doing(console, "loading the libraries"), loading_libraries():
            subject = _subject(args)
            from rl_yardstick.diagnosis.audit import Verdict, audit
        say(console, f"audit of {subject.name}")
        findings = []
        with _one_thread():
            for finding in audit(subject, range(args.first_seed, args.first_seed + args.seeds)):
                findings.append(finding)
                for line in finding_lines(finding):
                    say(console, line)
        verdict = Verdict(subject.name, tuple(findings))
        for line in verdict_lines(verdict):
            say(console, line)
        if target is not None:
            text = json.dumps(verdict.as_json(), indent=2) + "\n"
            target.write_text(text, encoding="utf-8", newline="\n")
    return verdict.exit_code


def _subject(args: argparse.Namespace) -> Subject:
    """The algorithm that the arguments select."""
    from rl_yardstick.pipeline.agent_settings import with_engine
    from rl_yardstick.pipeline.settings.values import parse_assignments
    from rl_yardstick.pipeline.user_modules import import_typed

    name = args.algo or args.script
    if args.script is not None and ":" not in name:
        raise UserError(f"--script takes module:function, not {name!r}")
    import_typed(args.gym_packages, [name])
    from rl_yardstick.diagnosis.subjects import (
        ClassSubject,
        ScriptSubject,
        class_named,
        function_named,
    )

    typed: dict[str, Any] = parse_assignments(args.hyperparams, "-params")
    wanted = args.observations, args.actions
    if args.script is not None:
        if args.engine is not None:
            raise UserError("--engine: a script has none")
        return ScriptSubject(name, function_named(name), typed, args.kind, wanted)
    cls = class_named(name)
    typed = with_engine(name, typed, args.engine)
    try:
        return ClassSubject(name, cls, typed, args.kind, wanted)
    except (TypeError, ValueError) as error:
        raise UserError(f"{name}: {one_line(error)}") from error


class _one_thread:  # noqa: N801 (used as a function)
    """PyTorch with one thread: networks as small as these are slower with two."""

    def __enter__(self) -> None:
        import torch as th

        self.before = th.get_num_threads()
        th.set_num_threads(1)

    def __exit__(self, *exception: object) -> None:
        import torch as th

        th.set_num_threads(self.before)


def finding_lines(finding: Finding) -> Sequence[str]:
    """A line for a probe, with its finding if it is neither ok nor a fault."""
    head = f"  {finding.probe:<36}{WORDS[finding.state]}"
    if finding.state in ("fault", "ok"):
        return [head]
    return [f"{head}: {finding.text}"]


def verdict_lines(verdict: Verdict) -> Sequence[str]:
    """The verdict, in a few lines."""
    from rl_yardstick.diagnosis.faults import FAULTS

    unsaid = [finding.probe for finding in verdict.findings if finding.state == "unsaid"]
    if not verdict.faults:
        if not verdict.is_right:
            return ["nothing can be said: whether its targets are right could not be decided"]
        rest = f", but for {', '.join(unsaid)}, of which nothing can be said" if unsaid else ""
        return [f"right, as far as these probes see{rest}"]
    lines = []
    for finding in verdict.faults:
        fault = FAULTS[finding.fault]
        lines += [f"fault: {finding.fault}. {fault.sentence}"]
        lines += textwrap.wrap(
            f"measured: {finding.text}; right would be: {finding.right}",
            WIDTH,
            initial_indent="  ",
            subsequent_indent="  ",
        )
        lines += [f"  see: {fault.source}"]
    return lines
