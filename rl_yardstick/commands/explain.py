"""``explain.py``: where an agent loses return against the optimum."""

from __future__ import annotations

import argparse
from contextlib import ExitStack, closing
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

from rl_yardstick.commands.cli import OneLineParser, add_shared, command_line, filled
from rl_yardstick.commands.enjoy import add_model_flags, found_model, model_request
from rl_yardstick.pipeline.errors import UserError
from rl_yardstick.pipeline.failures import exits_as_mistakes
from rl_yardstick.pipeline.stopping import stops_noticed

if TYPE_CHECKING:
    from rich.console import Console
    from stable_baselines3.common.base_class import BaseAlgorithm

    from rl_yardstick.diagnosis.explanation import Explanation
    from rl_yardstick.pipeline.evaluation.exact import ExactEvaluator
    from rl_yardstick.pipeline.models.choose import ChosenModel, ModelRequest

EPILOG = """\
examples:
  python -m rl_yardstick explain --env FrozenLake-v1 --algo qlearning
  python -m rl_yardstick explain logs/dqn/Taxi-v4_1 --json why.json
  python -m rl_yardstick explain logs/my_study --algo dqn --env Taxi-v4     # its median run
  python -m rl_yardstick explain logs/sarsa/CliffWalking-v1_1 \\
    --against logs/qlearning/CliffWalking-v1_1
"""


def build_parser() -> argparse.ArgumentParser:
    """The flags: those of enjoy.py that select an agent, and those of the explanation."""
    parser = OneLineParser(
        description="Say where an agent loses return against the optimum, exactly.",
        epilog=EPILOG,
    )
    add_model_flags(parser)
    group = parser.add_argument_group("explaining")
    add = group.add_argument
    test = "train four seeds with this change (KEY:VALUE ...), with the shipped settings and as it "
    test += "is; repeat the flag to try several changes; without a change, try the proposed ones"
    add("--test", nargs="*", action="append", metavar="KEY:VALUE", help=test)
    other = "another agent on the same environment: where the two first differ, and what it costs"
    add("--against", type=filled, metavar="MODEL", help=other)
    add("--map", type=filled, metavar="FILE", help="draw the cost of each cell, as .png")
    add("--course", action="store_true", help="also split the gap of each checkpoint of the run")
    add("--json", type=filled, metavar="FILE", help="also write the explanation to this file")
    add_shared(group, "--env-kwargs", "--gym-packages", "--jobs")
    parser.set_defaults(seed=0)
    return parser


def main() -> int:
    """Parse the arguments and explain; return the exit code."""
    args = build_parser().parse_args()
    with stops_noticed(), exits_as_mistakes(), ExitStack() as stack:
        from rl_yardstick.commands.terminal import TextConsole, say
        from rl_yardstick.report.why import as_words, why_lines

        console = TextConsole(highlight=False)
        wanted = model_request(args)
        one = _asked(console, wanted, stack)
        explained = one.explanation()
        for line in why_lines(explained):
            say(console, line)
        if explained.proposals and args.test is None:
            likeliest = ", ".join(f"--test {as_words(one)}" for one in explained.proposals[:2])
            say(console, f"to see what helps: {likeliest}, or --test alone")
        data = explained.as_data()
        if args.against is not None:
            other = replace(wanted, path=Path(args.against), algo=None, env_id=None)
            data["against"] = _compare(console, one, _asked(console, other, stack))
        if args.course:
            data["course"] = _course(console, one, stack, explained)
        if args.map is not None:
            _draw(console, one, explained, Path(args.map))
        if args.test is not None:
            data["tried"] = _test(console, args, one, explained)
        if args.json is not None:
            from rl_yardstick.pipeline.files import write_json

            write_json(Path(args.json), data)
    return 0


@dataclass(frozen=True)
class Asked:
    """An agent to explain, with the exact evaluator of its environment."""

    chosen: ChosenModel
    evaluator: ExactEvaluator
    agent: BaseAlgorithm

    def explanation(self) -> Explanation:
        """Where the agent loses return against the optimum."""
        from rl_yardstick.diagnosis.explanation import explanation

        return explanation(self.chosen.spec, self.agent, self.evaluator)


def _asked(console: Console, wanted: ModelRequest, stack: ExitStack) -> Asked:
    """Find and load an agent, and compute the optimum of its environment."""
    from rl_yardstick.pipeline.signs_of_life import doing

    chosen = found_model(console, _median_run(wanted), stack)
    with doing(console, "working out the optimum"):
        from rl_yardstick.pipeline.evaluation.exact import exact_evaluator, model_refusal

        spec = chosen.spec
        evaluator = exact_evaluator(spec)
        if evaluator is None:
            reason = model_refusal(spec) or f"the model of {spec.env_id} is not known"
            raise UserError(f"{reason}, so the gap to the optimum cannot be split")
    return Asked(chosen, evaluator, _loaded(chosen, stack))


