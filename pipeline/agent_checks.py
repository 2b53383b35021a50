"""Whether there is such an agent, and whether it can work with an environment."""

from __future__ import annotations

from agents import ALGORITHMS, fitting_algorithms
from agents.algorithm_entries import is_bandit
from envs.action_masks import has_masks
from pipeline.environments import make_single_env
from pipeline.errors import UserError, unknown
from pipeline.train_spec import TrainSpec


def check_algorithm(algo: str) -> None:
    """Make sure that there is such an agent and that what it needs is installed.

    Raises:
        UserError: otherwise.
    """
    entry = ALGORITHMS.get(algo)
    if entry is None:
        raise unknown("unknown agent", algo, ALGORITHMS)
    if not entry.is_installed:
        raise UserError(
            f"{algo} needs {entry.package}, which is not installed: {entry.install_command}"
        )


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
