"""``compare.py``: its flags, the steps of a study, and its output."""

from __future__ import annotations

import _thread
import argparse
import importlib.util
import signal
import time
from collections import Counter
from collections.abc import Callable, Collection, Iterator, Mapping, Sequence
from contextlib import AbstractContextManager, ExitStack, contextmanager, nullcontext
from dataclasses import dataclass, field, fields, replace
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

from rich.console import Console

from rl_yardstick.commands.cli import (
    COUNT,
    COUNT_OR_NONE,
    FIRST_SEED,
    LONGEST_FOLDER_NAME,
    OneLineParser,
    add_shared,
    check_tensorboard,
    command_line,
    folder_name,
    go_on_unread,
    number_at_least_zero,
    whole_number,
)
from rl_yardstick.commands.kept_runs import keep_few, make_again, named_runs, repair, whose
from rl_yardstick.commands.logged import compare_on_log
from rl_yardstick.commands.terminal import LiveProgress, say, table_console
from rl_yardstick.pipeline import loading_libraries
from rl_yardstick.pipeline.errors import UserError, unknown
from rl_yardstick.pipeline.failures import exits_as_mistakes
from rl_yardstick.pipeline.signs_of_life import doing, duration
from rl_yardstick.pipeline.stopping import stops_noticed

if TYPE_CHECKING:
    import pandas as pd
    from rich.table import Table

    from rl_yardstick.experiments.analysis import StudyAnalysis
    from rl_yardstick.experiments.cluster.schedulers import Cluster
    from rl_yardstick.experiments.figures_store import FigureStore
    from rl_yardstick.experiments.launching import EarlyResults, Launcher, RunFailure
    from rl_yardstick.experiments.plan import PlannedRun
    from rl_yardstick.experiments.results import StudyResults
    from rl_yardstick.experiments.run_limits import RunLimits
    from rl_yardstick.experiments.study import AgentSpec, StudySpec
    from rl_yardstick.pipeline.signs_of_life import Activity
    from rl_yardstick.report.page.frame import LearningPage
    from rl_yardstick.verdicts import Study

# --- flags ----------------------------------------------------------------------------------------

SEEDS = whole_number(1, 1_000_000)

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
    """The flags; those of single runs have the same meaning as in train."""
    parser = OneLineParser(
        description="Compare agents on environments over seeds: tables, figures, and a page.",
        epilog=EPILOG,
    )
    add = parser.add_argument
    add("study", nargs="?", metavar="STUDY.yml", help="a study file, or the name of a shipped one")
    add("--env", nargs="+", default=[], metavar="ID", help="environments")
    add("--algos", nargs="+", default=[], metavar="AGENT", help="agents (train --list has them)")
    add("--seeds", type=SEEDS, metavar="N", help="how many seeds (default: the study's, or 10)")
    first = "the first of these seeds (default: the study's, or 0)"
    add("--first-seed", type=FIRST_SEED, metavar="N", help=first)
    decided = "give agents in undecided pairs more seeds, at looks that are fixed beforehand"
    add("--until-decided", action="store_true", help=decided)
    add("--max-seeds", type=SEEDS, metavar="N", help="the most seeds for that (default: 80)")
    add_shared(parser, "--n-timesteps", "--n-episodes")
    add_shared(parser, "--hyperparams", help="hyperparameters to change in every agent")
    add_shared(parser, "--engine")
    add(
        *("-conf", "--conf-file"),
        nargs="+",
        default=[],
        metavar="[AGENT:]YAML",
        help="hyperparameters from another file; with several agents, for which: dqn:mine.yml",
    )
    add_shared(parser, "--env-kwargs")
    add(
        "--as-it-comes",
        action="store_true",
        help="train every agent on the environment as it comes, without the changes that settings "
        "make in training only (train_env_kwargs, train_env_wrapper)",
    )
    add_shared(parser, "--gym-packages")
    quick = "few seeds and a small budget, for a first look"
    add("--quick", action="store_true", dest="is_quick", help=quick)

    group = parser.add_argument_group("runs")
    add_shared(group, "--jobs", "--cluster", "--insecure-cluster", "--run-timeout", "--run-memory")
    add = group.add_argument
    repaired = "do damaged runs again; the old folders are kept"
    add("--repair", action="store_true", help=repaired)
    replaced = "do finished runs with other settings again; the old folders are kept"
    add("--replace", action="store_true", help=replaced)
    kept = "keep all run folders, or figures and few folders: the best, median and worst (all)"
    add("--keep", choices=("all", "figures"), help=kept)
    again = "make the folders of these runs again, after --keep figures"
    add("--make-again", nargs="+", default=[], metavar="AGENT:SEED", help=again)

    _add_output_flags(parser)
    add = parser.add_argument_group("off-policy evaluation, instead of a study").add_argument
    add("--logged", metavar="LOG.csv", help="judge trained agents on logged pulls of a bandit")
    add("--policy", nargs="+", default=[], metavar="RUN", help="run folders or model zips to judge")
    return parser


