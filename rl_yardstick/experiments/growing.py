"""Studies that get more seeds until all pairs are decided.

The numbers of seeds of all looks are fixed before the first one, and kept in a file of the study.
All looks are then computed from the scores: the result does not depend on how often somebody ran
the command.
"""

from __future__ import annotations

import json
from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

from rl_yardstick.experiments.analysis import evidence_on, verdicts_on
from rl_yardstick.experiments.results import StudyResults
from rl_yardstick.experiments.study import StudySpec
from rl_yardstick.pipeline.errors import UserError, one_line
from rl_yardstick.pipeline.files import write_json
from rl_yardstick.safe_files.files import UnsafeFileError, read_file
from rl_yardstick.verdicts import Study

MOST_SEEDS = 80
LOOKS_FILE = "looks.json"
_LARGEST = 1_000_000  # bytes

# The number of seeds, by labels of agent and environment.
Counts = dict[tuple[str, str], int]


def plan_of_looks(study: StudySpec, root: Path, most: int | None) -> dict[str, Any]:
    """The looks at a study, as planned before or else now, for its file. Writes nothing.

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
    before = _planned_before(root)
    if before and most is None:
        most = before["looks"][-1]
    looks = look_sizes(study.n_seeds, max(most or MOST_SEEDS, study.n_seeds))
    plan = {
        "looks": list(looks),
        "agents": sorted(agent.label for agent in study.agents),
        "environments": sorted(environment.label for environment in study.environments),
        "metric": study.metric,
        "margin": study.margin,
        "first_seed": study.first_seed,
        "against": study.against,
    }
    differences = [
        f"{key} {there}, now {plan[key]}" for key, there in before.items() if there != plan[key]
    ]
    if differences:
        raise UserError(
            f"{root}: the looks were planned before the first of them and cannot change "
            f"({'; '.join(differences)}): --name NAME makes another study"
        )
    return plan


def write_looks(root: Path, plan: Mapping[str, Any]) -> None:
    """Write the plan into the study's folder, before the first run."""
    write_json(root / LOOKS_FILE, plan)


def looks_of(root: Path) -> tuple[int, ...]:
    """The seeds at each look of a study that grows; empty for another study."""
    return tuple(_planned_before(root).get("looks", ()))


def _planned_before(root: Path) -> dict[str, Any]:
    """The plan in the study's folder; empty without one."""
    path = root / LOOKS_FILE
    try:
        plan = json.loads(read_file(path, _LARGEST))
        if not isinstance(plan["looks"][-1], int):
            raise TypeError("its looks are no numbers of seeds")
    except FileNotFoundError:
        return {}
    except (OSError, UnsafeFileError, ValueError, LookupError, TypeError, RecursionError) as error:
        raise UserError(
            f"{path} cannot be read ({one_line(error)}): remove it, and the looks are planned again"
        ) from error
    return dict(plan)


def look_sizes(first: int, most: int) -> tuple[int, ...]:
    """The number of seeds of an agent at each look: twice as many as before, up to ``most``."""
    sizes = [first]
    while sizes[-1] < most:
        sizes.append(min(2 * sizes[-1], most))
    return tuple(sizes)


def first_counts(study: StudySpec) -> Counts:
    """The numbers of seeds at the first look."""
    return {(a.label, e.label): study.n_seeds for a in study.agents for e in study.environments}


def grown(study: StudySpec, counts: Mapping[tuple[str, str], int]) -> StudySpec:
    """The study with the largest number of seeds of any agent."""
    return replace(study, n_seeds=max(counts.values()))


def looked(results: StudyResults, looks: tuple[int, ...]) -> Study:
    """The verdicts after all looks that the runs allow."""
    found = [evidence_on(results, environment.label) for environment in results.study.environments]
    return verdicts_on(results.study, [one for one in found if one is not None], looks)


def next_counts(said: Study) -> Counts:
    """The numbers of seeds at the next look."""
    return {(agent, e): n for e, by in said.seeds.items() for agent, n in by.items()}
