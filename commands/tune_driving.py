"""One driver of a tuning, from the first trial to the file with the winner."""

from __future__ import annotations

import shlex
from functools import partial
from pathlib import Path

from rich.console import Console

from commands.parsing import called_as
from commands.places import give_way
from commands.study_output import conclude, do_missing, read, say
from commands.tune_how import How
from commands.tune_output import (
    print_engines,
    print_entry,
    print_opened,
    print_outcome,
    print_search,
    print_winner,
)
from commands.tune_progress import TuningProgress
from experiments.drafts import remove_dead_drafts
from experiments.early_results import EarlyResults
from experiments.study_plan import plan
from pipeline.folder_lock import FolderInUseError, folder_lock
from pipeline.signs_of_life import doing
from tuning.retesting import (
    FOLDER,
    RECORD,
    WINNER,
    Candidate,
    Outcome,
    best_trials,
    chosen_for_retest,
    concluded,
    retest_study,
    write_record,
    write_winner,
)
from tuning.searching import OpenTuning, Search


def drive(console: Console, place: OpenTuning, how: How) -> int:
    """Search, run the best again, and say what came of it; the exit code."""
    with place.queue:
        print_opened(console, place, how.place(place.root).words)
        print_engines(console, place)
        _search(console, place, how)
    print_search(console, place)
    try:
        return _judge(console, place, how)
    except FolderInUseError as error:
        say(console, f"another driver does the re-test: {error}")
        return 0


def _search(console: Console, place: OpenTuning, how: How) -> None:
    def ended() -> dict[int, float | None]:
        trials = [trial for trial in place.queue.trials() if trial.state.is_finished()]
        return {t.number: t.value if t.state.name == "COMPLETE" else None for t in trials}

    tuning, queue = place.tuning, place.queue
    if queue.is_done():
        return
    progress = TuningProgress(console, queue.n_trials, ended, is_cost=tuning.is_cost)
    with progress, progress.watching(how.place(place.root).launchers)() as launcher:
        Search(place, launcher, progress, how.deadline).run()
    if queue.is_done():
        remove_dead_drafts(place.root)  # of runs that nobody asks for any more


def _judge(console: Console, place: OpenTuning, how: How) -> int:
    """Run the best again, and write down what won."""
    tuning = place.tuning
    ranked = best_trials(place.queue.trials(), is_cost=tuning.is_cost)
    candidates = chosen_for_retest(ranked, tuning.retest)
    if not candidates:
        if tuning.retest:
            which = "no settings but the shipped ones" if ranked else "no settings"
            say(console, f"{which} were judged to the end: no re-test")
        _write_down(console, place, how, None)
        return 0 if ranked or not place.queue.is_done() else 1
    root = place.root / FOLDER
    tell = partial(say, console)
    with folder_lock(root, give_way, tell):
        code, outcome = _retested(console, place, how, ranked, candidates)
        winner = next((c for c in candidates if _is(c, outcome)), None)
        path = None
        if winner is None:
            (place.root / WINNER).unlink(missing_ok=True)  # of a search that has gone on since
        else:
            n_trials = place.queue.n_trials
            path = write_winner(tuning, place.root, outcome, winner.entry, n_trials)
        print_outcome(console, place, outcome)
        _write_down(console, place, how, outcome)
    if winner is not None and path is not None:
        print_winner(console, outcome, path, _use(place, path))
        print_entry(console, winner.entry, place.suggestions.shipped)
    return code


def _write_down(console: Console, place: OpenTuning, how: How, outcome: Outcome | None) -> None:
    """Write the record, and the page of it."""
    record = write_record(place, outcome, how.command)
    files = [place.root / RECORD]
    if how.with_page:
        with doing(console, "writing the page"):
            from report.tuning_page import write_tuning_page

            page, retest = place.root / "report.html", f"{FOLDER}/report.html"
            write_tuning_page(record, page, retest if (place.root / retest).exists() else "")
            files.append(page)
    say(console, f"files: {', '.join(map(str, files))}")


def _use(place: OpenTuning, path: Path) -> str:
    """How to train with what won."""
    tuning = place.tuning
    words = ["--algo", tuning.agent.algo, "--env", tuning.environment.env_id]
    return f"{called_as('train')} {shlex.join([*words, '--conf-file', str(path)])}"


def _is(candidate: Candidate, outcome: Outcome) -> bool:
    return outcome.winner is not None and outcome.winner.number == candidate.number


def _retested(
    console: Console,
    place: OpenTuning,
    how: How,
    ranked: list[Candidate],
    candidates: list[Candidate],
) -> tuple[int, Outcome]:
    """The exit code, and what the re-test shows."""
    from experiments.analysis import analyse
    from experiments.looking import take_looks

    root = place.root / FOLDER
    study = retest_study(place.tuning, place.root, candidates)
    planned = plan(study, root)
    how.place(root).get_ready(planned)
    early = EarlyResults(study)
    failures = do_missing(console, planned, root, how.place(root), early)
    results = read(console, study, planned, root, early)
    code = conclude(console, results, failures, how.command, with_page=how.with_page)
    with doing(console, "judging the winner") as activity:
        analysis = analyse(results, activity.at, take_looks(results))
        return code, concluded(place.tuning, ranked, candidates, analysis)