def _add_output_flags(parser: argparse.ArgumentParser) -> None:
    group = parser.add_argument_group("judgement and output")
    add = group.add_argument
    add("--metric", help="the figure that verdicts compare: final, best, area, regret, ...")
    margin = "difference of the means within which agents are tied"
    add("--margin", type=number_at_least_zero, help=margin)
    add("--episodes-table", type=COUNT, metavar="N", help="average, min, max of every N episodes")
    filmed = "film one episode after every N episodes"
    add("--render-every", type=COUNT_OR_NONE, default=0, metavar="N", help=filmed)
    add("--name", type=folder_name, help="name of the study's folder (default: from the study)")
    add_shared(group, "--log-folder", default="logs/studies", help="folder of all studies")
    add("-tb", "--tensorboard", action="store_true", help="write a TensorBoard log of each run")
    compared = "compare values, advantages and gradients with the exact ones at each evaluation"
    add("--diagnose", action="store_true", default=None, help=compared)
    watched = "train the first run of each agent again, and link pages that play how it learns"
    add("--watch-learning", action="store_true", dest="learning_pages", help=watched)
    add(
        "--figures",
        nargs="+",
        choices=("png", "svg", "pdf"),
        metavar="FORMAT",
        help="formats of the figures: png, svg, pdf (default: png svg)",
    )
    add("--no-report", action="store_true", help="only tables: no figures and no page")


# --- the steps of a study -------------------------------------------------------------------------


def main() -> int:
    """Parse the arguments and compare; return the exit code."""
    args = build_parser().parse_args()
    with stops_noticed(), exits_as_mistakes():
        if args.logged or args.policy:
            return compare_on_log(args)
        return _compare(args)


def _compare(args: argparse.Namespace) -> int:
    """Do a study under the lock of its folder."""
    study = study_spec(args)
    from rl_yardstick.experiments.child_processes import end_server
    from rl_yardstick.experiments.growing import looks_of
    from rl_yardstick.experiments.plan import plan
    from rl_yardstick.experiments.run_limits import RunLimits
    from rl_yardstick.pipeline.locks import folder_lock, told_if_gone

    go_on_unread()
    root = Path(args.log_folder) / study.name
    console = table_console()
    limits = RunLimits(study.run_timeout, study.run_memory)
    context = run_context(args, root, command_line(), limits, console)
    planned = plan(study, root)
    to_make_again = named_runs(planned, args.make_again)
    if study.keep == "figures" or to_make_again or any(root.glob("runs/*/*.sqlite")):
        from rl_yardstick.experiments.figures_store import FigureStore  # with slow libraries

        context.store = FigureStore(folds=study.keep == "figures", first_seed=study.first_seed)
    console.print(study.title, style="bold", highlight=False)
    with folder_lock(root, give_way, partial(say, console)), told_if_gone(root):
        try:
            if to_make_again:
                return make_again(context, study, to_make_again)
            if args.until_decided:
                return _grow_study(args, study, context)
            looks_of(root)  # fails early if the plan of looks cannot be read
            if args.repair:
                repair(console, study, planned, context.store)
            _prepare(study, planned, context, args.replace)
            return run_study(context, study, planned)
        except KeyboardInterrupt:
            end_server()
            raise


def results_of(study: StudySpec, context: RunContext) -> StudyResults:
    """Do the missing runs of a study under the lock of its folder, and read all results."""
    from rl_yardstick.experiments.child_processes import end_server
    from rl_yardstick.experiments.launching import EarlyResults
    from rl_yardstick.experiments.plan import plan
    from rl_yardstick.pipeline.locks import folder_lock, told_if_gone

    root = context.root
    planned, early = plan(study, root), EarlyResults(study)
    with folder_lock(root, give_way, partial(say, context.console)), told_if_gone(root):
        try:
            _prepare(study, planned, context)
            do_missing(context, planned, early)
            return read(context, study, planned, early)
        except KeyboardInterrupt:
            end_server()
            raise


