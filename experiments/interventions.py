"""Measures the effect of changed settings over four seeds, as evidence for causes."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

from experiments.results import StudyResults
from experiments.study import AgentSpec, EnvironmentSpec, StudySpec, file_name, layered
from mdp.transition_model import Floats
from pipeline.agent_settings import with_engine
from pipeline.settings.values import parse_assignments
from pipeline.train_spec import TrainSpec

SEEDS = 4
AS_IT_IS = "as it is"
# Default factors for the step size and for the number of steps.
FACTORS = (0.25, 4)
MORE_TRAINING = 4
# Settings that keep the initial exploration during the whole training.
EXPLORES_ON = "exploration_fraction:1"


@dataclass(frozen=True, eq=False)
class Tried:
    """A change and its results."""

    change: str  #: as typed, or ``"as it is"``
    returns: Floats  #: of the final policies of finished runs, shape (n,)
    scores: Floats  #: on the yardstick's scale, NaN without one, shape (n,)


def usual_changes(spec: TrainSpec, proposal: str | None, n_steps: int) -> list[str]:
    """The default changes: the proposal first, then one setting at a time."""
    settings = spec.saved_hyperparams
    found = [proposal] if proposal else []
    if isinstance(settings.get("gamma"), int | float):
        found.append("gamma:auto")
    found.append(f"n_timesteps:{float(f'{MORE_TRAINING * n_steps:.2g}'):.0f}")
    rate = settings.get("learning_rate")
    if isinstance(rate, int | float):
        found += [f"learning_rate:{factor * rate:g}" for factor in FACTORS if factor * rate <= 1]
    if "exploration_final_eps" in settings:
        found += [EXPLORES_ON, "exploration_final_eps:0"]
    return list(dict.fromkeys(found))


def intervention_study(spec: TrainSpec, changes: Sequence[str], name: str) -> StudySpec:
    """Make a study of a run's agent, unchanged and with each of the changes.

    Args:
        spec: the spec of the run.
        changes: each as ``key:value``, or several of these separated by spaces.
        name: the name of the run.

    Raises:
        UserError: if a change cannot be parsed.
    """
    own = dict(spec.saved_hyperparams)
    read: Mapping[str, Mapping[str, Any]] = {
        change: parse_assignments(change.split(), "--test") for change in changes
    }
    settings = {AS_IT_IS: own} | {one: layered(own, change) for one, change in read.items()}
    agents = [
        AgentSpec(label, spec.algo, _fast(spec.algo, values), tuned=False)
        for label, values in settings.items()
    ]
    return StudySpec(
        name=file_name(f"explain_{name}"),
        title=f"What helps {spec.algo} on {spec.env_id}",
        agents=tuple(agents),
        environments=(EnvironmentSpec(spec.env_id, spec.env_id),),
        n_seeds=SEEDS,
        gym_packages=spec.gym_packages,
        user_modules=spec.user_modules,
    )


def _fast(algo: str, settings: dict[str, Any]) -> dict[str, Any]:
    """The settings with compiled code if possible, unless they name an engine."""
    return settings if "engine" in settings else with_engine(algo, settings, "auto")


def tried(results: StudyResults) -> list[Tried]:
    """The results of each change, highest mean return first."""
    table = results.summary
    found = []
    for agent in results.study.agents:
        rows = table[table["agent"] == agent.label]
        returns, scores = rows["final"].to_numpy(), rows["score"].to_numpy()
        found.append(Tried(agent.label, returns, scores))
    return sorted(found, key=lambda one: -one.returns.mean() if len(one.returns) else float("inf"))