def _median_run(wanted: ModelRequest) -> ModelRequest:
    """The request, with a study's folder replaced by its run of (lower) median return."""
    if wanted.path is None or not (table := wanted.path / "summary.csv").is_file():
        return wanted
    import pandas as pd

    rows = pd.read_csv(table, dtype={"agent": str, "environment": str})
    for column, flag, name in (
        ("agent", "--algo", wanted.algo),
        ("environment", "--env", wanted.env_id),
    ):
        names = [str(each) for each in rows[column].unique()]
        chosen = names[0] if name is None and len(names) == 1 else name
        if chosen not in names:
            raise UserError(f"{wanted.path} is a study: choose one by {flag}: {', '.join(names)}")
        rows = rows[rows[column] == chosen]
    rows = rows.sort_values("final", kind="stable")
    place = Path(str(rows["path"].iloc[(len(rows) - 1) // 2]))  # the study may have been moved
    run = wanted.path.joinpath("runs", *place.parts[-2:])
    return replace(wanted, path=run, algo=None, env_id=None)


def _loaded(chosen: ChosenModel, stack: ExitStack) -> BaseAlgorithm:
    from rl_yardstick.pipeline.models.load import load_to_play
    from rl_yardstick.pipeline.playing import playing_env

    spec = chosen.spec
    env = stack.enter_context(closing(playing_env(chosen, None)))
    return load_to_play(spec.algo, chosen.file, env, spec.device, spec.user_modules)


# --- more than one agent --------------------------------------------------------------------------


def _compare(console: Console, one: Asked, other: Asked) -> dict[str, Any]:
    """Print where two agents first act differently; return the same as JSON data."""
    from rl_yardstick.commands.terminal import say
    from rl_yardstick.diagnosis.explanation import parting
    from rl_yardstick.report.why import parting_lines

    if one.evaluator.model.prob.shape != other.evaluator.model.prob.shape:
        raise UserError("--against: the two agents do not act on the same environment")
    found = parting(*((each.chosen.spec, each.agent, each.evaluator) for each in (one, other)))
    for line in parting_lines(found):
        say(console, line)
    return found.as_data()


def _course(console: Console, one: Asked, stack: ExitStack, last: Explanation) -> list[Any]:
    """Print the parts of the gap at each checkpoint; return the same as JSON data."""
    from rl_yardstick.commands.terminal import say
    from rl_yardstick.pipeline.models.choose import model_of_run
    from rl_yardstick.report.why import course_lines

    run = one.chosen.run
    saved = [] if run is None else run.checkpoints()
    if run is None or not saved:
        raise UserError("--course: the run has no checkpoints; train it with --save-freq N")
    course = {}
    for path in saved:
        then = _loaded(model_of_run(path, one.chosen.spec, run), stack)
        course[then.num_timesteps] = replace(one, agent=then).explanation()
    course[one.agent.num_timesteps] = last  # a checkpoint has not learnt from its last step
    for line in course_lines(course):
        say(console, line)
    return [{"timesteps": steps, **each.as_data()} for steps, each in course.items()]


# --- trying changes -------------------------------------------------------------------------------


def _test(
    console: Console, args: argparse.Namespace, one: Asked, explained: Explanation
) -> list[Any]:
    """Train four seeds as shipped, as it is and with each change; return the returns as JSON."""
    from rl_yardstick.commands.compare import RunContext, results_of
    from rl_yardstick.commands.terminal import about, say
    from rl_yardstick.experiments.interventions import intervention_study, relative_length, tried
    from rl_yardstick.experiments.launching import available_cores
    from rl_yardstick.experiments.plan import plan
    from rl_yardstick.experiments.run_limits import RunLimits
    from rl_yardstick.report.why import tried_lines

    spec, run = one.chosen.spec, one.chosen.run
    changes = [" ".join(change) for change in args.test if change] or explained.proposals
    name = one.chosen.path.stem if run is None else f"{spec.algo}_{run.path.name}"
    study = intervention_study(spec, changes, name)
    root = Path(args.folder) / "explain" / study.name
    workers = max(args.jobs, 0) or available_cores()
    runs = [planned for planned in plan(study, root) if planned.is_to_do]
    seconds = (run.read_info() if run is not None else {}).get("cpu_seconds")
    if runs and seconds is not None:
        length = relative_length(runs, spec, one.agent.num_timesteps)
        time = about(seconds * length / min(workers, len(runs)))
        say(console, f"{len(runs)} runs, {time} at the pace of this run")
    context = RunContext(root, command_line(), RunLimits(), console, n_workers=workers)
    found = tried(results_of(study, context))
    for line in tried_lines(found, explained.optimum):
        say(console, line)
    return [{"change": each.change, "returns": each.finished.tolist()} for each in found]


def _draw(console: Console, one: Asked, explained: Explanation, path: Path) -> None:
    """Draw the cost of each cell."""
    from rl_yardstick.commands.terminal import say
    from rl_yardstick.pipeline.environments import titled
    from rl_yardstick.pipeline.evaluation.value_maps import map_refusal, value_map
    from rl_yardstick.pipeline.map_pictures import draw_cost_map

    if path.suffix != ".png":
        raise UserError(f"--map writes a .png, not {path}")
    found = value_map(one.evaluator, one.agent)
    if found is None:
        reason = map_refusal(one.evaluator) or "only grid worlds have a map"
        raise UserError(f"--map: {reason}")
    spec = one.chosen.spec
    title = f"{spec.algo} on {titled(spec.env_id, spec.map_name)}"
    draw_cost_map(path, title, found, explained.losses)
    say(console, f"map: {path}")