def _prepare(
    study: StudySpec, planned: Sequence[PlannedRun], context: RunContext, replaces: bool = False
) -> None:
    """Check that the runs can be done before the first begins, and load the libraries."""
    with doing(context.console, "looking for runs that are there") as activity, loading_libraries():
        from rl_yardstick.experiments.child_processes import do_aside
        from rl_yardstick.experiments.plan import check_settings
        from rl_yardstick.experiments.run_folders import check_settings_kept

        apart = context.not_stored(planned)
        if not replaces:
            stored = [] if context.store is None else context.store.differences(planned)
            others = [(n, there) for _, n, there in stored]
            check_settings_kept(apart, context.root, others)
        if any(run.is_to_do for run in apart):
            context.get_ready(apart)
        activity.now("loading the libraries")
        first = [run for run in planned if run.seed == study.first_seed]
        do_aside(check_settings, study, first)
        line, context.expected = _engines(apart)
    if line:
        say(context.console, f"engines: {line}")


def _engines(planned: Sequence[PlannedRun]) -> tuple[str, dict[tuple[str, str], float]]:
    """The engines of the missing runs of networks, in words, and the expected seconds of a run."""
    from rl_yardstick.pipeline.train_spec import NETWORKS

    missing: dict[tuple[str, str], list[PlannedRun]] = {}
    for run in planned:
        if run.spec.algo in NETWORKS and run.is_to_do:
            missing.setdefault(run.labels, []).append(run)
    if not missing:  # without the libraries
        return "", {}
    from rl_yardstick.agents.networks.engine_setting import machine_pace
    from rl_yardstick.commands.terminal import seconds_of, study_line
    from rl_yardstick.experiments.launching import expected_seconds
    from rl_yardstick.pipeline.preparation import planned_outlook

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


def run_study(context: RunContext, study: StudySpec, planned: Sequence[PlannedRun]) -> int:
    """Do a study as planned, and judge it; return 0 if all runs are finished and undamaged."""
    from rl_yardstick.experiments.launching import EarlyResults

    early = EarlyResults(study)
    failures = do_missing(context, planned, early)
    return conclude(context, read(context, study, planned, early), failures)


def _grow_study(args: argparse.Namespace, study: StudySpec, context: RunContext) -> int:
    """Do a study with more and more seeds until every pair is decided, and judge it at the end.

    The numbers of seeds of all looks are fixed before the first look.
    """
    from rl_yardstick.experiments.growing import first_counts, plan_of_looks, write_looks
    from rl_yardstick.experiments.plan import plan
    from rl_yardstick.report.words import seeds

    looks = plan_of_looks(study, context.root, args.max_seeds)
    counts = first_counts(study)
    planned = plan(study, context.root, counts)
    if args.repair:
        repair(context.console, study, planned, context.store)
    _prepare(study, planned, context)
    write_looks(context.root, looks)
    results, said, failures = look_by_look(context, study, looks["looks"])
    code = conclude(context, results, failures)
    # The number of runs, compared with a design that gives every agent all seeds.
    undecided = [
        f"{pair.first} and {pair.second} on {pair.environment}"
        for pair in said.pairs
        if pair.word == "undecided"
    ]
    left = f"undecided: {'; '.join(undecided)}" if undecided else "all is decided"
    most, n_runs = looks["looks"][-1], sum(sum(by.values()) for by in said.seeds.values())
    design = f"{seeds(most)} of each agent would be {most * len(counts):,}"
    say(context.console, f"{n_runs:,} runs, where {design}; {left}")
    return code


