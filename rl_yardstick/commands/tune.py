"""``tune.py``: its flags, a search from the first trial to the winner, and its output."""

from __future__ import annotations

import argparse
import importlib.util
import math
import shlex
import time
from collections import Counter
from collections.abc import Callable
from dataclasses import fields, replace
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING

from rich.console import Console

from rl_yardstick.commands.cli import (
    COUNT,
    FIRST_SEED,
    LONGEST_FOLDER_NAME,
    RUN_TIMEOUT,
    OneLineParser,
    add_shared,
    called_as,
    command_line,
    filled,
    folder_name,
    go_on_unread,
    whole_number,
)
from rl_yardstick.commands.compare import (
    RunContext,
    conclude,
    do_missing,
    give_way,
    look_by_look,
    read,
    run_context,
    typed_settings,
)
from rl_yardstick.commands.terminal import LiveProgress, say, search_line, table_console
from rl_yardstick.pipeline.errors import UserError, unknown
from rl_yardstick.pipeline.failures import exits_as_mistakes
from rl_yardstick.pipeline.signs_of_life import doing, duration
from rl_yardstick.pipeline.stopping import stops_noticed
from rl_yardstick.tuning.pruning import PRUNERS
from rl_yardstick.tuning.tuning_spec import (
    AUTO,
    FIGURES,
    OBJECTIVES,
    SAMPLERS,
    SHIPPED,
    TuningSpec,
    failing_in_a_line,
    kind_of,
    without_secret,
)

if TYPE_CHECKING:
    from rl_yardstick.tuning.retesting import Candidate, Outcome
    from rl_yardstick.tuning.searching import OpenTuning

# Flags.

TRIALS = whole_number(1, 100_000)
SEEDS = whole_number(1, 1000)

EPILOG = """\
examples:
  python tune.py --env Warehouse-v0 --algo ppo --trials 100
  python tune.py --env FrozenLake8x8-v1 --algo ppo --engine auto -j 4
  python tune.py --env CartPole-v1 --algo dqn --seeds-per-trial 10 --objective lower
  python tune.py --env Taxi-v4 --algo qlearning --sampler grid --storage journal:shared/taxi.log

The same command again continues the search; several at once share the work.
"""


