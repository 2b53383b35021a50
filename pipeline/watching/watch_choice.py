"""How the learning of an agent can be watched: step by step in its tables, or from far."""

from __future__ import annotations

from stable_baselines3.common.base_class import BaseAlgorithm

from agents.compiled.learning_algorithm import LearningAlgorithm
from pipeline.errors import UserError
from pipeline.evaluation.exact import ExactEvaluator
from pipeline.evaluation.value_maps import best_actions_of
from pipeline.train_spec import TrainSpec
from pipeline.watching.map_recorder import (
    EvaluationMaps,
    MapRecorder,
    UpdateMaps,
    can_be_mapped,
    tells_updates,
)
from pipeline.watching.table_recorder import MOST_ENTRIES, TableRecorder, tables_of

Watch = TableRecorder | MapRecorder


def watch_of(spec: TrainSpec, agent: BaseAlgorithm, exact: ExactEvaluator | None) -> Watch | None:
    """What records the learning; None where nobody asked for it.

    Args:
        spec: what is asked for.
        agent: the agent, before its training.
        exact: what evaluates it, where that is exact.

    Raises:
        UserError: if there is nothing to look at.
    """
    if spec.watch_learning is None:
        return None
    if isinstance(agent, LearningAlgorithm) and (tables := tables_of(agent)):
        n_entries = sum(table.size for table in tables.values())
        if n_entries > MOST_ENTRIES:
            raise UserError(
                f"--watch-learning shows tables of up to {MOST_ENTRIES:,} entries; those of "
                f"{spec.algo} on {spec.env_id} have {n_entries:,}"
            )
        is_known = exact is not None and can_be_mapped(exact)
        return TableRecorder(spec.watch_episodes, exact if is_known else None)
    if exact is None or not can_be_mapped(exact) or best_actions_of(exact, agent) is None:
        raise UserError(
            f"--watch-learning shows tables, or what an agent does in up to 2,500 known states: "
            f"{spec.algo} on {spec.env_id} has neither"
        )
    if spec.watch_episodes:
        raise UserError(
            f"--watch-episodes is for agents with tables: {spec.algo} is shown at each "
            f"{'update' if tells_updates(agent) else 'evaluation'}"
        )
    return UpdateMaps(exact) if tells_updates(agent) else EvaluationMaps(exact)