def look_by_look(
    context: RunContext,
    study: StudySpec,
    looks: Sequence[int],
    is_enough: Callable[[Study], bool] = lambda said: False,
) -> tuple[StudyResults, Study, list[RunFailure]]:
    """Do the runs of one planned look after another, until no agent needs seeds or ``is_enough``.

    It begins with the first look: finished runs may already be enough.
    """
    from rl_yardstick.experiments.growing import first_counts, grown, looked, next_counts
    from rl_yardstick.experiments.launching import EarlyResults
    from rl_yardstick.experiments.plan import plan

    failures: list[RunFailure] = []
    counts, n_said = first_counts(study), 0
    with context.held():  # keep the launcher open from one look to the next
        while True:
            now = grown(study, counts)
            planned = plan(now, context.root, counts)
            given_up = {failure.planned.path for failure in failures}
            early = EarlyResults(now)
            failures += do_missing(context, planned, early, given_up)
            results = read(context, now, planned, early)
            said = looked(results, tuple(looks))
            is_over = said.is_done or is_enough(said)
            if said.n_looks != n_said:
                n_said = said.n_looks
                say(context.console, _on_look(said, looks, is_over=is_over))
            if is_over:
                return results, said, failures
            counts = {**counts, **next_counts(said)}


def _on_look(said: Study, looks: Sequence[int], *, is_over: bool) -> str:
    """The result of a look: the number of undecided pairs, and which agents get more seeds."""
    from rl_yardstick.report.words import enumeration, seeds

    text = f"look {said.n_looks} of {len(looks)}, at {seeds(looks[max(said.n_looks - 1, 0)])}: "
    n_undecided = sum(pair.word == "undecided" for pair in said.pairs)
    if not n_undecided:
        return f"{text}all pairs are decided"
    text += f"{n_undecided} of {len(said.pairs)} pairs undecided"
    if is_over:
        return text
    size = looks[said.n_looks]
    names = [
        f"{name} on {environment}" if len(said.seeds) > 1 else name
        for environment, by in said.seeds.items()
        for name, wanted in by.items()
        if wanted == size
    ]
    return f"{text}; {enumeration(names)} {'goes' if len(names) == 1 else 'go'} on to {seeds(size)}"


def do_missing(
    context: RunContext,
    planned: Sequence[PlannedRun],
    early: EarlyResults,
    given_up: Collection[Path] = (),
) -> list[RunFailure]:
    """Do the missing runs, except those with folders in ``given_up``; return the failures.

    Each run is read as soon as it has ended.
    """
    from rl_yardstick.experiments.launching import execute
    from rl_yardstick.experiments.run_folders import move_replaced_aside

    console, root, store = context.console, context.root, context.store
    if store is not None:
        store.move_others_aside(planned, root)
    apart = context.not_stored(planned)
    moved, place = move_replaced_aside(apart, root)
    if place is not None:
        runs = "1 run that is" if len(moved) == 1 else f"{len(moved)} runs that are"
        say(console, f"{runs} done again: the old folders are in {place} now")
    missing = [run for run in apart if run.is_to_do and run.path not in given_up]
    there = {id(run) for run in apart}
    done = [run for run in planned if id(run) not in there or run.is_finished]
    console.print(
        f"{len(planned)} runs, {len(done)} of them there already; {context.words}, in {root}",
        highlight=False,
    )
    if store is not None and store.folds:
        store.tidy(planned)
        for run in done:
            if id(run) in there:
                store.add(run, early.read(run))
    begun = [*done, *missing]
    with StudyProgress(console, begun, done, context.expected) as progress:
        for run in done:
            if id(run) in there:
                progress.note_refusal(run)

        def note(planned: PlannedRun, failure: RunFailure | None) -> None:
            progress.note(planned, failure)
            if failure is None:
                found = early.read(planned)
                if store is not None and store.add(planned, found):
                    early.forget(planned)

        try:
            return execute(
                missing, root, progress.watching(context.launchers), note, early.get_ready
            )
        finally:
            if store is not None:
                store.commit()


def read(
    context: RunContext, study: StudySpec, planned: Sequence[PlannedRun], early: EarlyResults
) -> StudyResults:
    """Read the finished runs, except those that were read early."""
    with doing(context.console, "reading the results") as activity:
        from rl_yardstick.experiments.results import read_results

        stored = None if context.store is None else context.store.runs(planned)
        return read_results(study, planned, context.root, activity.at, early.of, stored)


