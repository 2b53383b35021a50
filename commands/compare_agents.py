"""``compare.py``: its flags, and what it does."""

from __future__ import annotations

import argparse
from collections.abc import Sequence
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING

from commands.flag_values import (
    COUNT,
    COUNT_OR_NONE,
    add_engine_flag,
    filled,
    folder_name,
    number_at_least_zero,
    whole_number,
)
from commands.parsing import MODULES_HELP, OneLineParser, as_called, command_line, program_name
from commands.places import Place, add_limit_flags, add_place_flags, give_way, held, place_of
from commands.streams import go_on_unread
from pipeline.foreign_exits import exits_as_mistakes
from pipeline.library_loading import loading_libraries
from pipeline.signs_of_life import doing
from pipeline.stopping import stops_noticed

if TYPE_CHECKING:
    from rich.console import Console

    from experiments.planned_runs import PlannedRun
    from experiments.study_spec import StudySpec

SEEDS = whole_number(1, 1_000_000)
FIRST_SEED = whole_number(0, 2**31)

EPILOG = """\
examples:
  python compare.py --env FrozenLake-v1 --algos qlearning sarsa dqn ppo --seeds 10
  python compare.py --env Warehouse-v0 MineMaze-v0 --algos qlearning ppo --engine auto
  python compare.py studies/warehouse-learning-rate.yml
  python compare.py studies/warehouse-learning-rate.yml --quick
  python compare.py studies/warehouse-learning-rate.yml --until-decided
  python compare.py --logged log.csv --policy logs/linucb/ReplayBandit-v0_1

The same command again does the missing runs, and no others.
"""


