"""``tune.py``: its flags, a search from the first trial to the winner, and its output."""

from __future__ import annotations

import argparse
import math
import time
from collections import Counter
from dataclasses import fields, replace
from pathlib import Path
from typing import TYPE_CHECKING

from rich.console import Console

from rl_yardstick.commands import cli, compare
from rl_yardstick.commands.cli import Flags, OneLineParser, flag, seconds, shared, switch
from rl_yardstick.commands.compare import Job, held
from rl_yardstick.commands.terminal import say, table_console
from rl_yardstick.experiments.study import AgentSpec, with_maps_named
from rl_yardstick.pipeline.errors import Stopped
from rl_yardstick.tuning.tuning_spec import (
    FIGURES,
    OBJECTIVES,
    PRUNERS,
    SAMPLERS,
    SHIPPED,
    TuningSpec,
)

if TYPE_CHECKING:
    from optuna.trial import FrozenTrial

    from rl_yardstick.tuning.retesting import Outcome
    from rl_yardstick.tuning.searching import Search

# --- flags ----------------------------------------------------------------------------------------

EPILOG = """\
examples:
  python tune.py --env Warehouse-v0 --algo ppo --trials 100
  python tune.py --env FrozenLake8x8-v1 --algo ppo --engine auto -j 4

The same command again continues the search.
"""

SEEDS, TRIALS, STARTUP = (cli.whole_number(*ends) for ends in ((1, 1000), (1, 10**5), (0, 10**5)))
# Flags that set the field of `StudySpec` with their name, as --gym-packages does.
OF_STUDY = ("name", "first_seed", "eval_freq", "eval_episodes", "threshold", "run_timeout")
METRIC = "figure of a run (default: score, return or regret)"
FOLDER = "-f --log-folder --optimization-log-path"  # as in rl_zoo3
FLAGS: Flags = {
    "": (
        flag("--algo", "train --list has them", required=True, metavar="AGENT"),
        flag("--env", "environment", required=True, metavar="ID"),
    ),
    "search": (
        flag("--n-trials --trials --max-total-trials", "settings to try (100)", TRIALS, 100),
        flag("--seeds-per-trial", "seeds of each trial (5)", SEEDS, 5),
        flag("--first-seed", "the first of these seeds (0)", cli.FIRST_SEED, 0),
        flag("--objective", "value of a trial by its runs", default="mean", choices=OBJECTIVES),
        flag("--metric", METRIC, choices=FIGURES, dest="figure"),
        flag("--threshold", "the return that counts as solved", float, metavar="RETURN"),
        flag("--sampler", "what suggests settings (tpe)", default="tpe", choices=SAMPLERS),
        flag("--pruner", "whether hopeless trials end early", default="auto", choices=PRUNERS),
        flag("--n-startup-trials", "random trials before the sampler learns (10)", STARTUP, 10),
        flag("--search-space", "the values to choose from", Path, metavar="YAML"),
        flag("--seed", "seed of the search (0)", cli.whole_number(0, 2**32 - 1), 0),
        flag("--timeout", "begin no more runs after this time", seconds, math.inf, metavar="TIME"),
    ),
    "re-test": (
        flag("--retest", "settings to run again on other seeds (3)", cli.whole_number(0, 100), 3),
        flag("--retest-seeds", "how many other seeds (20)", SEEDS, 20),
        flag("--first-retest-seed", "the first of these (1000)", cli.FIRST_SEED, 1000),
        switch("--until-decided", "add seeds, at looks fixed before, until the best is decided"),
        flag("--max-retest-seeds", "the most other seeds for that (80)", SEEDS),
    ),
    "runs": (
        *shared("--n-timesteps", "--n-episodes"),
        *shared("--hyperparams", help="hyperparameters of every trial, which are not searched"),
        *shared("--engine"),
        *shared("--conf-file", help="start from another file's entry"),
        *shared("--env-kwargs", "--gym-packages"),
        flag("--eval-freq", "steps between two evaluations", cli.COUNT),
        flag("--eval-episodes", "episodes of a sampled evaluation (20)", cli.COUNT, 20),
        *shared("--jobs", "--cluster", "--run-timeout"),
    ),
    "output": (
        flag("--name --study-name", "name of the search's folder", cli.folder_name, metavar="NAME"),
        flag(FOLDER, "folder of all searches (logs/tuning)", default="logs/tuning"),
        switch("--no-report --no-optim-plots", "only tables: no figures and no page"),
        switch("-optimize --optimize-hyperparameters", argparse.SUPPRESS),  # rl_zoo3's
    ),
}


def build_parser() -> OneLineParser:
    """The flags; those of runs are as in train and compare, many others as in rl_zoo3."""
    words = "Search for an agent's hyperparameters: judge each setting over several seeds, run "
    words += "the best again on other seeds, and save a setting that is better there."
    return OneLineParser(words, EPILOG, FLAGS)