def conclude(
    context: RunContext,
    results: StudyResults,
    failures: Sequence[RunFailure],
) -> int:
    """Judge the finished runs, and say which are missing and why; return the exit code."""
    from rl_yardstick.experiments.results import mixed_versions

    tell = partial(say, context.console)
    results, more, is_same = keep_few(context, results)
    failures = [*failures, *more]
    results = replace(results, failures={one.planned.path: one.details for one in failures})
    try:
        if len(results.summary):
            _judge(context, results)
            note = mixed_versions(info for *_, info in results.infos())
            if note:
                tell(note)
    finally:
        for failure in failures:
            run, log = failure.planned, failure.log
            details = "the details could not be written" if log is None else f"see {log}"
            who = f"{run.agent} on {run.environment}, seed {run.seed}"
            tell(f"failed: {who}: {failure.reason}; {details}")
        for damaged in results.left_out:
            tell(f"left out: {whose(damaged)}")
        if results.left_out:
            n_runs = sum(damaged.planned.n_runs for damaged in results.left_out)
            runs = "1 run is" if n_runs == 1 else f"{n_runs} runs are"
            tell(f"{runs} damaged and in no figure; --repair does such runs again")
    if results.n_unchecked:
        runs = "1 run" if results.n_unchecked == 1 else f"{results.n_unchecked} runs"
        tell(f"{runs} of an earlier version recorded no digests: damage may go unseen")
    n_missing = len(results.planned) - len(results.finished)
    if n_missing > len(failures) + len(results.left_out):
        which = f"{n_missing} of {len(results.planned)} runs are missing"
        tell(f"{which}; the same command continues")
    return 1 if n_missing or more or not is_same else 0


def _judge(context: RunContext, results: StudyResults) -> None:
    """Print the judgement, and write tables, figures and page."""
    console = context.console
    with doing(console, "judging the agents") as activity:
        from rl_yardstick.experiments.analysis import analyse, with_advice
        from rl_yardstick.experiments.growing import looks_of
        from rl_yardstick.report.terminal import print_analysis, print_episodes_table

        analysis = analyse(results, activity.at, looks_of(context.root))
        activity.now("looking at runs that failed")
        analysis = with_advice(analysis)
    print_analysis(console, analysis)
    width = results.study.episodes_table
    with doing(console, "writing the tables") as activity:
        from rl_yardstick.experiments.study import write_study
        from rl_yardstick.report.documents import write_tables, write_verdicts
        from rl_yardstick.report.series import episodes_table

        files = [*write_tables(results), *write_verdicts(analysis, context.command)]
        write_study(results.root, results.study)
        blocks = episodes_table(results, width) if width else None
        if blocks is not None:
            print_episodes_table(console, blocks, width)
        if results.study.render_every:
            activity.now("filming")
            from rl_yardstick.report.films import write_films

            films, refused = write_films(results, activity.at)
            files += films
            for reason in refused:
                activity.say(f"no film: {reason}")
        if context.with_page:
            files += _draw(context, analysis, blocks, activity)
    console.print()
    console.print(f"files: {results.root}", highlight=False)
    for path in files:
        console.print(f"  {path.relative_to(results.root)}", highlight=False)


def _draw(
    context: RunContext, analysis: StudyAnalysis, blocks: pd.DataFrame | None, activity: Activity
) -> list[Path]:
    """Draw the figures and write the page; return the files."""
    activity.now("working out the curves")
    from rl_yardstick.report.figures import write_figures
    from rl_yardstick.report.page import write_report
    from rl_yardstick.report.page.frame import Report
    from rl_yardstick.report.series import study_series

    page = analysis.results.root / "report.html"
    series = study_series(analysis, activity.at)
    activity.now("drawing the figures")
    files = write_figures(series, blocks, activity.at)
    learning: list[LearningPage] = []
    if analysis.study.learning_pages:
        activity.now("watching")
        from rl_yardstick.report.page.learning import write_first_pages

        learning = write_first_pages(analysis, context.n_workers, activity.at)
    activity.now("writing the page")
    write_report(Report(series, context.command, activity.at, learning), page)
    pages = [analysis.results.root / one.place for one in learning if one.place]
    return [*files, *pages, page]


# --- execution of runs ----------------------------------------------------------------------------


