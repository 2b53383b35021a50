"""Takes and records looks at a study, and grows studies until all pairs are decided."""

from __future__ import annotations

import hashlib
import time
from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from experiments.analysis import Evidence, evidence_on
from experiments.looks import (
    Design,
    Look,
    LookLog,
    Looks,
    Question,
    Standing,
    question_of,
    read_looks,
    write_looks,
)
from experiments.results import StudyResults
from experiments.study import StudySpec
from mdp.transition_model import Floats
from pipeline.errors import UserError
from verdicts import Growth, grow, level_of_environment, look_sizes


def take_looks(results: StudyResults) -> dict[str, Standing]:
    """Take a look at the runs of a study, by environment, and record it before showing results.

    A repeated look at the same runs with the same question counts once.
    """
    log = read_looks(results.root)
    question, standings, environments = question_of(results.study), {}, dict(log)
    for environment in results.study.environments:
        evidence = evidence_on(results, environment.label)
        if evidence is not None:
            looks, standing = _taken(log.get(environment.label, Looks()), evidence, question)
            standings[environment.label] = standing
            if looks.taken:
                environments[environment.label] = looks
    remember(results.root, log, environments)
    return standings


def remember(root: Path, before: LookLog, after: LookLog) -> None:
    """Save the looks at a study, if there are new ones."""
    if after != before:
        write_looks(root, after)


def look_at(
    evidence: Evidence, seeds: Mapping[str, int], question: Question, level: float, *, planned: bool
) -> Look:
    """Make a look at the first seeds of each agent, with the current date."""
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
    """Whether there are too few runs for any claim at this level: then the look does not count."""
    there = sorted(int(np.isfinite(values).sum()) for values in evidence.scores.values())
    return len(there) < 2 or there[-2] < evidence.fewest(level)


def _digest(scores: Floats) -> str:
    """A digest of scores, rounded so that it is the same on every machine."""
    text = ",".join(f"{score:.9g}" for score in scores)
    return hashlib.sha256(text.encode()).hexdigest()[:16]


# --- Growing studies: their looks are planned before the first one.

MOST_SEEDS = 50

# The number of seeds, by labels of agent and environment.
Counts = dict[tuple[str, str], int]


@dataclass(frozen=True)
class Step:
    """The state of an environment after a look."""

    environment: str  # its label
    design: Design  # the planned looks, and each agent's current or next number of seeds
    growth: Growth  # the decisions so far
    standing: Standing  # the last look's place among all looks
    asked: list[tuple[str, str]]  # the pairs to decide

    @property
    def undecided(self) -> list[tuple[str, str]]:
        """The undecided pairs."""
        return [pair for pair in self.asked if not self.growth.judged[pair].is_decided]


def settled_looks(study: StudySpec, root: Path, most: int | None) -> LookLog:
    """The looks at a study with a design for all future looks, made now or earlier.

    Writes nothing: see `remember`.

    Args:
        study: the study.
        root: its folder.
        most: the largest number of seeds of an agent; None: as planned before, or ``MOST_SEEDS``.

    Raises:
        UserError: if this differs from an earlier design, or there is nothing to decide.
    """
    if len(study.agents) < 2:
        raise UserError(f"{study.name}: --until-decided takes two agents or more")
    if most is not None and most < study.n_seeds:
        raise UserError(f"--max-seeds is {most}, the study begins with {study.n_seeds} seeds")
    log = read_looks(root)
    environments = dict(log)
    for environment in study.environments:
        looks = log.get(environment.label, Looks())
        design = _settled(study, looks, most)
        if looks.design is not None:
            _check_same(root, looks.design, design)
            design = looks.design
        environments[environment.label] = replace(looks, design=design)
    return environments


def counts_of(study: StudySpec, log: LookLog) -> Counts:
    """The planned numbers of seeds of a study's agents."""
    return {
        (agent, environment.label): n
        for environment in study.environments
        if (design := log.get(environment.label, Looks()).design) is not None
        for agent, n in design.seeds.items()
    }