def build_parser() -> argparse.ArgumentParser:
    """The flags; those of runs are as in train and compare, many others as in rl_zoo3."""
    parser = OneLineParser(
        description="Search for an agent's hyperparameters: judge each setting over several seeds, "
        "run the best again on other seeds, and save a setting that is better there.",
        epilog=EPILOG,
    )
    add = parser.add_argument
    add("--algo", required=True, metavar="AGENT", help="agent (train --list has them)")
    add("--env", required=True, metavar="ID", help="environment")

    add = parser.add_argument_group("search").add_argument
    add(
        *("--trials", "--n-trials", "--max-total-trials"),
        dest="n_trials",
        type=TRIALS,
        default=100,
        metavar="N",
        help="settings to try, over all drivers (100)",
    )
    seeds = "seeds of each trial (5)"
    add("--seeds-per-trial", type=SEEDS, default=5, metavar="N", help=seeds)
    first = "the first of these seeds (0)"
    add("--first-seed", type=FIRST_SEED, default=0, metavar="N", help=first)
    add(
        "--objective",
        choices=OBJECTIVES,
        default="mean",
        help="which figure of a trial's runs counts: mean (default), interquartile mean, or lower "
        "quartile",
    )
    add(
        "--metric",
        choices=FIGURES,
        help="which figure of a run counts (default: score, the final policy's return between the "
        "best random or constant policy, 0, and the optimum, 1; the return if no optimum is known; "
        "on bandits regret); steps and seconds count until the threshold",
    )
    add("--threshold", type=float, metavar="RETURN", help="the return that counts as solved")
    add("--sampler", choices=SAMPLERS, default="tpe", help="what suggests settings (tpe)")
    pruned = "rule that ends hopeless trials (auto)"
    add("--pruner", choices=tuple(PRUNERS), default="auto", help=pruned)
    add(
        "--n-startup-trials",
        type=whole_number(0, 100_000),
        default=10,
        metavar="N",
        help="trials at random before the sampler learns from them (10)",
    )
    space = "the values to choose from (default: hyperparams/search_spaces/AGENT.yml)"
    add("--search-space", type=filled, metavar="YAML", help=space)
    add("--seed", type=whole_number(0, 2**32 - 1), default=0, help="seed of the search (0)")
    timeout = "begin no more runs after this time, e.g. 50m; then comes the re-test"
    add("--timeout", type=RUN_TIMEOUT, metavar="TIME", help=timeout)

    add = parser.add_argument_group("re-test").add_argument
    add(
        "--retest",
        type=whole_number(0, 100),
        default=3,
        metavar="K",
        help="run the best K settings and the shipped ones again on other seeds (3; 0 for none)",
    )
    add("--retest-seeds", type=SEEDS, default=20, metavar="N", help="how many other seeds (20)")
    first = "the first of these seeds (1000)"
    add("--first-retest-seed", type=FIRST_SEED, default=1000, metavar="N", help=first)
    decided = "add seeds, at looks fixed beforehand, until the best setting is decided to be better"
    add("--until-decided", action="store_true", help=decided)
    most = "the most other seeds for that (80)"
    add("--max-retest-seeds", type=SEEDS, metavar="N", help=most)

    group = parser.add_argument_group("runs")
    add_shared(group, "--n-timesteps", "--n-episodes")
    fixed = "hyperparameters of every trial, which are not searched, e.g. gamma:0.99"
    add_shared(group, "--hyperparams", help=fixed)
    add_shared(group, "--engine")
    add_shared(group, "--conf-file", help="start from another file's entry")
    add_shared(group, "--env-kwargs", "--gym-packages")
    add = group.add_argument
    add("--eval-freq", type=COUNT, metavar="N", help="steps between two evaluations")
    add("--eval-episodes", type=COUNT, metavar="N", help="episodes of a sampled evaluation (20)")
    add_shared(group, "--jobs", "--cluster", "--insecure-cluster", "--run-timeout", "--run-memory")

    add = parser.add_argument_group("output").add_argument
    add(
        "--storage",
        type=filled,
        metavar="WHERE",
        help="storage of the trials: journal:FILE, sqlite:///FILE, postgresql://..., "
        "grpc://HOST:PORT (default: a SQLite file in the search's folder)",
    )
    add(
        *("--name", "--study-name"),
        dest="name",
        type=folder_name,
        help="name of the search and its folder (default: ENV_AGENT)",
    )
    add(
        *("-f", "--log-folder", "--optimization-log-path"),
        dest="log_folder",
        type=filled,
        default="logs/tuning",
        help="folder of all searches (logs/tuning)",
    )
    add(
        *("--no-report", "--no-optim-plots"),
        dest="no_report",
        action="store_true",
        help="only tables: no figures and no page",
    )
    # Accepted because users of rl_zoo3 type it; this command always does what it asks for.
    optimize = ("-optimize", "--optimize-hyperparameters")
    parser.add_argument(*optimize, action="store_true", help=argparse.SUPPRESS)
    return parser


# Search and re-test.


def main() -> int:
    """Parse the arguments, search and re-test; return the exit code."""
    args = build_parser().parse_args()
    with stops_noticed(), exits_as_mistakes():
        return _tune(args)