@dataclass
class RunContext:
    """Shared by the runs of a study or a search: folder, command, limits, workers or cluster."""

    root: Path  # the folder of the study
    command: str  # recorded in run folders
    limits: RunLimits  # of time and memory of each run
    console: Console
    with_page: bool = True  # draw the figures and write the page, beside the tables
    n_workers: int = 1  # processes that may work on this machine at once
    cluster: Cluster | None = None
    address: str = ""  # of the cluster, as it was typed
    # Expected seconds of a run by agent and environment, where known.
    expected: Mapping[tuple[str, str], float] = field(default_factory=dict)
    _warm_ups: str = "[]"  # trainings that the cluster's workers compile once, as JSON
    store: FigureStore | None = None  # the runs that are in files instead of folders
    _held: ExitStack | None = None
    _launcher: Launcher | None = None  # the one kept open by `held`

    @property
    def words(self) -> str:
        """The number of workers or the cluster, in words."""
        here = f"{self.n_workers} at once"
        return here if self.cluster is None else f"on the cluster {self.address}"

    def not_stored(self, planned: Sequence[PlannedRun]) -> list[PlannedRun]:
        """Those of these runs that are not in the store."""
        return [run for run in planned if self.store is None or not self.store.holds(run)]

    def get_ready(self, planned: Sequence[PlannedRun]) -> None:
        """Start the server that runs are forked from, with warm-ups that compile code once.

        Only users' own modules need warm-ups. The server imports the libraries in parallel with
        this process.
        """
        from rl_yardstick.experiments.child_processes import start_server

        compiled = "[]"
        if any(run.spec.user_modules for run in planned):
            from rl_yardstick.experiments.run_in_child import warm_ups

            compiled = warm_ups(planned)
        if self.cluster is None:
            start_server(compiled)
        else:
            self._warm_ups = compiled

    @contextmanager
    def held(self) -> Iterator[None]:
        """Keep the launcher open between two uses, until the ``with`` statement ends."""
        with ExitStack() as self._held:
            yield
        self._held = self._launcher = None

    def launchers(self) -> AbstractContextManager[Launcher]:
        """Open a launcher, or reuse the one that `held` keeps open."""
        if self._held is None:
            return self._opened()
        if self._launcher is None:
            self._launcher = self._held.enter_context(self._opened())
        return nullcontext(self._launcher)

    def _opened(self) -> AbstractContextManager[Launcher]:
        if self.cluster is None:
            from rl_yardstick.experiments.launching import local_launcher

            return local_launcher(self.root, self.command, self.n_workers, self.limits)
        from rl_yardstick.experiments.cluster.cluster_launcher import cluster_launcher

        tell = partial(say, self.console)
        return cluster_launcher(
            self.cluster, self.root, self.command, self.limits, self._warm_ups, tell
        )


def run_context(
    args: argparse.Namespace, root: Path, command: str, limits: RunLimits, console: Console
) -> RunContext:
    """The context that the flags ask for."""
    context = RunContext(root, command, limits, console, with_page=not args.no_report)
    if args.cluster is None:
        if args.insecure_cluster:
            raise UserError("--insecure-cluster belongs to --cluster: give --cluster too")
        from rl_yardstick.experiments.launching import available_cores

        return replace(context, n_workers=max(args.jobs, 0) or available_cores())
    for library in ("distributed", "cryptography", "dask_jobqueue"):
        if importlib.util.find_spec(library) is None:
            raise UserError("--cluster needs Dask: pip install 'rl-yardstick[cluster]'")
    from rl_yardstick.experiments.cluster.schedulers import JobQueue, checked_cluster

    cluster = checked_cluster(args.cluster, args.insecure_cluster)
    if isinstance(cluster, JobQueue):
        if args.jobs < 1:
            raise UserError(f"{cluster.file}: say how many runs to do at once: --jobs N")
        cluster = replace(cluster, n_workers=args.jobs)
    elif args.jobs > 0:
        raise UserError("--jobs is for this machine or a queue of jobs; a cluster has its workers")
    return replace(context, cluster=cluster, address=args.cluster)


def give_way() -> None:
    """Stop, because another process has taken over the study's folder, or it is gone."""
    from rl_yardstick.experiments.child_processes import stop_all

    stop_all()
    _thread.interrupt_main(signal.SIGTERM)


# --- from flags to a study ------------------------------------------------------------------------


