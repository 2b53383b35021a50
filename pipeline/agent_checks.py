"""Whether there is such an agent, and whether it can work with an environment."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any, get_args

from agents import ALGORITHMS, fitting_algorithms, load_algorithm
from agents.algorithm_entries import is_bandit
from envs.action_masks import has_masks
from pipeline.environments import make_single_env
from pipeline.errors import UserError, unknown
from pipeline.settings.values import algorithm_parameters
from pipeline.train_spec import TrainSpec


def check_algorithm(algo: str) -> None:
    """Make sure that there is such an agent and that what it needs is installed.

    Raises:
        UserError: otherwise.
    """
    entry = ALGORITHMS.get(algo)
    if entry is None and algo.lower() == "her":
        raise UserError(
            "hindsight experience replay is no agent but a replay buffer, for environments with "
            "goals: --algo sac -params replay_buffer_class:HerReplayBuffer policy:MultiInputPolicy"
        )
    if entry is None:
        raise unknown("unknown agent", algo, ALGORITHMS)
    if not entry.is_installed:
        raise UserError(
            f"{algo} needs {entry.package}, which is not installed: {entry.install_command}"
        )


def with_engine(algo: str, settings: Mapping[str, Any], word: str | None) -> dict[str, Any]:
    """The typed settings of an agent, with what ``--engine`` says; None where it says nothing.

    Raises:
        UserError: if the settings say something else, or the agent has no such engine.
    """
    if word is None or algo not in ALGORITHMS:
        return dict(settings)
    said = settings.get("engine", word)
    if said != word:
        raise UserError(f"--engine {word} and -params engine:{said} disagree: give one of them")
    engines = _engines_of(algo)
    if len(engines) > 1 and word in engines:
        return {**settings, "engine": word}
    if len(engines) < 2 and word in ("auto", *engines):
        return dict(settings)
    has = (
        f"the engines {', '.join(engines)}" if len(engines) > 1 else "one engine, which auto means"
    )
    raise UserError(f"--engine {word}: {algo} has {has}")


def _engines_of(algo: str) -> Sequence[str]:
    """The engines of an agent; of one of the user's own, as its class has it."""
    entry = ALGORITHMS[algo]
    if entry.engines or entry.entry_point.startswith("agents."):
        return entry.engines
    parameter = algorithm_parameters(load_algorithm(algo)).get("engine")
    return () if parameter is None else get_args(parameter.annotation)


def check_fit(spec: TrainSpec) -> None:
    """Make sure that the agent can work with the environment as it is wrapped for it.

    Raises:
        UserError: if it cannot; it names the agents that could.
    """
    env = make_single_env(spec, training=True)
    misfit = ALGORITHMS[spec.algo].env_misfit(env)
    fitting = fitting_algorithms(
        env.observation_space, env.action_space, is_bandit(env), has_masks(env)
    )
    env.close()
    if misfit:
        others = f"fitting agents: {', '.join(fitting)}" if fitting else "no agent here fits"
        raise UserError(f"{spec.algo} does not fit {spec.env_id}: {misfit}; {others}")
