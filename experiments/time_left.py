"""How long the runs of a study that are left may take, by the clock.

Agents differ a thousandfold in what a run takes, so each agent on each environment has an estimate
of its own: the mean of its runs that have ended, or else what it is expected to take, times how far
the expectations of like agents were off.
"""

from __future__ import annotations

from collections import Counter, deque
from collections.abc import Mapping, Sequence
from pathlib import Path

from experiments.planned_runs import PlannedRun
from pipeline.train_spec import FAMILIES, NETWORKS, TrainSpec

Key = tuple[str, str]

# Seconds of a run in any case, and for each step: of compiled agents with tables or weights, and of
# all others, of which nothing else is known.
EACH_RUN = 0.3
EACH_STEP, EACH_SLOW_STEP = 3e-7, 1e-3
# Where a budget counts episodes, their length is guessed.
STEPS_OF_EPISODE = 100
# A run that takes longer than was expected is expected to take so much of what it has taken.
LONGER = 1.2
# By how much what tables took may lengthen what is expected of networks.
BUSY = 4.0


def expected_seconds(spec: TrainSpec, processor_seconds: float | None = None) -> float | None:
    """What a run is expected to take; of networks the processor time may be known.

    None for an agent of the user's, which may be compiled or not.
    """
    if processor_seconds:
        return EACH_RUN + processor_seconds
    from agents import ALGORITHMS

    entry = ALGORITHMS.get(spec.algo)
    if entry is None or not (entry.package or entry.entry_point.startswith("agents.")):
        return None
    budget = spec.hyperparams
    steps = budget.n_timesteps or STEPS_OF_EPISODE * (budget.n_episodes or 1)
    is_fast = entry.family in {*FAMILIES, "bandits"}
    return EACH_RUN + steps * (EACH_STEP if is_fast else EACH_SLOW_STEP)


class TimeLeft:
    """Estimates when the last of some runs will have ended.

    Runs start in their order, one where another has ended: when each has begun need not be told.

    Args:
        runs: to be done, in this order.
        expected: seconds of a run by agent and environment, where something is known of them.
    """

    def __init__(self, runs: Sequence[PlannedRun], expected: Mapping[Key, float]) -> None:
        self._waiting = deque(runs)
        self._n_waiting = Counter((run.agent, run.environment) for run in runs)
        self._began: dict[Path, tuple[PlannedRun, float]] = {}
        self._algos = {(run.agent, run.environment): run.spec.algo for run in runs}
        self._expected = {
            key: expected.get(key) or expected_seconds(run.spec)
            for key, run in {(run.agent, run.environment): run for run in runs}.items()
        }
        self._taken: dict[Key, float] = {}
        self._n_taken: Counter[Key] = Counter()

    def start(self, now: float, n_workers: int) -> None:
        """Let runs begin, as many as there are free workers."""
        while self._waiting and len(self._began) < n_workers:
            run = self._waiting.popleft()
            self._n_waiting[run.agent, run.environment] -= 1
            self._began[run.path] = (run, now)

    def end(self, run: PlannedRun, now: float) -> None:
        """Count a run that has ended."""
        if run.path not in self._began:  # another has not begun instead
            if not (self._began and run in self._waiting):
                return
            path, (other, began) = next(iter(self._began.items()))
            self._waiting[self._waiting.index(run)] = other
            self._n_waiting[run.agent, run.environment] -= 1
            self._n_waiting[other.agent, other.environment] += 1
            del self._began[path]
            self._began[run.path] = (run, began)
        key = (run.agent, run.environment)
        self._taken[key] = self._taken.get(key, 0.0) + now - self._began.pop(run.path)[1]
        self._n_taken[key] += 1

    def seconds(self, now: float, n_workers: int) -> float | None:
        """How long all runs together may still take; None while that cannot be said."""
        each = self._estimates(now)
        missing = [*(key for key, _ in self._under_way()), *+self._n_waiting]
        if not each.keys() >= set(missing):
            return None
        under_way = [
            max(each[key] - (now - began), (LONGER - 1) * (now - began))
            for key, began in self._under_way()
        ]
        left = sum(under_way) + sum(each[key] * n for key, n in self._n_waiting.items())
        return max([left / max(n_workers, 1), *under_way])

    def _under_way(self) -> list[tuple[Key, float]]:
        return [((run.agent, run.environment), began) for run, began in self._began.values()]

    def _estimates(self, now: float) -> dict[Key, float]:
        """Seconds of a run, by agent and environment."""
        off = self._by_how_much_off(now)
        found = {}
        for key, expected in self._expected.items():
            if self._n_taken[key]:
                found[key] = self._taken[key] / self._n_taken[key]
                continue
            algo = self._algos[key]
            like = [ratio for other, ratio in off if other == algo] or [
                ratio for other, ratio in off if (other in NETWORKS) == (algo in NETWORKS)
            ]
            if not like:  # on a busy machine everything takes longer
                like = [min(max(ratio, 1.0), BUSY) for _, ratio in off]
            if expected is not None:
                found[key] = expected * (sum(like) / len(like) if like else 1.0)
        for key, began in self._under_way():
            if not self._n_taken[key] and key in found:
                found[key] = max(found[key], LONGER * (now - began))
        return found

    def _by_how_much_off(self, now: float) -> list[tuple[str, float]]:
        """Agents, and what their runs took by what they were expected to take."""
        off = [
            (self._algos[key], self._taken[key] / n / expected)
            for key, n in self._n_taken.items()
            if (expected := self._expected[key]) is not None
        ]
        known = {algo for algo, _ in off}
        late = [
            (self._algos[key], LONGER * (now - began) / expected)
            for key, began in self._under_way()
            if (expected := self._expected[key]) is not None
        ]
        return off + [(algo, ratio) for algo, ratio in late if ratio > 1 and algo not in known]