def build_parser() -> argparse.ArgumentParser:
    """The flags; those of single runs mean what they mean to the command train."""
    parser = OneLineParser(
        prog=program_name(),
        description="Compare agents on environments over seeds: tables, figures, and a page.",
        epilog=as_called(EPILOG),
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    add = parser.add_argument
    add("study", nargs="?", metavar="STUDY.yml", help="a study file, or the name of a shipped one")
    add("--env", nargs="+", default=[], metavar="ID", help="environments")
    add("--algos", nargs="+", default=[], metavar="AGENT", help="agents (train --list has them)")
    add("--seeds", type=SEEDS, metavar="N", help="how many seeds (default: the study's, or 10)")
    add(
        "--first-seed",
        type=FIRST_SEED,
        metavar="N",
        help="the first of these seeds (default: the study's, or 0)",
    )
    add(
        "--until-decided",
        action="store_true",
        help="give agents in undecided pairs more seeds, at looks that are fixed beforehand",
    )
    add("--max-seeds", type=SEEDS, metavar="N", help="the most seeds for that (default: 50)")
    add("-n", "--n-timesteps", type=COUNT, metavar="N", help="environment steps of each run")
    add("--n-episodes", type=COUNT, metavar="N", help="episodes instead of steps")
    add(
        "-params",
        "--hyperparams",
        nargs="+",
        default=[],
        metavar="KEY:VALUE",
        help="hyperparameters to change in every agent",
    )
    add_engine_flag(parser)
    add(
        "-conf",
        "--conf-file",
        nargs="+",
        default=[],
        metavar="[AGENT:]YAML",
        help="hyperparameters from another file; with several agents, for which: dqn:mine.yml",
    )
    add("--env-kwargs", nargs="+", default=[], metavar="KEY:VALUE", help="environment arguments")
    add(
        "--as-it-comes",
        action="store_true",
        help="train every agent on the environment as it comes, without what settings change in "
        "training alone (train_env_kwargs, train_env_wrapper)",
    )
    add(
        "--gym-packages",
        nargs="+",
        type=filled,
        default=[],
        metavar="MODULE",
        help=MODULES_HELP,
    )
    add(
        "--quick",
        action="store_true",
        dest="is_quick",
        help="few seeds and a small budget, for a first look",
    )
    _add_run_flags(parser)
    _add_output_flags(parser)
    _add_log_flags(parser)
    return parser


def _add_log_flags(parser: argparse.ArgumentParser) -> None:
    add = parser.add_argument_group("off-policy evaluation, instead of a study").add_argument
    add("--logged", metavar="LOG.csv", help="judge trained agents on logged pulls of a bandit")
    add("--policy", nargs="+", default=[], metavar="RUN", help="run folders or model zips to judge")


def _add_run_flags(parser: argparse.ArgumentParser) -> None:
    group = parser.add_argument_group("runs")
    add_place_flags(group)
    add_limit_flags(group)
    add = group.add_argument
    add("--repair", action="store_true", help="do damaged runs again; the old folders are kept")
    add(
        "--replace",
        action="store_true",
        help="do finished runs with other settings again; the old folders are kept",
    )


def _add_output_flags(parser: argparse.ArgumentParser) -> None:
    add = parser.add_argument_group("judgement and output").add_argument
    add("--metric", help="what verdicts are about: final, best, area, regret, ...")
    add(
        "--margin",
        type=number_at_least_zero,
        help="difference within which agents count as equivalent",
    )
    add("--episodes-table", type=COUNT, metavar="N", help="average, min, max of every N episodes")
    add(
        "--render-every",
        type=COUNT_OR_NONE,
        default=0,
        metavar="N",
        help="film one episode after every N episodes",
    )
    add("--name", type=folder_name, help="name of the study's folder (default: from the study)")
    add("-f", "--log-folder", type=filled, default="logs/studies", help="folder of all studies")
    add("-tb", "--tensorboard", action="store_true", help="write a TensorBoard log of each run")
    add(
        "--watch-learning",
        action="store_true",
        dest="learning_pages",
        help="train the first run of each agent again, and link pages that play how it learns",
    )
    add(
        "--figures",
        nargs="+",
        choices=("png", "svg", "pdf"),
        metavar="FORMAT",
        help="formats of the figures: png, svg, pdf (default: png svg)",
    )
    add("--no-report", action="store_true", help="only tables: no figures and no page")


def main() -> int:
    """Parse the arguments and do what they ask for; the exit code."""
    args = build_parser().parse_args()
    with stops_noticed(), exits_as_mistakes():
        if args.logged or args.policy:
            from commands.compare_on_log import compare_on_log

            return compare_on_log(args)
        return _compare(args)


def _compare(args: argparse.Namespace) -> int:
    """Do a study, as the only one that does."""
    from commands.study_request import study_spec

    study = study_spec(args)
    from commands.terminal import table_console
    from experiments.fork_server import end_server
    from experiments.run_limits import RunLimits
    from experiments.study_plan import plan
    from pipeline.folder_lock import folder_lock, told_if_gone
    from safe_files.files import take_up

    go_on_unread()
    root = Path(args.log_folder) / study.name
    take_up(root)
    console = table_console()
    say = partial(console.print, highlight=False, soft_wrap=True)
    place = place_of(
        args, root, command_line(), RunLimits(study.run_timeout, study.run_memory), say
    )
    planned = plan(study, root)
    console.print(study.title, style="bold", highlight=False)
    with folder_lock(root, give_way, say), told_if_gone(root):
        try:
            if args.until_decided:
                return _grow_study(args, study, root, console, place)
            return _do_study(args, study, planned, root, console, place)
        except KeyboardInterrupt:
            end_server()
            raise


def _do_study(
    args: argparse.Namespace,
    study: StudySpec,
    planned: Sequence[PlannedRun],
    root: Path,
    console: Console,
    place: Place,
) -> int:
    """Do a study with the seeds that it has, once it is known how often it was looked at."""
    from experiments.looks_file import read_looks

    read_looks(root)
    place = _prepare(args, study, planned, root, console, place)
    from commands.study_output import run_study

    page = not args.no_report
    return run_study(console, study, planned, root, command_line(), place, with_page=page)


def _grow_study(
    args: argparse.Namespace,
    study: StudySpec,
    root: Path,
    console: Console,
    place: Place,
) -> int:
    """Do a study with more and more seeds, as was settled before the first look."""
    from experiments.growing import counts_of, grown, settle, settled_looks
    from experiments.study_plan import plan

    looks = settled_looks(study, root, args.max_seeds)
    counts = counts_of(study, looks)
    planned = plan(grown(study, counts), root, counts)
    place = _prepare(args, grown(study, counts), planned, root, console, place)
    settle(root, looks)
    from commands.growing_output import grow_study

    page = not args.no_report
    with held(place.launchers) as launchers:  # from one look to the next
        place = replace(place, launchers=launchers)
        return grow_study(console, study, counts, root, command_line(), place, with_page=page)


def _prepare(
    args: argparse.Namespace,
    study: StudySpec,
    planned: Sequence[PlannedRun],
    root: Path,
    console: Console,
    place: Place,
) -> Place:
    """Make sure that the runs can be done, before any is; and load the libraries for them.

    Returns:
        The place, with what is expected of the runs.
    """
    if args.repair:
        from commands.study_output import repair

        repair(console, study, planned)
    with doing(console, "looking for runs that are there") as activity, loading_libraries():
        from experiments.child_processes import do_aside
        from experiments.replaced_runs import check_settings_kept
        from experiments.study_plan import check_settings

        if not args.replace:
            check_settings_kept(planned, root)
        if any(run.is_to_do for run in planned):
            place.get_ready(planned)
        activity.now("loading the libraries")
        first = [run for run in planned if run.seed == study.first_seed]
        do_aside(check_settings, study, first)
        line, expected = _engines(planned)
    if line:
        console.print(f"engines: {line}", highlight=False, soft_wrap=True)
    return replace(place, expected=expected)


def _engines(planned: Sequence[PlannedRun]) -> tuple[str, dict[tuple[str, str], float]]:
    """On which engines the missing runs of networks will train, and what each run takes."""
    from pipeline.plain_runs import NETWORKS

    missing: dict[tuple[str, str], list[PlannedRun]] = {}
    for run in planned:
        if run.spec.algo in NETWORKS and run.is_to_do:
            missing.setdefault((run.agent, run.environment), []).append(run)
    if not missing:  # without the libraries
        return "", {}
    from agents.networks.engine_costs import machine_pace
    from commands.engine_lines import seconds_of, study_line
    from experiments.time_left import expected_seconds
    from pipeline.engine_outlook import planned_outlook

    found = {key: planned_outlook(runs[0].spec) for key, runs in missing.items()}
    outlooks = {key: each for key, each in found.items() if each is not None}
    pace = machine_pace() if outlooks else 1.0
    expected = {
        key: seconds
        for key, each in outlooks.items()
        if (seconds := expected_seconds(missing[key][0].spec, pace * seconds_of(each.plan, each)))
    }
    lines = [(key[0], each, len(missing[key])) for key, each in outlooks.items()]
    return study_line(lines), expected
