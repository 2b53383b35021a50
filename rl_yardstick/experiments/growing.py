"""Studies that get more seeds until all pairs are decided.

The numbers of seeds of all looks are fixed before the first one, and kept in ``study.json``. All
looks are then computed from the scores: the result does not depend on how often somebody ran the
command.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path

from rl_yardstick.experiments.analysis import evidence_on, verdicts_on
from rl_yardstick.experiments.plan import RECORD, Labels, StudyRecord
from rl_yardstick.experiments.results import StudyResults
from rl_yardstick.experiments.study import StudySpec
from rl_yardstick.pipeline.errors import UserError
from rl_yardstick.verdicts import Study

MOST_SEEDS = 80

# The number of seeds, by labels of agent and environment.
Counts = dict[Labels, int]


def plan_of_looks(study: StudySpec, root: Path, most: int | None) -> tuple[int, ...]:
    """The seeds at each look of a study, as planned before or else now.

    Args:
        study: the study.
        root: its folder.
        most: the largest number of seeds of an agent; None: as planned before, or ``MOST_SEEDS``.

    Raises:
        UserError: if this differs from an earlier plan, or there is nothing to decide.
    """
    if len(study.agents) < 2:
        raise UserError(f"{study.name}: --until-decided takes two agents or more")
    if most is not None and most < study.n_seeds:
        raise UserError(f"--max-seeds is {most}, the study begins with {study.n_seeds} seeds")
    before = StudyRecord.read(root) if (root / RECORD).exists() else None
    if before is None or not before.looks:
        return look_sizes(study.n_seeds, max(most or MOST_SEEDS, study.n_seeds))
    looks = look_sizes(study.n_seeds, most or before.looks[-1])
    there, here = _fixed(before.study, before.looks), _fixed(study, looks)
    differences = [
        f"{key} {there[key]}, now {here[key]}" for key in there if there[key] != here[key]
    ]
    if differences:
        raise UserError(
            f"{root}: the looks were planned before the first of them and cannot change "
            f"({'; '.join(differences)}): --name NAME makes another study"
        )
    return looks


def _fixed(study: StudySpec, looks: tuple[int, ...]) -> dict[str, object]:
    """What must not change from one look to the next."""
    return {
        "looks": [*looks],
        "agents": sorted(agent.label for agent in study.agents),
        "environments": sorted(environment.label for environment in study.environments),
        **{name: getattr(study, name) for name in ("metric", "margin", "first_seed", "against")},
    }


def look_sizes(first: int, most: int) -> tuple[int, ...]:
    """The number of seeds of an agent at each look: twice as many as before, up to ``most``."""
    sizes = [first]
    while sizes[-1] < most:
        sizes.append(min(2 * sizes[-1], most))
    return tuple(sizes)


def first_counts(study: StudySpec) -> Counts:
    """The numbers of seeds at the first look."""
    return {(a.label, e.label): study.n_seeds for a in study.agents for e in study.environments}


def grown(study: StudySpec, counts: Mapping[Labels, int]) -> StudySpec:
    """The study with the largest number of seeds of any agent."""
    return replace(study, n_seeds=max(counts.values()))


def looked(results: StudyResults, looks: tuple[int, ...]) -> Study:
    """The verdicts after all looks that the runs allow."""
    found = [evidence_on(results, environment.label) for environment in results.study.environments]
    return verdicts_on(results.study, [one for one in found if one is not None], looks)


def next_counts(said: Study) -> Counts:
    """The numbers of seeds at the next look."""
    return {(agent, e): n for e, by in said.seeds.items() for agent, n in by.items()}