def _tune(args: argparse.Namespace) -> int:
    tuning = tuning_spec(args)
    from rl_yardstick.experiments.child_processes import end_server
    from rl_yardstick.experiments.run_limits import RunLimits

    go_on_unread()
    console = table_console()
    console.print(tuning.study.title, style="bold", highlight=False)
    root = Path(args.log_folder) / tuning.study.name
    try:
        # Run folders record the command, so it must not contain a password.
        command = without_secret(command_line())
        limits = RunLimits(tuning.study.run_timeout, tuning.study.run_memory)
        context = run_context(args, root, command, limits, console)
        deadline = math.inf if args.timeout is None else time.monotonic() + args.timeout
        with doing(console, "loading the libraries"):
            from rl_yardstick.experiments.plan import plan

            context.get_ready(plan(replace(tuning.study, n_seeds=1), root))
            from rl_yardstick.pipeline.locks import FolderInUseError, told_if_gone
            from rl_yardstick.tuning.searching import open_tuning

            with failing_in_a_line(args.storage):
                opened = open_tuning(tuning, root, args.storage)
        with told_if_gone(root), failing_in_a_line(args.storage):
            with opened.queue:
                print_opened(context, opened)
                _search(context, opened, deadline)
            print_search(console, opened)
            try:
                return _retest(context, opened)
            except FolderInUseError as error:
                say(console, f"another driver does the re-test: {error}")
                return 0
    except KeyboardInterrupt:
        end_server()
        raise


def _search(context: RunContext, opened: OpenTuning, deadline: float) -> None:
    """Do trials until there are enough; begin no run after ``deadline`` (monotonic seconds)."""
    from rl_yardstick.experiments.run_folders import remove_dead_drafts
    from rl_yardstick.tuning.searching import Search

    def ended() -> dict[int, float | None]:
        trials = [trial for trial in queue.trials() if trial.state.is_finished()]
        return {t.number: t.value if t.state.name == "COMPLETE" else None for t in trials}

    tuning, queue = opened.tuning, opened.queue
    if queue.is_done():
        return
    progress = TuningProgress(context.console, queue.n_trials, ended, is_cost=tuning.is_cost)
    with progress, progress.watching(context.launchers)() as launcher:
        Search(opened, launcher, progress, deadline).run()
    if queue.is_done():
        remove_dead_drafts(opened.root)  # of runs that are no longer needed


def _retest(context: RunContext, opened: OpenTuning) -> int:
    """Run the best settings again, and write the winner; return the exit code."""
    from rl_yardstick.pipeline.locks import folder_lock
    from rl_yardstick.tuning.retesting import (
        FOLDER,
        WINNER,
        best_trials,
        chosen_for_retest,
        write_winner,
    )

    tuning, tell = opened.tuning, partial(say, context.console)
    ranked = best_trials(opened.queue.trials(), is_cost=tuning.is_cost)
    candidates = chosen_for_retest(ranked, tuning.retest, is_cost=tuning.is_cost)
    if not candidates:
        if tuning.retest:
            which = "no settings but the shipped ones" if ranked else "no settings"
            why = f"{which} were judged to the end"
            if any(each.number for each in ranked):
                why = "the best settings are clearly below the shipped settings in the search"
            tell(f"{why}: no re-test")
        _write_down(context, opened, None)
        return 0 if ranked or not opened.queue.is_done() else 1
    again = replace(context, root=opened.root / FOLDER)
    with folder_lock(again.root, give_way, tell):
        code, outcome = _retested(again, opened, ranked, candidates)
        won = None if outcome.winner is None else outcome.winner.number
        winner = next((c for c in candidates if outcome.winner and c.number == won), None)
        path = None
        if winner is None:
            (opened.root / WINNER).unlink(missing_ok=True)  # from before the search went on
        else:
            n_trials = opened.queue.n_trials
            path = write_winner(tuning, opened.root, outcome, winner.entry, n_trials)
        print_outcome(context.console, opened, outcome)
        _write_down(context, opened, outcome)
    if winner is not None and path is not None:
        words = ["--algo", tuning.agent.algo, "--env", tuning.environment.env_id]
        how = f"{called_as('train')} {shlex.join([*words, '--conf-file', str(path)])}"
        tell(f"winner: {winner.label}, in {path}: {how}")
        assert outcome.winner is not None
        tell(f"  {outcome.winner.verdict} than the shipped settings, on average")
        entry, shipped = winner.entry, opened.suggestions.shipped
        for key in {**shipped, **entry}:
            if entry.get(key) != shipped.get(key):
                was = shipped.get(key, "left out")
                tell(f"  {key}: {entry.get(key, 'left out')} (was {was})")
    return code


