"""``explain``: where an agent loses return against the optimum."""

from __future__ import annotations

import argparse
import sys
from contextlib import closing
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

from rl_yardstick.commands import cli
from rl_yardstick.commands.cli import OneLineParser, flag, shared
from rl_yardstick.commands.enjoy import MODEL_FLAGS, found_model, wanted_model
from rl_yardstick.commands.terminal import TextConsole, say
from rl_yardstick.pipeline.errors import UserError

if TYPE_CHECKING:
    from rich.console import Console
    from stable_baselines3.common.base_class import BaseAlgorithm

    from rl_yardstick.diagnosis.explanation import Explanation
    from rl_yardstick.pipeline.evaluation.exact import ExactEvaluator
    from rl_yardstick.pipeline.models import Model, Wanted

EPILOG = """\
examples:
  python -m rl_yardstick explain --env FrozenLake-v1 --algo qlearning
  python -m rl_yardstick explain logs/my_study --algo dqn --env Taxi-v4     # its median run
"""


def build_parser() -> OneLineParser:
    """The flags: those of enjoy.py that select an agent, and those of the explanation."""
    tested = "train four seeds with this change, as shipped and as it is; without a change: with "
    tested += "each of the proposed changes"
    own = (
        flag("--test", tested, nargs="*", action="append", metavar="KEY:VALUE"),
        flag("--map", "draw the cost of each cell, as .png", Path, metavar="FILE"),
        *shared("--model", "--jobs", "--json"),
    )
    words = "Show where an agent loses return against the optimum, exactly."
    parser = OneLineParser(words, EPILOG, {"": MODEL_FLAGS, "explaining": own})
    parser.set_defaults(seed=0)
    return parser


def main() -> int:
    """Explain an agent."""
    args = build_parser().parse_args()
    from rl_yardstick.report.words import why_lines

    console = TextConsole()
    found, agent, evaluator = asked(console, wanted_model(args))
    from rl_yardstick.diagnosis.explanation import explanation

    explained = explanation(found.spec, agent, evaluator)
    say(console, "\n".join(why_lines(explained)))
    if explained.proposals and args.test is None:
        say(console, "to see what helps, one change or all that are proposed:")
        for change in (*explained.proposals[:2], ""):
            typed = *sys.argv[1:], "--test", *change.split()
            say(console, f"  {cli.to_copy('explain', *typed)}")
    data = explained.as_data()
    if args.map is not None:
        draw(args.map, f"{found.spec.algo} on {found.spec.place}", agent, evaluator, explained)
        say(console, f"map: {args.map}")
    if args.test is not None:
        data["tried"] = tried_changes(console, args, found, explained)
    cli.write_result(args, data)
    return 0


def asked(console: Console, wanted: Wanted) -> tuple[Model, BaseAlgorithm, ExactEvaluator]:
    """Find and load an agent, and compute the optimum of its environment."""
    found = found_model(console, median_run(wanted))
    with console.status("computing the optimum"):
        from rl_yardstick.pipeline.evaluation.exact import exact_evaluator, model_refusal
        from rl_yardstick.pipeline.models import load_agent
        from rl_yardstick.pipeline.playing import playing_env

        spec = found.spec
        evaluator = exact_evaluator(spec)
        if evaluator is None:
            reason = model_refusal(spec, False) or f"the model of {spec.env_id} is not known"
            raise UserError(f"{reason}, so the gap to the optimum cannot be split")
        with closing(playing_env(found, None)) as env:
            return found, load_agent(found, env), evaluator


def median_run(wanted: Wanted) -> Wanted:
    """The request, with a study's folder replaced by its run of (lower) median return."""
    if wanted.path is None or not (table := wanted.path / "summary.csv").is_file():
        return wanted
    import pandas as pd

    rows = pd.read_csv(table, dtype={"agent": str, "environment": str})
    flags = {"agent": ("--algo", wanted.algo), "environment": ("--env", wanted.env_id)}
    for column, (typed, name) in flags.items():
        names = [str(each) for each in rows[column].unique()]
        chosen = names[0] if name is None and len(names) == 1 else name
        if chosen not in names:
            raise UserError(f"{wanted.path} is a study: choose one by {typed}: {', '.join(names)}")
        rows = rows[rows[column] == chosen]
    rows = rows.sort_values("final", kind="stable")
    place = Path(str(rows["path"].iloc[(len(rows) - 1) // 2]))  # the study may have been moved
    run = wanted.path.joinpath("runs", *place.parts[-2:])
    return replace(wanted, path=run, algo=None, env_id=None)


def draw(path: Path, title: str, agent: Any, evaluator: Any, explained: Explanation) -> None:
    """Draw the cost of each cell."""
    from rl_yardstick.pipeline.evaluation.value_maps import MAX_STATES, value_map
    from rl_yardstick.pipeline.pictures import draw_cost_map

    if path.suffix != ".png":
        raise UserError(f"--map writes a .png, not {path}")
    found = value_map(evaluator, agent)
    if found is None:
        raise UserError(f"--map: only grid worlds of up to {MAX_STATES:,} states have a map")
    draw_cost_map(path, title, found, explained.losses)


def tried_changes(
    console: Any, args: argparse.Namespace, model: Model, explained: Explanation
) -> list[Any]:
    """Train four seeds as shipped, as it is and with each change; return the returns as JSON."""
    from rl_yardstick.commands.compare import Job, finished, held
    from rl_yardstick.experiments.plan import StudyRecord, specs_of
    from rl_yardstick.experiments.pool import Workers
    from rl_yardstick.experiments.results import tried
    from rl_yardstick.experiments.study import intervention_study
    from rl_yardstick.pipeline.run import Stop
    from rl_yardstick.report.words import tried_lines

    spec, run = model.spec, model.run
    changes = [" ".join(change) for change in args.test if change] or explained.proposals
    name = model.path.stem if run is None else f"{spec.algo}_{run.name}"
    study = intervention_study(spec, changes, name)
    root, record = Path(args.folder) / "explain" / study.name, StudyRecord(study, specs_of(study))
    job = Job(root, cli.command_line(), console, Stop().listen(), Workers(args.jobs))
    with held(root), job.workers:
        found = tried(finished(job, record)[0])
    for line in tried_lines(found, explained.optimum):
        say(console, line)
    return [{"change": each.change, "returns": each.finished.tolist()} for each in found]
