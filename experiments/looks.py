"""How often a study has been looked at, and what each look may spend of the error rate.

The promise is given for each environment: at most ``ALPHA`` of the studies say anything wrong
there. So looks are counted for each environment by itself.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field

from experiments.study_spec import StudySpec
from verdicts import level_of_look

ALPHA = 0.05  # of the studies, at most, say anything wrong on an environment


@dataclass(frozen=True)
class Question:
    """What the runs were asked; another question is another look at them.

    Attributes:
        metric: what verdicts are about.
        margin: difference within which agents are equivalent; None for the usual share of the way
            from the best random or constant policy to the optimum.
        threshold: return that counts as solved; None for the usual.
        first_seed: the first seed.
    """

    metric: str
    margin: float | None
    threshold: float | None
    first_seed: int


@dataclass(frozen=True)
class Look:
    """One look at the runs on an environment.

    Attributes:
        date: when it was, for readers.
        question: what was asked.
        seeds: by agent, with how many seeds.
        runs: by agent, of how many of them there was a figure.
        digests: by agent, of these figures.
        level: the error rate that it spent.
        planned: whether it is one of those that were settled before the first.
    """

    date: str
    question: Question
    seeds: Mapping[str, int]
    runs: Mapping[str, int]
    digests: Mapping[str, str]
    level: float
    planned: bool

    def shows(self, other: Look) -> bool:
        """Whether this look showed what another would: the same runs, or more of those seeds."""
        return (
            (self.question, dict(self.seeds)) == (other.question, dict(other.seeds))
            and self.runs.keys() == other.runs.keys()
            and all(self.runs[name] >= other.runs[name] for name in other.runs)
            and all(
                self.digests[name] == other.digests[name]
                for name in other.runs
                if self.runs[name] == other.runs[name]
            )
        )


@dataclass(frozen=True)
class Design:
    """Looks that were settled before the first of them: they share the level of one.

    Attributes:
        question: what is asked.
        sizes: how many seeds a growing agent has at each.
        seeds: by agent, how many it has, or is to get next.
        after: how many looks that are none of these there had been.
    """

    question: Question
    sizes: tuple[int, ...]
    seeds: Mapping[str, int]
    after: int

    @property
    def level(self) -> float:
        """The error rate of all of its looks together."""
        return level_of_look(ALPHA, self.after + 1)

    @property
    def share(self) -> float:
        """The error rate of each."""
        return level_of_look(self.level, 1, len(self.sizes))


@dataclass(frozen=True)
class Looks:
    """All looks at the runs on an environment.

    Attributes:
        taken: the looks, in the order of time.
        design: those that were settled beforehand; None where none were.
    """

    taken: tuple[Look, ...] = ()
    design: Design | None = None

    @property
    def planned(self) -> tuple[Look, ...]:
        """The looks of the design that have been taken."""
        return tuple(look for look in self.taken if look.planned)

    @property
    def next_level(self) -> float:
        """The error rate of the next look that nobody has settled."""
        return self._unplanned_level(self.taken)

    def level_at(self, place: int) -> float:
        """The error rate that the look at a place in ``taken`` may spend.

        Raises:
            ValueError: if it is a planned one, and nothing was planned.
        """
        if not self.taken[place].planned:
            return self._unplanned_level(self.taken[:place])
        if self.design is None:
            raise ValueError("no looks were settled")
        return self.design.share

    def _unplanned_level(self, before: Sequence[Look]) -> float:
        """That of a look after others: the design counts as one, whenever its looks are taken."""
        n_before = sum(not look.planned for look in before)
        with_design = self.design is not None and self.design.after <= n_before
        return level_of_look(ALPHA, n_before + with_design + 1)


@dataclass(frozen=True)
class LookLog:
    """The looks at a study, by environment."""

    environments: Mapping[str, Looks] = field(default_factory=dict)

    def on(self, environment: str) -> Looks:
        """Those at the runs on one environment."""
        return self.environments.get(environment, Looks())


@dataclass(frozen=True)
class Standing:
    """Where a look stands among all at the runs on an environment.

    Attributes:
        number: which look it is, counted from 1.
        level: its error rate.
        next_level: that of the next.
        design: the looks that it is one of, which were settled beforehand; None for one by itself.
        is_counted: False where there are too few runs to claim anything.
    """

    number: int = 1
    level: float = level_of_look(ALPHA, 1)
    next_level: float = level_of_look(ALPHA, 2)
    design: Design | None = None
    is_counted: bool = True


def question_of(study: StudySpec) -> Question:
    """What a study asks of its runs."""
    return Question(study.metric, study.margin, study.threshold, study.first_seed)
