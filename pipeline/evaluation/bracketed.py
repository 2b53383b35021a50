"""What sampled returns are measured against: a bracket for the optimum, where there is one."""

from __future__ import annotations

from envs.brackets.known_brackets import may_have_bracket, optimum_bracket
from pipeline.environments import make_single_env
from pipeline.evaluation.sampled import Yardstick
from pipeline.train_spec import TrainSpec


def bracketed_yardstick(spec: TrainSpec) -> Yardstick | None:
    """The bracket of the environment that a run is evaluated on, or None where none holds for it.

    Normalised and stacked observations make no difference. What a wrapper around all copies does,
    nobody knows.
    """
    if spec.hyperparams.vec_env_wrapper or not may_have_bracket(spec.env_id):
        return None
    env = make_single_env(spec)
    try:
        found = optimum_bracket(env)
    finally:
        env.close()
    if found is None:
        return None
    return Yardstick(found.upper, found.baseline, at_least=found.lower)
