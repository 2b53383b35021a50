"""Exact evaluators of plain runs: where many share a process, the optimum is worked out once."""

from __future__ import annotations

from collections import OrderedDict

import gymnasium as gym

from pipeline.environments import evaluation_kwargs
from pipeline.evaluation.exact import ExactEvaluator, exact_evaluator
from pipeline.plain_runs import is_plain
from pipeline.train_spec import TrainSpec

MOST_KEPT = 8
# Arrays of a model that takes longer to work out are not small any more.
MOST_STATES = 20_000

_kept: OrderedDict[str, ExactEvaluator] = OrderedDict()


def evaluator_of(spec: TrainSpec) -> ExactEvaluator | None:
    """As `exact_evaluator`; that of plain runs on the same environment is the same object."""
    if not is_plain(spec):
        return exact_evaluator(spec)
    key = _key(spec)
    evaluator = _kept.pop(key, None) or exact_evaluator(spec)
    if evaluator is not None and evaluator.model.n_states <= MOST_STATES:
        _kept[key] = evaluator
        if len(_kept) > MOST_KEPT:
            _kept.popitem(last=False)
    return evaluator


def _key(spec: TrainSpec) -> str:
    """All that the environment of a plain run's evaluation is made from."""
    masks = spec.hyperparams.algorithm.get("mask_actions", False)
    kwargs = sorted(evaluation_kwargs(spec).items())
    return repr((gym.registry[spec.env_id], kwargs, masks))