def study_spec(args: argparse.Namespace) -> StudySpec:
    """The study that the arguments select, with their changes."""
    from rl_yardstick.experiments.study import (
        METRICS,
        StudySpec,
        find_study,
        read_study,
        with_maps_named,
    )
    from rl_yardstick.pipeline.user_modules import import_typed

    if args.max_seeds is not None and not args.until_decided:
        raise UserError("--max-seeds belongs to --until-decided: give both, or --seeds")
    for flag, is_given in (("quick", args.is_quick), ("replace", args.replace)):
        if args.until_decided and is_given:
            raise UserError(f"--until-decided and --{flag} do not go together: give one of them")
    if args.make_again and args.until_decided:
        raise UserError("--until-decided and --make-again do not go together: give one of them")
    if args.learning_pages and args.no_report:
        raise UserError("--watch-learning is a section of the page: leave out --no-report")
    if args.metric is not None and args.metric not in METRICS:
        raise unknown("--metric: unknown metric", args.metric, METRICS)
    check_tensorboard(args.tensorboard)
    modules = import_typed(args.gym_packages, args.env)
    if not args.study:
        study = _study_of_flags(args)
    elif args.env or args.algos:
        raise UserError("give a study file, or --env and --algos, not both")
    else:
        study = read_study(find_study(args.study))
    # A flag with the name of a field sets that field, if it is given.
    named = {key.name: getattr(args, key.name) for key in fields(StudySpec) if key.name in args}
    names = tuple(module.name for module in modules)
    changes = {**named, "n_seeds": args.seeds, "gym_packages": names, "user_modules": modules}
    changes = {key: value for key, value in changes.items() if value is not None}
    study = with_maps_named(replace(_with_settings(study, args), **changes))
    if not args.study:
        environments = ", ".join(each.label for each in study.environments)
        study = replace(study, title=f"{', '.join(args.algos)} on {environments}")
    if study.keep == "figures" and (study.episodes_table or study.tensorboard):
        what = "--episodes-table" if study.episodes_table else "--tensorboard"
        raise UserError(
            f"{what} needs more of each run than --keep figures keeps: give one of them"
        )
    return study.quickened() if args.is_quick else study


def _study_of_flags(args: argparse.Namespace) -> StudySpec:
    from rl_yardstick.agents import ALGORITHMS
    from rl_yardstick.experiments.study import AgentSpec, EnvironmentSpec, StudySpec, file_name
    from rl_yardstick.pipeline.environments import check_env_id
    from rl_yardstick.pipeline.runs import environment_name

    if not (args.env and args.algos):
        raise UserError("what to compare? give --env and --algos, or a study file")
    for algo in args.algos:
        if algo not in ALGORITHMS:
            raise unknown("unknown agent", algo, ALGORITHMS)
    for env_id in args.env:
        check_env_id(env_id)
    for flag, names in (("--env", args.env), ("--algos", args.algos)):
        if len(set(names)) < len(names):
            raise UserError(f"{flag} names one of them twice")
    folders = "-".join(map(environment_name, args.env))
    return StudySpec(
        name=file_name(f"{folders}_{'-'.join(args.algos)}", LONGEST_FOLDER_NAME),
        title="",
        agents=tuple(AgentSpec(algo, algo) for algo in args.algos),
        environments=tuple(EnvironmentSpec(env_id, env_id) for env_id in args.env),
    )


def _conf_files(study: StudySpec, words: Sequence[str]) -> dict[str, Path]:
    """The files of ``--conf-file``, by the names of agents in the registry."""
    algos = list(dict.fromkeys(agent.algo for agent in study.agents))
    files: dict[str, Path] = {}
    for word in words:
        algo, colon, name = word.partition(":")
        if not (colon and algo in algos):
            if len(algos) > 1:
                example = f"{algos[0]}:{word}"
                raise UserError(
                    f"--conf-file {word}: whose hyperparameters? a file has those of one "
                    f"agent ({', '.join(algos)}): {example}"
                )
            algo, name = algos[0], word
        if algo in files:
            raise UserError(f"--conf-file names two files for {algo}")
        files[algo] = Path(name)
        if not files[algo].is_file():
            raise UserError(f"--conf-file: there is no file {files[algo]}")
    return files


def typed_settings(args: argparse.Namespace) -> dict[str, Any]:
    """The settings that the flags of a study or a search give to every agent."""
    from rl_yardstick.experiments.study import layered
    from rl_yardstick.pipeline.settings.values import parse_assignments

    settings: dict[str, Any] = parse_assignments(args.hyperparams, "--hyperparams")
    if args.env_kwargs:
        named = {"env_kwargs": parse_assignments(args.env_kwargs, "--env-kwargs")}
        settings = layered(settings, named)
    budgets = {"n_timesteps": args.n_timesteps, "n_episodes": args.n_episodes}
    return settings | {key: value for key, value in budgets.items() if value is not None}


