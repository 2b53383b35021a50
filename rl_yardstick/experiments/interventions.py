"""Measures the effect of changed settings over four seeds, as evidence for causes."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from hashlib import sha256
from itertools import count
from typing import Any

import numpy as np

from rl_yardstick.experiments.results import StudyResults
from rl_yardstick.experiments.study import AgentSpec, EnvironmentSpec, StudySpec, file_name, layered
from rl_yardstick.mdp.transition_model import Floats
from rl_yardstick.pipeline.arguments import arguments_of
from rl_yardstick.pipeline.files import plain
from rl_yardstick.pipeline.settings import parse_assignments, shipped_hyperparams
from rl_yardstick.pipeline.spec import TrainSpec

SEEDS = 4
SHIPPED, AS_IT_IS = "as shipped", "as it is"
_RANKS = {SHIPPED: 0, AS_IT_IS: 1}


@dataclass(frozen=True, eq=False)
class Tried:
    """A change and its results."""

    change: str  #: as typed, or ``"as it is"``
    returns: Floats  #: of the final policy by seed, NaN for runs that did not finish

    @property
    def finished(self) -> Floats:
        """The returns of the runs that finished."""
        return self.returns[~np.isnan(self.returns)]

    @property
    def mean(self) -> float:
        """The mean return of the runs that finished; -inf without one."""
        return float(self.finished.mean()) if len(self.finished) else -np.inf


def intervention_study(spec: TrainSpec, changes: Sequence[str], name: str) -> StudySpec:
    """Make a study of a run's agent, as shipped, unchanged and with each of the changes.

    Args:
        spec: the spec of the run.
        changes: each as ``key:value``, or several of these separated by spaces.
        name: the name of the run.

    Raises:
        UserError: if a change cannot be parsed.
    """
    own, shipped = spec.hyperparams, shipped_hyperparams(spec)
    settings = {
        change: layered(own, parse_assignments(change.split(), "--test")) for change in changes
    }
    first = dict([*settings.items()][:1])  # the likeliest change is trained first
    unchanged = {SHIPPED: shipped, AS_IT_IS: own}
    if {**own, "engine": None} == {**shipped, "engine": None}:
        unchanged = {f"{SHIPPED}, {AS_IT_IS}": own}
    labels: dict[str, str] = {}  # by folder, where some systems ignore case
    agents = []
    for change, values in {**first, **unchanged, **settings}.items():
        names = (change if n == 1 else f"{change} ({n})" for n in count(1))
        label = next(name for name in names if file_name(name).casefold() not in labels)
        labels[file_name(label).casefold()] = label
        agents.append(AgentSpec(label, spec.algo, _fast(spec.algo, values), tuned=False))
    # Two models of one name share a folder only if their settings are the same.
    digest = sha256(repr(sorted(plain(own).items())).encode()).hexdigest()[:8]
    environment = f"{spec.env_id} ({spec.map_name})" if spec.map_name else spec.env_id
    return StudySpec(
        name=file_name(f"explain_{name}_{digest}"),
        title=f"What helps {spec.algo} on {environment}",
        agents=tuple(agents),
        environments=(EnvironmentSpec(environment, spec.env_id, map_name=spec.map_name),),
        n_seeds=SEEDS,
        gym_packages=tuple(spec.gym_packages),
    )


def _fast(algo: str, settings: dict[str, Any]) -> dict[str, Any]:
    """The settings with compiled code if possible, unless they name an engine."""
    has_auto = "=auto" in arguments_of(algo).get("engine", ())
    return {"engine": "auto", **settings} if has_auto else settings


def tried(results: StudyResults) -> list[Tried]:
    """The results of each change: as shipped, as it is, then by falling mean return."""
    found = []
    for agent in results.study.agents:
        rows = results.summary[results.summary["agent"] == agent.label].set_index("seed")["final"]
        found.append(Tried(agent.label, rows.reindex(results.study.seeds).to_numpy(float)))
    by_return = sorted(found, key=lambda one: -one.mean)
    return sorted(by_return, key=lambda one: _RANKS.get(one.change.partition(",")[0], len(_RANKS)))