def tuning_spec(args: argparse.Namespace) -> TuningSpec:
    """The search that the arguments ask for."""
    cli.check_installed(True, "tuning", "tune", "optuna")
    study = compare.study_of([args.algo], [args.env])
    # The settings that the command line fixes.
    settings = cli.with_engine(args.algo, cli.typed_settings(args, "--hyperparams"), args.engine)
    agent = AgentSpec(SHIPPED, args.algo, settings, conf_file=args.conf_file)
    given = cli.given(args, (*OF_STUDY, "gym_packages"))
    study = replace(study, agents=(agent,), n_seeds=args.seeds_per_trial, **given)
    study = with_maps_named(study)
    title = f"{args.algo} on {study.environments[0].label}: a search for settings"
    # A flag with the name of a field sets that field.
    named = cli.given(args, (key.name for key in fields(TuningSpec)))
    tuning = TuningSpec(study=replace(study, title=title), **named)
    tuning.check()
    return tuning


# --- search and re-test ---------------------------------------------------------------------------


def main() -> int:
    """Parse the arguments, search and re-test; return the exit code."""
    args = build_parser().parse_args()
    from rl_yardstick.pipeline.run import Stop

    stop, deadline = Stop().listen(), time.monotonic() + args.timeout
    cli.import_typed(args)
    tuning = tuning_spec(args)
    root = Path(args.log_folder) / tuning.study.name
    workers = compare.workers_of(args, root, tuning.study.run_timeout)
    job = Job(root, cli.command_line(), table_console(), stop, workers, not args.no_report)
    return carry_out(job, tuning, deadline)


def carry_out(job: Job, tuning: TuningSpec, deadline: float) -> int:
    """Search until the deadline, and re-test; return the exit code."""
    job.console.print(tuning.study.title, style="bold")
    with job.console.status("loading the libraries"):
        from rl_yardstick.tuning.searching import open_search
    with held(job.root), job.workers:
        search = open_search(tuning, job.root)
        search.deadline = deadline
        print_opened(job, search)
        try:
            do_trials(job, search)
            print_search(job.console, search)
            return do_retest(job, search)
        except Stopped:
            say(job.console, "stopped; the same command continues the search")
            raise


def do_trials(job: Job, search: Search) -> None:
    """Do trials until there are enough; tell those that fail, and the best so far."""
    from rl_yardstick.experiments.pool import keep_busy, progress

    sign = 1 if search.tuning.is_cost else -1
    ended = [trial for trial in search.trials if trial.state.is_finished()]
    whole = [t.value for t in ended if t.state.name == "COMPLETE" and t.value is not None]
    best = min((sign * value for value in whole), default=math.inf)
    n_failed = 0
    with progress(job.console, search.tuning.n_trials - len(ended), "trials") as advance:

        def tell(number: int, value: float | None, failure: str) -> None:
            nonlocal best, n_failed
            if failure:
                n_failed += 1
                say(job.console, f"trial {number} failed: {failure}")
            elif value is not None and sign * value < best:
                best = sign * value
                say(job.console, f"trial {number}: {value:.4g}, the best so far")
            advance(n_failed)

        search.tell = tell
        keep_busy(job.workers, search.next_run, search.ended, job.command, job.stop)


def do_retest(job: Job, search: Search) -> int:
    """Run the best settings again, and write the winner; return the exit code."""
    from rl_yardstick.tuning.retesting import best_trials, chosen_for_retest, write_winner

    ranked, outcome, winner = best_trials(search.tuning, search.trials), None, None
    code = 0 if ranked or not search.is_done else 1
    if chosen := chosen_for_retest(search.tuning, ranked):
        code, outcome = retested(job, search, ranked, chosen)
        print_outcome(job.console, outcome)
        winner = write_winner(search, outcome)
    elif search.tuning.retest:
        say(job.console, "no re-test: no other setting came close to the shipped one")
    write_down(job, search, outcome, winner)
    if outcome is not None and outcome.winner is not None and winner is not None:
        print_winner(job.console, search, outcome.winner.number, winner)
    return code


def retested(
    job: Job, search: Search, ranked: list[FrozenTrial], chosen: list[FrozenTrial]
) -> tuple[int, Outcome]:
    """Do the re-test; return the exit code and the outcome."""
    from rl_yardstick.experiments.analysis import analyse
    from rl_yardstick.experiments.plan import StudyRecord, plan_of_looks, specs_of
    from rl_yardstick.tuning.retesting import FOLDER, concluded, is_settled, retest_study

    tuning, again = search.tuning, replace(job, root=job.root / FOLDER)
    study, most = retest_study(tuning, job.root, chosen), tuning.max_retest_seeds
    looks = plan_of_looks(study, again.root, most) if tuning.until_decided else ()
    record = StudyRecord(study, specs_of(study), looks)
    with held(again.root):
        results, _ = compare.finished(again, record, is_settled)
        code = compare.conclude(again, results, looks)
        with job.console.status("judging the winner"):
            return code, concluded(tuning, ranked, chosen, analyse(results, looks))