def _with_settings(study: StudySpec, args: argparse.Namespace) -> StudySpec:
    """The study with the settings of the command line in every agent."""
    from rl_yardstick.experiments.study import AS_IT_COMES, layered
    from rl_yardstick.pipeline.agent_settings import with_engine

    files = _conf_files(study, args.conf_file)
    changes = {**(AS_IT_COMES if args.as_it_comes else {}), **typed_settings(args)}
    is_free = args.is_quick and "engine" not in changes

    def engine(agent: AgentSpec) -> str | None:
        is_own = "engine" in agent.settings
        return "auto" if is_free and not is_own and args.engine is None else args.engine

    agents = tuple(
        replace(
            agent,
            settings=layered(agent.settings, with_engine(agent.algo, changes, engine(agent))),
            conf_file=files.get(agent.algo, agent.conf_file),
        )
        for agent in study.agents
    )
    return replace(study, agents=agents)


# --- progress: a live table, or a line now and then -----------------------------------------------


class StudyProgress(LiveProgress):
    """The progress of a study's runs, by agent and environment."""

    def __init__(
        self,
        console: Console,
        runs: Sequence[PlannedRun],
        done: Sequence[PlannedRun],
        expected: Mapping[tuple[str, str], float] | None = None,
    ) -> None:
        from rl_yardstick.experiments.launching import TimeLeft

        super().__init__(console)
        there = {id(run) for run in done}
        self.left = TimeLeft([run for run in runs if id(run) not in there], expected or {})
        self.total = Counter(run.labels for run in runs)
        self.done = Counter(run.labels for run in done)
        self.failed: Counter[tuple[str, str]] = Counter()
        self._refused: set[str] = set()
        self.n_missing = len(runs) - len(done)
        self.n_ended = 0

    def note(self, run: PlannedRun, failure: RunFailure | None) -> None:
        """Count a run that has ended now."""
        self.n_ended += 1
        now = time.monotonic()
        self.left.start(self.started if self.n_ended == 1 else now, self.n_workers)
        self.left.end(run, now)
        self.left.start(now, self.n_workers)
        key = run.labels
        if failure is None:
            self.done[key] += 1
            self.note_refusal(run)
        else:
            self.failed[key] += 1
            self.say(f"failed: {run.agent} on {run.environment}, seed {run.seed}: {failure.reason}")
        if self.live is None and self.is_over:
            self.say(self.figures())
        else:
            self.look()

    def look(self) -> None:
        """Show the progress; the first call also starts the estimate of the remaining time."""
        self.left.start(time.monotonic(), self.n_workers)
        super().look()

    @property
    def n_workers(self) -> int:
        """The number of runs at once."""
        return 1 if self._launcher is None else self._launcher.n_workers

    def note_refusal(self, run: PlannedRun) -> None:
        """Say once for each environment why its own model is refused, if it is."""
        refusal = run.run.read_info().get("model_refused")
        if isinstance(refusal, str) and run.environment not in self._refused:
            self._refused.add(run.environment)
            self.say(f"{run.environment}: {refusal}; figures are sampled")

    @property
    def is_over(self) -> bool:
        """Whether all runs have ended."""
        return self.n_ended >= self.n_missing

    def figures(self) -> str:
        """The number of ended runs, and an estimate of the remaining time."""
        seconds = time.monotonic() - self.started
        text = f"{self.n_ended} of {self.n_missing} runs in {duration(seconds)}"
        if 0 < self.n_ended < self.n_missing:
            left = self.left.seconds(time.monotonic(), self.n_workers)
            text += "" if left is None else f", about {duration(left)} left by the clock"
        text += self.place_words
        n_failed = self.failed.total()
        return f"{text}, {n_failed} failed" if n_failed else text

    def picture(self) -> Table:
        """The progress by agent and environment, as a table."""
        from rich.progress_bar import ProgressBar
        from rich.table import Table
        from rich.text import Text

        table = Table(box=None, pad_edge=False, caption=self.figures(), caption_justify="left")
        for heading in ("agent", "environment", "runs", "", "failed"):
            table.add_column(heading)
        for key, total in self.total.items():
            done, failed = self.done[key], self.failed[key]
            table.add_row(
                *key,
                f"{done}/{total}",
                ProgressBar(total=total, completed=done, width=24),
                Text(str(failed), "red") if failed else "",
            )
        return table
