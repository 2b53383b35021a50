"""``tune.py``: its flags, a search from the first trial to the winner, and its output."""

from __future__ import annotations

import argparse
import importlib.util
import math
import shlex
import time
from collections import Counter
from dataclasses import fields, replace
from pathlib import Path
from typing import TYPE_CHECKING

from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeRemainingColumn

from rl_yardstick.commands.cli import (
    COUNT,
    OneLineParser,
    add_shared,
    called_as,
    command_line,
    filled,
    folder_name,
    seconds,
    whole_number,
    with_engine,
)
from rl_yardstick.commands.compare import (
    Job,
    conclude,
    do_study,
    held,
    look_by_look,
    typed_settings,
    workers_of,
)
from rl_yardstick.commands.terminal import say, table_console
from rl_yardstick.pipeline.errors import Stopped, UserError
from rl_yardstick.tuning.pruning import PRUNERS
from rl_yardstick.tuning.tuning_spec import (
    AUTO,
    FIGURES,
    OBJECTIVES,
    SAMPLERS,
    SHIPPED,
    TuningSpec,
    without_secret,
)

if TYPE_CHECKING:
    from rl_yardstick.tuning.retesting import Candidate, Outcome
    from rl_yardstick.tuning.searching import Search

# --- flags ----------------------------------------------------------------------------------------

TRIALS = whole_number(1, 100_000)
SEEDS = whole_number(1, 1000)
FIRST_SEED = whole_number(0, 2**31)
SECONDS_BETWEEN_LINES = 10.0