def _retested(
    context: RunContext, opened: OpenTuning, ranked: list[Candidate], candidates: list[Candidate]
) -> tuple[int, Outcome]:
    """Do the re-test; return the exit code and the outcome."""
    from rl_yardstick.experiments.analysis import analyse
    from rl_yardstick.experiments.growing import looks_of, plan_of_looks, write_looks
    from rl_yardstick.experiments.launching import EarlyResults
    from rl_yardstick.experiments.plan import plan
    from rl_yardstick.tuning.retesting import concluded, is_settled, retest_study

    tuning = opened.tuning
    study = retest_study(tuning, opened.root, candidates)
    planned = plan(study, context.root)
    if tuning.until_decided:
        looks = plan_of_looks(study, context.root, tuning.max_retest_seeds)
        context.get_ready(planned)
        write_looks(context.root, looks)
        results, _, failures = look_by_look(context, study, looks["looks"], is_settled)
    else:
        context.get_ready(planned)
        early = EarlyResults(study)
        failures = do_missing(context, planned, early)
        results = read(context, study, planned, early)
    code = conclude(context, results, failures)
    with doing(context.console, "judging the winner") as activity:
        analysis = analyse(results, activity.at, looks_of(context.root))
        return code, concluded(tuning, ranked, candidates, analysis)


def _write_down(context: RunContext, opened: OpenTuning, outcome: Outcome | None) -> None:
    """Write the record of the search, and its page."""
    from rl_yardstick.tuning.retesting import FOLDER, RECORD, write_record

    record = write_record(opened, outcome, context.command)
    files = [opened.root / RECORD]
    if context.with_page:
        with doing(context.console, "writing the page"):
            from rl_yardstick.report.page.tuning import write_tuning_page

            page, retest = opened.root / "report.html", f"{FOLDER}/report.html"
            write_tuning_page(record, page, retest if (opened.root / retest).exists() else "")
            files.append(page)
    say(context.console, f"files: {', '.join(map(str, files))}")


# From flags to a tuning.


def tuning_spec(args: argparse.Namespace) -> TuningSpec:
    """The tuning that the arguments ask for."""
    from rl_yardstick.agents import ALGORITHMS
    from rl_yardstick.experiments.study import AgentSpec, EnvironmentSpec, StudySpec, file_name
    from rl_yardstick.pipeline.agent_settings import with_engine
    from rl_yardstick.pipeline.environments import check_env_id, map_name, titled
    from rl_yardstick.pipeline.runs import environment_name
    from rl_yardstick.pipeline.user_modules import import_typed

    if importlib.util.find_spec("optuna") is None:
        raise UserError("tuning needs: pip install 'rl-yardstick[tune]'")
    modules = import_typed(args.gym_packages, [args.env])
    if args.algo not in ALGORITHMS:
        raise unknown("unknown agent", args.algo, ALGORITHMS)
    check_env_id(args.env)
    for flag, name in (("--conf-file", args.conf_file), ("--search-space", args.search_space)):
        if name is not None and not Path(name).is_file():
            raise UserError(f"{flag}: there is no file {name}")
    # The agent, with the settings that the command line fixes.
    settings = typed_settings(args)
    if args.n_timesteps is not None and args.n_episodes is not None:
        raise UserError("how long to train? give -n or --n-episodes, not both")
    conf_file = None if args.conf_file is None else Path(args.conf_file)
    settings = with_engine(args.algo, settings, args.engine)
    of_map = map_name(args.env, settings)
    label = titled(args.env, of_map)
    study = StudySpec(
        name=args.name
        or file_name(f"{environment_name(args.env)}_{args.algo}", LONGEST_FOLDER_NAME),
        title=f"{args.algo} on {label}: a search for settings",
        agents=(AgentSpec(SHIPPED, args.algo, settings, conf_file=conf_file),),
        environments=(EnvironmentSpec(label, args.env, map_name=of_map),),
        n_seeds=args.seeds_per_trial,
        first_seed=args.first_seed,
        eval_freq=args.eval_freq,
        eval_episodes=args.eval_episodes or StudySpec.eval_episodes,
        threshold=args.threshold,
        gym_packages=tuple(module.name for module in modules),
        user_modules=modules,
        run_timeout=args.run_timeout,
        run_memory=args.run_memory,
    )
    # A flag with the name of a field sets that field.
    named = {key.name: getattr(args, key.name) for key in fields(TuningSpec) if key.name in args}
    named["search_space"] = None if args.search_space is None else Path(args.search_space)
    tuning = TuningSpec(**named, study=study, figure=args.metric or AUTO)
    tuning.check()
    if args.storage is not None:
        kind_of(args.storage)
    return tuning


