"""What ``compare.py --until-decided`` does: runs, a look, more runs, until all is decided."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from rich.console import Console

from commands.places import Place
from commands.study_output import conclude, do_missing, read, say
from experiments.growing import Counts, Step, counts_after, grown, take_planned_looks
from experiments.launching import EarlyResults, RunFailure
from experiments.plan import plan
from experiments.study import StudySpec
from report.wording import enumeration, seeds


def grow_study(
    console: Console,
    study: StudySpec,
    counts: Counts,
    root: Path,
    command: str,
    place: Place,
    *,
    with_page: bool = True,
) -> int:
    """Do a study with more and more seeds until every pair is decided, and judge it at the end.

    Args:
        console: where to.
        study: the study, as it begins.
        counts: how many seeds the agents are to have now.
        root: its folder, where the looks have been settled.
        command: the command that asked for it.
        place: where runs are done.
        with_page: draw the figures and write the page, beside the tables.

    Returns:
        The exit code, as of `run_study`.
    """
    failures: list[RunFailure] = []
    said: set[tuple[str, int]] = set()
    while True:
        now = grown(study, counts)
        planned = plan(now, root, counts)
        given_up = {failure.planned.path for failure in failures}
        early = EarlyResults(now)
        failures += do_missing(console, planned, root, place, early, given_up)
        results = read(console, now, planned, root, early)
        steps = take_planned_looks(results)
        for step in steps:
            if (step.environment, step.growth.n_looks) not in said:
                said.add((step.environment, step.growth.n_looks))
                say(console, _on_look(step))
        if all(step.growth.is_done for step in steps):
            break
        counts = counts_after(counts, steps)
    looks = {step.environment: step.standing for step in steps}
    code = conclude(
        console,
        results,
        failures,
        command,
        with_page=with_page,
        looks=looks,
        n_workers=place.n_workers,
    )
    say(console, _on_cost(counts, steps))
    return code


def _on_look(step: Step) -> str:
    """What a look has decided, and who gets more seeds."""
    growth, sizes = step.growth, step.design.sizes
    text = f"{step.environment}, look {growth.n_looks} of {len(sizes)}: "
    n, n_undecided = len(growth.judged), len(step.undecided)
    if not n_undecided:
        return f"{text}all pairs are decided"
    text += f"{n_undecided} of {n} pairs {'is' if n_undecided == 1 else 'are'} undecided"
    if growth.is_done:
        return text
    size = sizes[growth.n_looks]
    names = [name for name, wanted in growth.seeds.items() if wanted == size]
    return f"{text}; {enumeration(names)} {'goes' if len(names) == 1 else 'go'} on to {seeds(size)}"


def _on_cost(counts: Counts, steps: Sequence[Step]) -> str:
    """How many runs it took, beside a design that gives every agent all seeds."""
    n_runs = sum(counts.values())
    most = max((step.design.sizes[-1] for step in steps), default=0)
    text = f"{n_runs:,} runs, where {seeds(most)} of each agent would be {most * len(counts):,}"
    undecided = [
        f"{first} and {second} on {step.environment}"
        for step in steps
        for first, second in step.undecided
    ]
    return f"{text}; " + (f"undecided: {'; '.join(undecided)}" if undecided else "all is decided")