def first_counts(study: StudySpec, log: LookLog) -> Counts:
    """The numbers of seeds at the first planned look."""
    designs = {label: looks.design for label, looks in log.items() if looks.design is not None}
    return {(a.label, e): design.sizes[0] for e, design in designs.items() for a in study.agents}


def grown(study: StudySpec, counts: Mapping[tuple[str, str], int]) -> StudySpec:
    """The study with the largest number of seeds of any agent."""
    return replace(study, n_seeds=max(counts.values()))


def take_planned_looks(results: StudyResults) -> list[Step]:
    """Take the planned look at every environment, and record which agents get more seeds."""
    log = read_looks(results.root)
    environments, steps = dict(log), []
    for environment in results.study.environments:
        label, evidence = environment.label, evidence_on(results, environment.label)
        looks = log.get(label, Looks())
        if evidence is None or looks.design is None:
            continue
        _check_runs(results.root, looks, evidence)
        environments[label], step = _looked(looks, looks.design, evidence)
        steps.append(step)
    remember(results.root, log, environments)
    return steps


def _settled(study: StudySpec, looks: Looks, most: int | None) -> Design:
    """The design that the study asks for now."""
    after = sum(not look.planned for look in looks.taken)
    if looks.design is not None:
        after, most = looks.design.after, most or looks.design.sizes[-1]
    design = Design(question_of(study), (), {}, after)
    most = max(most or MOST_SEEDS, study.n_seeds)
    level = level_of_environment(design.level, len(study.environments))
    sizes = look_sizes(study.n_seeds, most, len(study.agents), level)
    return replace(design, sizes=sizes, seeds={agent.label: sizes[0] for agent in study.agents})


def _check_same(root: Path, there: Design, now: Design) -> None:
    """Refuse a design that differs from the earlier one, and name the difference."""
    differences = [
        f"{key} {before}, now {after}"
        for key, before, after in (
            ("agents", sorted(there.seeds), sorted(now.seeds)),
            ("looks at seeds", list(there.sizes), list(now.sizes)),
            *(
                (key, value, getattr(now.question, key))
                for key, value in vars(there.question).items()
            ),
        )
        if before != after
    ]
    if differences:
        raise UserError(
            f"{root}: the looks were fixed before the first of them and cannot change "
            f"({'; '.join(differences)}): --name NAME makes another study, and without "
            "--until-decided you can add seeds to this one by hand"
        )


def _check_runs(root: Path, looks: Looks, evidence: Evidence) -> None:
    """Refuse runs that were repeated after a look at them."""
    for there in looks.planned:
        now = look_at(evidence, there.seeds, there.question, there.level, planned=True)
        # Some runs may be missing now, or may have been missing then.
        same = [name for name, n in there.runs.items() if now.runs[name] == n]
        if any(now.digests[name] != there.digests[name] for name in same):
            raise UserError(
                f"{root}: on {evidence.environment}, runs have changed since they were looked at: "
                "--name NAME makes another study"
            )


def _looked(looks: Looks, design: Design, evidence: Evidence) -> tuple[Looks, Step]:
    growth = grow(
        evidence.given,
        design.sizes,
        evidence.margin,
        evidence.share(design.level),
        evidence.certain,
        ends=evidence.ends,
        paired=evidence.paired,
        against=evidence.against,
    )
    seeds = {name: max(n, design.seeds.get(name, 0)) for name, n in growth.seeds.items()}
    more = tuple(
        look_at(
            evidence,
            {name: min(n, size) for name, n in growth.seeds.items()},
            design.question,
            design.share,
            planned=True,
        )
        for size in design.sizes[len(looks.planned) : growth.n_looks]
    )
    design = replace(design, seeds=seeds)
    looks = Looks((*looks.taken, *more), design)
    number = max((k for k, each in enumerate(looks.taken, start=1) if each.planned), default=1)
    later = looks.next_level if growth.is_done else design.share
    standing = Standing(number, design.share, later, design)
    only = evidence.against
    asked = [pair for pair in growth.judged if not only or only in pair]
    return looks, Step(evidence.environment, design, growth, standing, asked)