EPILOG = """\
examples:
  python tune.py --env Warehouse-v0 --algo ppo --trials 100
  python tune.py --env FrozenLake8x8-v1 --algo ppo --engine auto -j 4
  python tune.py --env CartPole-v1 --algo dqn --seeds-per-trial 10 --objective lower
  python tune.py --env Taxi-v4 --algo qlearning --sampler grid

The same command again continues the search.
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
    names = ("--trials", "--n-trials", "--max-total-trials")
    number = {"type": TRIALS, "default": 100, "metavar": "N"}
    add(*names, dest="n_trials", **number, help="settings to try (100)")
    number = {"type": SEEDS, "metavar": "N"}
    add("--seeds-per-trial", **number, default=5, help="seeds of each trial (5)")
    first = {"type": FIRST_SEED, "metavar": "N", "help": "the first of these seeds (%(default)s)"}
    add("--first-seed", default=0, **first)
    statistic = "which figure of a trial's runs counts: mean (default), interquartile mean, or "
    statistic += "lower quartile"
    add("--objective", choices=OBJECTIVES, default="mean", help=statistic)
    figure = "which figure of a run counts (default: score, the final policy's return between the "
    figure += "best random or constant policy, 0, and the optimum, 1; the return if no optimum is "
    figure += "known; on bandits regret); steps and seconds count until the threshold"
    add("--metric", choices=FIGURES, help=figure)
    add("--threshold", type=float, metavar="RETURN", help="the return that counts as solved")
    add("--sampler", choices=SAMPLERS, default="tpe", help="what suggests settings (tpe)")
    pruned = "rule that ends hopeless trials (auto)"
    add("--pruner", choices=tuple(PRUNERS), default="auto", help=pruned)
    random = "trials at random before the sampler learns from them (10)"
    count = whole_number(0, 100_000)
    add("--n-startup-trials", type=count, default=10, metavar="N", help=random)
    space = "the values to choose from (default: hyperparams/search_spaces/AGENT.yml)"
    add("--search-space", type=Path, metavar="YAML", help=space)
    add("--seed", type=whole_number(0, 2**32 - 1), default=0, help="seed of the search (0)")
    timeout = "begin no more runs after this time, e.g. 50m; then comes the re-test"
    add("--timeout", type=seconds, default=math.inf, metavar="TIME", help=timeout)

    add = parser.add_argument_group("re-test").add_argument
    again = "run the best K settings and the shipped ones again on other seeds (3; 0 for none)"
    add("--retest", type=whole_number(0, 100), default=3, metavar="K", help=again)
    add("--retest-seeds", **number, default=20, help="how many other seeds (20)")
    add("--first-retest-seed", default=1000, **first)
    decided = "add seeds, at looks fixed beforehand, until the best setting is decided to be better"
    add("--until-decided", action="store_true", help=decided)
    add("--max-retest-seeds", **number, help="the most other seeds for that (80)")

    group = parser.add_argument_group("runs")
    add_shared(group, "--n-timesteps", "--n-episodes")
    fixed = "hyperparameters of every trial, which are not searched, e.g. gamma:0.99"
    add_shared(group, "--hyperparams", help=fixed)
    add_shared(group, "--engine")
    add_shared(group, "--conf-file", help="start from another file's entry")
    add_shared(group, "--env-kwargs", "--gym-packages")
    add = group.add_argument
    add("--eval-freq", type=COUNT, metavar="N", help="steps between two evaluations")
    episodes = "episodes of a sampled evaluation (20)"
    add("--eval-episodes", type=COUNT, default=20, metavar="N", help=episodes)
    add_shared(group, "--jobs", "--cluster", "--run-timeout")

    group = parser.add_argument_group("output")
    add = group.add_argument
    storage = "storage of the trials: a file (a journal), sqlite:///FILE, postgresql://... "
    storage += "(default: trials.db in the search's folder)"
    add("--storage", type=filled, metavar="WHERE", help=storage)
    name = "name of the search and its folder (default: ENV_AGENT)"
    add("--name", "--study-name", dest="name", type=folder_name, help=name)
    names = ("-f", "--log-folder", "--optimization-log-path")
    folder = "folder of all searches (logs/tuning)"
    add(*names, dest="log_folder", type=filled, default="logs/tuning", help=folder)
    names = ("--no-report", "--no-optim-plots")
    no_page = "only tables: no figures and no page"
    add(*names, dest="no_report", action="store_true", help=no_page)
    # Users of rl_zoo3 type it; this command always does what it asks for.
    names = ("-optimize", "--optimize-hyperparameters")
    add(*names, action="store_true", help=argparse.SUPPRESS)
    return parser


def tuning_spec(args: argparse.Namespace) -> TuningSpec:
    """The search that the arguments ask for."""
    from rl_yardstick.experiments.study import (
        AgentSpec,
        EnvironmentSpec,
        StudySpec,
        file_name,
        with_maps_named,
    )
    from rl_yardstick.pipeline.environments import check_env_id
    from rl_yardstick.pipeline.settings import check_agent

    if importlib.util.find_spec("optuna") is None:
        raise UserError("tuning needs: pip install 'rl-yardstick[tune]'")
    check_agent(args.algo)
    check_env_id(args.env)
    for flag, path in (("--conf-file", args.conf_file), ("--search-space", args.search_space)):
        if path is not None and not path.is_file():
            raise UserError(f"{flag}: there is no file {path}")
    if args.n_timesteps is not None and args.n_episodes is not None:
        raise UserError("how long to train? give -n or --n-episodes, not both")
    # The settings that the command line fixes.
    settings = with_engine(args.algo, typed_settings(args), args.engine)
    study = StudySpec(
        name=args.name or file_name(f"{args.env.replace('/', '-')}_{args.algo}"),
        title="",
        agents=(AgentSpec(SHIPPED, args.algo, settings, conf_file=args.conf_file),),
        environments=(EnvironmentSpec(args.env, args.env),),
        n_seeds=args.seeds_per_trial,
        first_seed=args.first_seed,
        eval_freq=args.eval_freq,
        eval_episodes=args.eval_episodes,
        threshold=args.threshold,
        gym_packages=tuple(args.gym_packages),
        run_timeout=args.run_timeout,
    )
    study = with_maps_named(study)
    title = f"{args.algo} on {study.environments[0].label}: a search for settings"
    # A flag with the name of a field sets that field.
    named = {key.name: getattr(args, key.name) for key in fields(TuningSpec) if key.name in args}
    tuning = TuningSpec(**named, study=replace(study, title=title), figure=args.metric or AUTO)
    tuning.check()
    return tuning


# --- search and re-test ---------------------------------------------------------------------------


def main() -> int:
    """Parse the arguments, search and re-test; return the exit code."""
    args = build_parser().parse_args()
    from rl_yardstick.pipeline.modules import import_modules, split_id
    from rl_yardstick.pipeline.run import Stop

    stop, deadline = Stop().listen(), time.monotonic() + args.timeout
    module, args.env = split_id(args.env)
    args.gym_packages += [module] if module else []
    import_modules(args.gym_packages)
    tuning = tuning_spec(args)
    root = Path(args.log_folder) / tuning.study.name
    workers = workers_of(args, root, tuning.study.run_timeout)
    # Run folders record the command, so it must not contain a password.
    command = without_secret(command_line())
    job = Job(root, command, table_console(), stop, workers, not args.no_report)
    job.console.print(tuning.study.title, style="bold")
    with job.console.status("loading the libraries"):
        from rl_yardstick.tuning.searching import open_search, storage_errors
    with held(root), workers, storage_errors(without_secret(args.storage or f"{root}/trials.db")):
        search = open_search(tuning, root, args.storage)
        print_opened(job, search)
        try:
            do_trials(job, search, deadline)
            print_search(job.console, search)
            return do_retest(job, search)
        except Stopped:
            say(job.console, "stopped; the same command continues the search")
            raise


def do_trials(job: Job, search: Search, deadline: float) -> None:
    """Do trials until there are enough; begin no run after ``deadline`` (`time.monotonic`)."""
    from rl_yardstick.experiments.pool import keep_busy
    from rl_yardstick.tuning.searching import Trials

    if search.is_done:
        return
    with TuningProgress(job.console, search) as progress:
        trials = Trials(search, progress.trial_ended, deadline)
        keep_busy(job.workers, trials.next_run, trials.ended, job.command, job.stop)


def do_retest(job: Job, search: Search) -> int:
    """Run the best settings again, and write the winner; return the exit code."""
    from rl_yardstick.tuning.retesting import WINNER, best_trials, chosen_for_retest, write_winner

    tuning, console = search.tuning, job.console
    ranked = best_trials(tuning, search.trials)
    candidates = chosen_for_retest(tuning, ranked)
    if not candidates:
        if tuning.retest:
            which = "no settings but the shipped ones" if ranked else "no settings"
            why = f"{which} were judged to the end"
            if any(each.number for each in ranked):
                why = "the best settings are clearly below the shipped settings in the search"
            say(console, f"{why}: no re-test")
        write_down(job, search, None)
        return 0 if ranked or not search.is_done else 1
    code, outcome = retested(job, search, ranked, candidates)
    print_outcome(console, outcome)
    winner = outcome.winner
    if winner is None:
        (search.root / WINNER).unlink(missing_ok=True)  # from before the search continued
        write_down(job, search, outcome)
        return code
    entry = next(each.entry for each in candidates if each.number == winner.number)
    path = write_winner(search, outcome, entry)
    write_down(job, search, outcome)
    words = ["--algo", tuning.agent.algo, "--env", tuning.environment.env_id, "--conf-file"]
    how = f"{called_as('train')} {shlex.join([*words, str(path)])}"
    say(console, f"winner: {winner.label}, in {path}: {how}")
    say(console, f"  {winner.verdict} than the shipped settings, on average")
    shipped = search.suggestions.shipped
    for key in {**shipped, **entry}:
        if entry.get(key) != shipped.get(key):
            before, now = (each.get(key, "left out") for each in (shipped, entry))
            say(console, f"  {key}: {now} (was {before})")
    return code


def retested(
    job: Job, search: Search, ranked: list[Candidate], candidates: list[Candidate]
) -> tuple[int, Outcome]:
    """Do the re-test; return the exit code and the outcome."""
    from rl_yardstick.experiments.analysis import analyse
    from rl_yardstick.experiments.growing import plan_of_looks
    from rl_yardstick.experiments.plan import StudyRecord, plan, specs_of
    from rl_yardstick.tuning.retesting import FOLDER, concluded, is_settled, retest_study

    tuning, again = search.tuning, replace(job, root=job.root / FOLDER)
    study = retest_study(tuning, job.root, candidates)
    looks = ()
    if tuning.until_decided:
        looks = plan_of_looks(study, again.root, tuning.max_retest_seeds)
    record = StudyRecord(study, specs_of(study), looks)
    with held(again.root):
        record.write(again.root)
        if looks:
            results, _ = look_by_look(again, record, is_settled)
        else:
            results = do_study(again, study, plan(study, again.root, specs=record.specs))
        code = conclude(again, results, looks)
        with job.console.status("judging the winner"):
            return code, concluded(tuning, ranked, candidates, analyse(results, looks))


def write_down(job: Job, search: Search, outcome: Outcome | None) -> None:
    """Write the record of the search, and its page."""
    from rl_yardstick.tuning.retesting import FOLDER, RECORD, write_record

    record = write_record(search, outcome, job.command)
    files = [job.root / RECORD]
    if job.with_page:
        with job.console.status("writing the page"):
            from rl_yardstick.report.page.tuning import write_tuning_page

            page, retest = job.root / "report.html", f"{FOLDER}/report.html"
            write_tuning_page(record, page, retest if (job.root / retest).exists() else "")
            files.append(page)
    say(job.console, f"files: {', '.join(map(str, files))}")


# --- output ---------------------------------------------------------------------------------------


def print_opened(job: Job, search: Search) -> None:
    """Print the number of trials, seeds and free settings, and the engines."""
    from rl_yardstick.commands.engines import NETWORKS, planned_outlook, search_line
    from rl_yardstick.tuning.retesting import unproven_mark
    from rl_yardstick.tuning.suggesting import planned_runs, shipped_run

    tuning, suggestions, algo = search.tuning, search.suggestions, search.tuning.agent.algo
    n_there = sum(trial.state.is_finished() for trial in search.trials)
    there = f"{search.n_trials} trials of up to {len(tuning.seeds)} seeds, {n_there} of them there"
    free = f"{suggestions.n_free} settings to choose; {job.workers.words}, in {job.root}"
    lines = [f"{there} already; {free}"]
    if mark := unproven_mark(tuning):
        lines.append(f"scores are{mark}")
    if suggestions.fits_batches:
        lines.append(
            "batch_size: where it does not divide n_steps times n_envs, as the library recommends, "
            "the nearest number that does is tried"
        )
    wider = "the search space is widened to hold the shipped value"
    lines += [f"{name}: {wider}" for name in suggestions.space.widened]
    if algo in NETWORKS:
        runs = (
            planned_runs(tuning, job.root, suggestions.shipped)[0],
            shipped_run(tuning, job.root),
        )
        if line := search_line(algo, *(planned_outlook(run.spec) for run in runs)):
            lines.append(f"engine: {line}")
    for line in lines:
        say(job.console, line)


_STATES = {"COMPLETE": "judged to the end", "PRUNED": "ended early", "FAIL": "failed"}


def print_search(console: Console, search: Search) -> None:
    """Print the cost of the search, and whether several settings reach the optimum."""
    from rl_yardstick.tuning.searching import FAILURE, outcomes_of

    trials, n_seeds = search.trials, len(search.tuning.seeds)
    states = Counter(
        "failed" if FAILURE in trial.user_attrs else _STATES.get(trial.state.name, "to do")
        for trial in trials
    )
    states["to do"] += search.n_trials - len(trials)
    runs = [run for trial in trials for run in outcomes_of(trial).values()]
    counts = ", ".join(f"{count} {state}" for state, count in (+states).items())
    say(
        console,
        f"{search.n_trials} trials: {counts}; {len(runs)} of {search.n_trials * n_seeds} runs, "
        f"{sum(run.seconds for run in runs):,.0f} s of processor time",
    )
    if (n := search.n_at_optimum) > 1:
        text = f"{n} settings have the optimum on all seeds, so their scores are tied: they are "
        text += "ranked by steps to the threshold"
        if search.is_saturated and not search.is_done:
            text += "; the search ends here, since more trials cannot score more (--metric steps "
            text += "searches for the fastest)"
        say(console, text)


def print_outcome(console: Console, outcome: Outcome) -> None:
    """Print the table of the re-test, the optimism of the search, and why nothing won."""
    from rich.table import Table

    def figure(value: float | None) -> str:
        return "" if value is None else f"{value:.4g}"

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
        figures = (each.label, figure(each.in_search), figure(each.held_out), ends, each.verdict)
        table.add_row(*figures, str(each.n_runs), figure(each.n_failed))
    console.print(table, highlight=False)
    if outcome.optimism is not None:
        optimism = "optimism of the search, its best there less the same on other seeds"
        say(console, f"{optimism}: {round(outcome.optimism, 9):+.4g}")
    if outcome.winner is None:
        say(console, f"no winner: {outcome.reason}; they stay as they are")


class TuningProgress:
    """The progress of a search: a bar on a terminal, and else a line now and then."""

    def __init__(self, console: Console, search: Search) -> None:
        self.console, self.total = console, search.n_trials
        self.sign = 1 if search.tuning.is_cost else -1
        trials = [trial for trial in search.trials if trial.state.is_finished()]
        self.values = {t.number: t.value if t.state.name == "COMPLETE" else None for t in trials}
        columns = TextColumn("trials"), BarColumn(), MofNCompleteColumn(), TimeRemainingColumn()
        best = TextColumn("{task.description}")
        self.bar = Progress(
            *columns, best, console=console, transient=True, disable=not console.is_terminal
        )
        self.task = self.bar.add_task("", total=self.total, completed=len(trials))
        self.begun = self.told_at = time.monotonic()

    def __enter__(self) -> TuningProgress:
        self.bar.start()
        return self

    def __exit__(self, *error: object) -> None:
        self.bar.stop()

    def trial_ended(self, number: int, value: float | None, reason: str) -> None:
        """Count a trial that has ended, and print a line if it failed or is the best so far."""
        best = min((self.sign * v for v in self.values.values() if v is not None), default=math.inf)
        self.values[number] = value
        if reason:
            say(self.console, f"trial {number} failed: {reason}")
        elif value is not None and self.sign * value < best:
            say(self.console, f"trial {number}: {value:.4g}, the best so far")
            best = self.sign * value
        words = f"best {self.sign * best:.4g}" if best < math.inf else ""
        self.bar.update(self.task, completed=len(self.values), description=words)
        now = time.monotonic()
        if not self.console.is_terminal and now - self.told_at > SECONDS_BETWEEN_LINES:
            self.told_at, n = now, len(self.values)
            text = f"{n} of {self.total} trials in {now - self.begun:.0f} s"
            say(self.console, f"{text}; {words}" if words else text)
