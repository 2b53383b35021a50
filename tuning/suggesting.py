"""What a trial tries: the shipped settings first, then points of a grid or what a sampler says."""

from __future__ import annotations

import itertools
import json
import random
from collections.abc import Mapping
from functools import cached_property
from typing import TYPE_CHECKING, Any

from experiments.study import layered
from pipeline.errors import UserError
from tuning.tuning_spec import TuningSpec

if TYPE_CHECKING:
    from optuna import Trial

    from tuning.search_spaces import SearchSpace

# Values of each number in the finest grid there is.
MOST_VALUES = 100
# Of a product, so that one of many parameters is refused before it fills the memory.
MOST_POINTS = 1_000_000


class Suggestions:
    """Entries of hyperparameters by trial.

    Args:
        tuning: what is asked for.
        space: what may be chosen, as its file says.
        shipped: the entry as it is without the search, with what the user has fixed.

    Attributes:
        space: with the shipped settings inside.
        first: the parameters of these.
    """

    def __init__(self, tuning: TuningSpec, space: SearchSpace, shipped: Mapping[str, Any]) -> None:
        self.tuning, self.shipped = tuning, dict(shipped)
        self.space = space.including(self.shipped)
        self.first = self.space.params_of(self.shipped)
        self._fixed = self._settled()

    def _settled(self) -> dict[str, Any]:
        """Parameters of settings that the user has fixed."""
        given = set(self.tuning.agent.settings)
        settled: dict[str, Any] = {}
        for entry in self.space.entries.values():
            if set(entry.dimension.keys) <= given:
                names = entry.dimension.distributions()
                settled |= {name: self.first[name] for name in names if name in self.first}
        return settled

    @property
    def n_free(self) -> int:
        """How many parameters there are to choose."""
        return len(self.space.distributions().keys() - self._fixed.keys())

    @cached_property
    def grid(self) -> list[dict[str, Any]]:
        """The points of the finest grid that the trials allow, in an order of chance.

        Raises:
            UserError: if they allow none.
        """
        n_trials, found = self.tuning.n_trials - 1, self._points(2)
        if len(found) > n_trials:
            raise UserError(
                f"--sampler grid: {len(found):,} settings with two values of each number, beside "
                f"the shipped ones, and --trials says {self.tuning.n_trials:,}: give more trials "
                "or a smaller --search-space"
            )
        for n in range(3, MOST_VALUES + 1):
            finer = self._points(n)
            if not len(found) < len(finer) <= n_trials:
                break
            found = finer
        random.Random(self.tuning.seed).shuffle(found)  # noqa: S311  # an order, and no secret
        return found

    def _points(self, n: int) -> list[dict[str, Any]]:
        """What is asked for at each point, each once: some parameters exist under conditions."""
        from optuna.trial import FixedTrial

        values = {**self.space.grid(n), **{name: [v] for name, v in self._fixed.items()}}
        points: dict[str, dict[str, Any]] = {}
        for number, point in enumerate(itertools.product(*values.values())):
            if number >= MOST_POINTS:
                break
            trial = FixedTrial(dict(zip(values, point, strict=True)))
            self.space.suggest(trial)
            points[json.dumps(trial.params, sort_keys=True)] = trial.params
        return list(points.values())

    @property
    def n_trials(self) -> int:
        """How many trials there are to do: those of a grid are no more than its points."""
        if self.tuning.sampler == "grid":
            return min(self.tuning.n_trials, 1 + len(self.grid))
        return self.tuning.n_trials

    def params(self, number: int) -> dict[str, Any]:
        """Parameters of a trial that are settled before any sampler is asked."""
        if number == 0:
            return self.first
        if self.tuning.sampler == "grid":
            return self.grid[number - 1]
        return self._fixed

    def entry(self, trial: Trial) -> dict[str, Any]:
        """The hyperparameters that a trial is to run with."""
        suggested = self.space.suggest(trial)
        if trial.number == 0:
            return self.shipped
        return self.merged(suggested)

    def merged(self, suggested: Mapping[str, Any]) -> dict[str, Any]:
        """The hyperparameters with what is suggested, and what the user has fixed."""
        entry = self.space.merged(self.shipped, suggested)
        return layered(entry, self.tuning.agent.settings)
