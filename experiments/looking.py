"""Taking a look at a study: which one it is, what it may spend, and that it is remembered."""

from __future__ import annotations

import hashlib
import time
from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path

import numpy as np

from experiments.evidence import Evidence, evidence_on
from experiments.looks import Look, LookLog, Looks, Question, Standing, question_of
from experiments.looks_file import read_looks, write_looks
from experiments.study_results import StudyResults
from mdp.array_types import Floats


def take_looks(results: StudyResults) -> dict[str, Standing]:
    """Look at the runs of a study, by environment, and remember it before anything is shown.

    The same runs and the same question are the same look, however often it is taken.
    """
    log = read_looks(results.root)
    question, standings, environments = question_of(results.study), {}, dict(log.environments)
    for environment in results.study.environments:
        evidence = evidence_on(results, environment.label)
        if evidence is not None:
            looks, standing = _taken(log.on(environment.label), evidence, question)
            standings[environment.label] = standing
            if looks.taken:
                environments[environment.label] = looks
    remember(results.root, log, LookLog(environments))
    return standings


def remember(root: Path, before: LookLog, after: LookLog) -> None:
    """Write the looks at a study down, if there are any that were not."""
    if after != before:
        write_looks(root, after)


def look_at(
    evidence: Evidence, seeds: Mapping[str, int], question: Question, level: float, *, planned: bool
) -> Look:
    """A look at the first seeds of each agent, now."""
    scores = {name: evidence.scores[name][:n] for name, n in seeds.items()}
    return Look(
        date=time.strftime("%Y-%m-%d %H:%M:%S"),
        question=question,
        seeds=dict(seeds),
        runs={name: int(np.isfinite(values).sum()) for name, values in scores.items()},
        digests={name: _digest(values) for name, values in scores.items()},
        level=level,
        planned=planned,
    )


def _taken(looks: Looks, evidence: Evidence, question: Question) -> tuple[Looks, Standing]:
    level = looks.next_level
    look = look_at(evidence, evidence.seeds, question, level, planned=False)
    for place, earlier in enumerate(looks.taken):
        if earlier.shows(look):
            return looks, Standing(place + 1, looks.level_at(place), level)
    if _says_nothing(evidence, level):
        return looks, Standing(len(looks.taken) + 1, level, level, is_counted=False)
    looks = replace(looks, taken=(*looks.taken, look))
    return looks, Standing(len(looks.taken), level, looks.next_level)


def _says_nothing(evidence: Evidence, level: float) -> bool:
    """Whether so few runs claim nothing at this level, whatever they score: that is no look."""
    there = sorted(int(np.isfinite(values).sum()) for values in evidence.scores.values())
    return len(there) < 2 or there[-2] < evidence.fewest(level)


def _digest(scores: Floats) -> str:
    """The same for the same scores, but for their last bits, on every machine."""
    text = ",".join(f"{score:.9g}" for score in scores)
    return hashlib.sha256(text.encode()).hexdigest()[:16]
