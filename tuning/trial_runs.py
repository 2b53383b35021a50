"""The runs of a trial: one for each seed, in folders that equal settings share."""

from __future__ import annotations

import hashlib
from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

from experiments.plan import PlannedRun, check_settings, plan
from experiments.study import AgentSpec
from pipeline.files import json_text
from tuning.tuning_spec import TuningSpec


def name_of(entry: Mapping[str, Any]) -> str:
    """What settings are called: the same for the same, in whatever order they stand."""
    text = json_text({key: entry[key] for key in sorted(entry)})
    return f"settings-{hashlib.sha256(text.encode()).hexdigest()[:16]}"


def shipped_run(tuning: TuningSpec, root: Path) -> PlannedRun:
    """A run of the agent as it is without the search.

    Raises:
        UserError: if it cannot be trained so.
    """
    return plan(replace(tuning.study, n_seeds=1), root)[0]


def check_entry(tuning: TuningSpec, root: Path, entry: Mapping[str, Any]) -> None:
    """Make sure that the agent can be made with settings of the space.

    Raises:
        UserError: naming the setting, and what it must be.
    """
    where = "its space" if tuning.search_space is None else str(tuning.search_space)
    agent = replace(_agent(tuning, tuning.agent.algo, entry), where=where)
    study = replace(tuning.study, agents=(agent,), n_seeds=1)
    check_settings(study, plan(study, root))


def planned_run(tuning: TuningSpec, root: Path, entry: Mapping[str, Any], seed: int) -> PlannedRun:
    """One run of a trial.

    Raises:
        UserError: if an agent cannot be trained so.
    """
    agent = _agent(tuning, name_of(entry), entry)
    study = replace(tuning.study, agents=(agent,), first_seed=seed, n_seeds=1)
    (planned,) = plan(study, root)
    return planned


def _agent(tuning: TuningSpec, label: str, entry: Mapping[str, Any]) -> AgentSpec:
    return AgentSpec(label, tuning.agent.algo, tuning.searched(entry), tuned=False)