def write_down(job: Job, search: Search, outcome: Outcome | None, winner: Path | None) -> None:
    """Write the record of the search, and its page."""
    from rl_yardstick.tuning.retesting import FOLDER, RECORD, write_record

    record = write_record(search, outcome, job.command)
    files = [job.root / RECORD]
    if job.with_page:
        with job.console.status("writing the page"):
            from rl_yardstick.report.page.tuning import write_tuning_page

            page, retest = job.root / "report.html", f"{FOLDER}/report.html"
            retest = retest if (job.root / retest).exists() else ""
            write_tuning_page(record, page, retest, to_train(search.tuning, winner))
            files.append(page)
    say(job.console, f"files: {', '.join(map(str, files))}")


# --- output ---------------------------------------------------------------------------------------


def print_opened(job: Job, search: Search) -> None:
    """Print the number of trials, seeds and free settings."""
    from rl_yardstick.tuning.retesting import unproven_mark

    suggestions, tuning = search.suggestions, search.tuning
    n_there = sum(trial.state.is_finished() for trial in search.trials)
    words = f"{tuning.n_trials} trials of up to {len(tuning.seeds)} seeds, {n_there} of "
    words += f"them there already; {suggestions.n_free} settings to choose; {job.workers.words}"
    say(job.console, f"{words}, in {job.root}")
    if mark := unproven_mark(tuning):
        say(job.console, f"scores are{mark}")


def print_search(console: Console, search: Search) -> None:
    """Print the cost of the search, and whether several settings reach the optimum."""
    from rl_yardstick.tuning.searching import FAILURE, outcomes_of

    trials, n_runs = search.trials, search.tuning.n_trials * len(search.tuning.seeds)
    states = Counter(
        "failed" if FAILURE in trial.user_attrs else trial.state.name.lower() for trial in trials
    )
    runs = [run for trial in trials for run in outcomes_of(trial).values()]
    counts = ", ".join(f"{count} {state}" for state, count in states.items())
    spent = f"{sum(run.seconds for run in runs):,.0f} s of processor time"
    say(console, f"trials: {counts}; {len(runs)} of {n_runs} runs, {spent}")
    if (n := search.n_at_optimum) > 1:
        say(console, f"{n} settings have the optimum on all seeds: the fastest are the best")
        if search.is_saturated and not search.is_done:
            say(console, "the search ends here (--metric steps searches for the fastest)")


def print_outcome(console: Console, outcome: Outcome) -> None:
    """Print a line on each setting of the re-test, the optimism of the search, and why none won."""
    held_out = outcome.held_out
    say(console, f"\nsettings on the seeds {held_out.start} to {held_out.stop - 1}:")
    for each in outcome.retested:
        words = ["1 run" if each.n_runs == 1 else f"{each.n_runs} runs"]
        if each.held_out is not None and each.interval is not None:
            ends = f"{each.interval.low:.4g} to {each.interval.high:.4g}"
            words = [f"{each.held_out:.4g} (95 % interval of the mean: {ends})", *words]
        words += [f"{each.n_failed} failed"] if each.n_failed else []
        words += [f"in the search {each.in_search:.4g}"] if each.in_search is not None else []
        words += [f"against shipped: {each.verdict}"] if each.verdict else []
        say(console, f"  {each.label}: {', '.join(words)}")
    if outcome.optimism is not None:
        optimism = "optimism of the search, its best there less the same on other seeds"
        say(console, f"{optimism}: {round(outcome.optimism, 9) or 0.0:+.4g}")
    if outcome.winner is None:
        say(console, f"no winner: {outcome.reason}; they stay as they are")


def to_train(tuning: TuningSpec, winner: Path | None) -> str:
    """The command that trains with the winner, or with the shipped settings if nothing is typed."""
    words = ["--algo", tuning.agent.algo, "--env", tuning.environment.env_id]
    words += ["--gym-packages", *packages] if (packages := tuning.study.gym_packages) else []
    if path := winner or tuning.agent.conf_file:
        words += ["--conf-file", str(path)]
    return cli.to_copy("train", *words) if winner or not tuning.agent.settings else ""


def print_winner(console: Console, search: Search, number: int, path: Path) -> None:
    """Print how to train with the winner, and which of its settings differ from the shipped."""
    how = to_train(search.tuning, path)
    say(console, f"winner: trial {number}, in {path}; to train with it:\n  {how}")
    shipped, entry = search.suggestions.shipped, search.trials[number].user_attrs["settings"]
    for key in {**shipped, **entry}:
        before, now = (each.get(key, "left out") for each in (shipped, entry))
        if now != before:
            say(console, f"  {key}: {now} (was {before})")
