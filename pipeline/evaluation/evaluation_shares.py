"""How many steps sampled evaluations may take, by what they cost beside the training."""

from __future__ import annotations

from typing import NamedTuple

from stable_baselines3 import A2C
from stable_baselines3.common.base_class import BaseAlgorithm

from pipeline.evaluation.policy_kinds import is_network


class Shares(NamedTuple):
    """Steps of evaluation for one of training.

    Attributes:
        usual: of any training.
        at_first: of the steps of short trainings, until that comes to `STEPS_AT_FIRST`.
    """

    usual: float
    at_first: float


# Chosen by how long a step of evaluation takes beside one of training, so that all of them take a
# fifth of its time or less. Figures: `benchmarks/evaluation_share.py`.
NETWORK = Shares(usual=1 / 4, at_first=1 / 2)
TABLE = Shares(usual=1 / 100, at_first=1 / 5)
# A2C learns once from each step, which takes no longer than to play one.
LIGHT_NETWORK = Shares(usual=1 / 10, at_first=1 / 10)
# Where training and evaluation are both compiled.
COMPILED_NETWORK = Shares(usual=1 / 4, at_first=1 / 2)
COMPILED_TABLE = Shares(usual=1 / 10, at_first=1 / 2)
# Compiled learning from environments in Python.
PYTHON_ENV = Shares(usual=1 / 32, at_first=1 / 6)
# Compiled training whose evaluation cannot be compiled.
NETWORK_ALONE = Shares(usual=1 / 32, at_first=1 / 32)
TABLE_ALONE = Shares(usual=1 / 2500, at_first=1 / 2500)
STEPS_AT_FIRST = 10_000
# A tenth of a second in most environments.
STEPS_IN_ANY_CASE = 2_000


def shares_of(model: BaseAlgorithm, *, plays_compiled: bool) -> Shares:
    """How many steps of evaluation go with the training of an agent.

    Args:
        model: the agent.
        plays_compiled: whether its evaluation runs in compiled code.
    """
    engine, learns_weights = getattr(model, "engine_in_use", "") or "", is_network(model)
    if engine.startswith("compiled but"):
        return PYTHON_ENV
    if not engine.startswith("compiled"):
        light = LIGHT_NETWORK if isinstance(model, A2C) else NETWORK
        return light if learns_weights else TABLE
    if plays_compiled:
        return COMPILED_NETWORK if learns_weights else COMPILED_TABLE
    return NETWORK_ALONE if learns_weights else TABLE_ALONE


def allowed_steps(n_trained: float, shares: Shares) -> float:
    """Steps that all evaluations of a training of so many may take."""
    at_first = min(shares.at_first * n_trained, STEPS_AT_FIRST)
    return max(shares.usual * n_trained, at_first, STEPS_IN_ANY_CASE)
