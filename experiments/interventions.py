"""What a change to a run's settings does, over four seeds: the only ground for "because"."""

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
# Factors of the step size, and of the steps, that are tried where nothing is said.
FACTORS = (0.25, 4)
MORE_TRAINING = 4
# Settings of exploration: all of the training explores as in the beginning.
EXPLORES_ON = "exploration_fraction:1"


@dataclass(frozen=True, eq=False)
class Tried:
    """A change, and what comes of it."""

    change: str  #: as typed, or ``"as it is"``
    returns: Floats  #: of the final policies, shape (n,), of the runs that finished
    scores: Floats  #: on the scale of the yardstick, NaN where there is none, shape (n,)


def usual_changes(spec: TrainSpec, proposal: str | None, n_steps: int) -> list[str]:
    """What is tried where no change is named: the proposal first, then one setting at a time."""
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
    """The study of a run's agent as it is, and with each of the changes.

    Args:
        spec: of the run.
        changes: each as ``key:value``, several of them apart by spaces.
        name: of the run.

    Raises:
        UserError: for a change that cannot be read.
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
    """The settings on compiled code where that is possible, but for those that name an engine."""
    return settings if "engine" in settings else with_engine(algo, settings, "auto")


def tried(results: StudyResults) -> list[Tried]:
    """What came of each change, the highest mean return first."""
    table = results.summary
    found = []
    for agent in results.study.agents:
        rows = table[table["agent"] == agent.label]
        returns, scores = rows["final"].to_numpy(), rows["score"].to_numpy()
        found.append(Tried(agent.label, returns, scores))
    return sorted(found, key=lambda one: -one.returns.mean() if len(one.returns) else float("inf"))