# Output.


def print_opened(context: RunContext, opened: OpenTuning) -> None:
    """Print the number of trials, seeds and free settings, and the engines."""
    from rl_yardstick.pipeline.train_spec import NETWORKS
    from rl_yardstick.tuning.retesting import unproven_mark
    from rl_yardstick.tuning.suggesting import planned_run, shipped_run

    tell = partial(say, context.console)
    tuning, suggestions = opened.tuning, opened.suggestions
    n_there = sum(trial.state.is_finished() for trial in opened.queue.trials())
    tell(
        f"{opened.queue.n_trials} trials of up to {len(tuning.seeds)} seeds, {n_there} of them "
        f"there already; {suggestions.n_free} settings to choose; {context.words}, in {opened.root}"
    )
    if mark := unproven_mark(tuning):
        tell(f"scores are{mark}")
    if suggestions.fits_batches:
        tell(
            "batch_size: where it does not divide n_steps times n_envs, as the library recommends, "
            "the nearest number that does is tried"
        )
    for name in suggestions.space.widened:
        tell(f"{name}: the search space is widened to hold the shipped value")
    if tuning.agent.algo not in NETWORKS:
        return
    from rl_yardstick.pipeline.preparation import planned_outlook

    searched = planned_run(tuning, opened.root, suggestions.shipped, tuning.seeds[0])
    runs = (searched, shipped_run(tuning, opened.root))
    line = search_line(tuning.agent.algo, *(planned_outlook(run.spec) for run in runs))
    if line:
        tell(f"engine: {line}")


_STATES = {"COMPLETE": "judged to the end", "PRUNED": "ended early", "FAIL": "failed"}


def print_search(console: Console, opened: OpenTuning) -> None:
    """Print the cost of the search, and whether several settings reach the optimum."""
    from rl_yardstick.tuning.trial_storage import FAILURE, figures_of, seconds_of

    trials, tuning = opened.queue.trials(), opened.tuning
    states = Counter(
        "failed" if FAILURE in trial.user_attrs else _STATES.get(trial.state.name, "to do")
        for trial in trials
    )
    n_runs = sum(len(figures_of(trial.user_attrs)) for trial in trials)
    seconds = sum(seconds_of(trial.user_attrs) for trial in trials)
    counts = ", ".join(f"{count} {state}" for state, count in states.items())
    say(
        console,
        f"{len(trials)} trials: {counts}; {n_runs} of {len(trials) * len(tuning.seeds)} runs, "
        f"{duration(seconds)} of processor time",
    )
    if (n := opened.n_at_optimum) > 1:
        text = f"{n} settings have the optimum on all seeds, so their scores are tied: they are "
        text += "ranked by steps to the threshold"
        if opened.is_saturated and not opened.queue.is_done():
            text += "; the search ends here, since more trials cannot score more (--metric steps "
            text += "searches for the fastest)"
        say(console, text)


def print_outcome(console: Console, opened: OpenTuning, outcome: Outcome) -> None:
    """Print the table of the re-test, the optimism of the search, and why nothing won."""
    from rich.table import Table

    held_out = outcome.held_out
    console.print()
    title = f"re-test on the seeds {held_out.start} to {held_out.stop - 1}"
    table = Table(box=None, pad_edge=False, title=title, title_justify="left")
    headings = "settings, in the search, on other seeds, 95 % interval, is, runs, failed"
    for heading in headings.split(", "):
        table.add_column(heading)
    for each in outcome.retested:
        interval = each.interval
        ends = "" if interval is None else f"{interval.low:.4g} to {interval.high:.4g}"
        table.add_row(
            each.label,
            "" if each.in_search is None else f"{each.in_search:.4g}",
            "" if each.held_out is None else f"{each.held_out:.4g}",
            ends,
            each.verdict,
            str(each.n_runs),
            "" if each.n_failed is None else str(each.n_failed),
        )
    console.print(table, highlight=False)
    if outcome.optimism is not None:
        optimism = "optimism of the search, its best there less the same on other seeds"
        say(console, f"{optimism}: {round(outcome.optimism, 9):+.4g}")
    if outcome.winner is None:
        say(console, f"no winner: {outcome.reason}; they stay as they are")


# Progress: a live line, or a line now and then.

# Reading many trials takes time.
SECONDS_BETWEEN_QUESTIONS = 5.0


class TuningProgress(LiveProgress):
    """The progress of a search, and its best trial."""

    def __init__(
        self,
        console: Console,
        n_trials: int,
        ended: Callable[[], dict[int, float | None]],
        *,
        is_cost: bool,
    ) -> None:
        super().__init__(console)
        self.n_trials, self.is_cost = n_trials, is_cost
        # The values of ended trials by number; None for those without a value (ended early).
        self._ended, self._asked_at = ended, time.monotonic()
        self.values = ended()
        self.n_before = len(self.values)
        self.n_runs = 0

    def run_ended(self) -> None:
        """Count a run that has ended."""
        self.n_runs += 1
        if time.monotonic() > self._asked_at + SECONDS_BETWEEN_QUESTIONS:
            self.values, self._asked_at = self._ended(), time.monotonic()
        self.look()

    def trial_ended(self, number: int, value: float | None, reason: str) -> None:
        """Count a trial that has ended, and print a line if it failed or is the best so far."""
        best = self.best()
        self.values[number] = value
        if reason:
            self.say(f"trial {number} failed: {reason}")
        elif value is not None and (best is None or self._is_better(value, best[1])):
            self.say(f"trial {number}: {value:.4g}, the best so far")

    def _is_better(self, value: float, other: float) -> bool:
        return value < other if self.is_cost else value > other

    def best(self) -> tuple[int, float] | None:
        """The number and the value of the best trial; None before there is any."""
        judged = [(number, value) for number, value in self.values.items() if value is not None]
        sign = 1 if self.is_cost else -1
        return min(judged, key=lambda each: (sign * each[1], each[0]), default=None)

    def figures(self) -> str:
        """The number of ended trials, the best one, and an estimate of the remaining time."""
        seconds = time.monotonic() - self.started
        ended, new = len(self.values), len(self.values) - self.n_before
        runs = "1 run" if self.n_runs == 1 else f"{self.n_runs} runs"
        text = f"{ended} of {self.n_trials} trials, {runs} in {duration(seconds)}"
        text += self.place_words
        best = self.best()
        if best is not None:
            text += f"; best {best[1]:.4g} (trial {best[0]})"
        if new > 0 and ended < self.n_trials:
            text += f"; about {duration(seconds / new * (self.n_trials - ended))} left by the clock"
        return text
