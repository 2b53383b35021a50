"""From the arguments of ``train.py`` to a spec; mistakes are found before anything is created."""

from __future__ import annotations

import argparse
from pathlib import Path
from secrets import randbelow
from typing import Any

from agents import ALGORITHMS, fitting_algorithms
from agents.registry import is_bandit
from pipeline.environments import check_env_id, import_gym_packages, make_single_env
from pipeline.errors import UserError, unknown
from pipeline.settings import hyperparams
from pipeline.settings.literals import parse_assignments
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
            f"{algo} needs {entry.package}, which is not installed: "
            f"pip install 'rl-yardstick[{entry.extra}]'"
        )


def check_fit(spec: TrainSpec) -> None:
    """Make sure that the agent can work with the environment as it is wrapped for it.

    Raises:
        UserError: if it cannot; it names the agents that could.
    """
    env = make_single_env(spec, training=True)
    misfit = ALGORITHMS[spec.algo].env_misfit(env)
    fitting = fitting_algorithms(env.observation_space, env.action_space, is_bandit(env))
    env.close()
    if misfit:
        others = f"fitting agents: {', '.join(fitting)}" if fitting else "no agent here fits"
        raise UserError(f"{spec.algo} does not fit {spec.env_id}: {misfit}; {others}")


def train_spec(args: argparse.Namespace) -> TrainSpec:
    """The spec that the arguments ask for.

    Raises:
        UserError: if it would not work out.
    """
    check_algorithm(args.algo)
    import_gym_packages(tuple(args.gym_packages))
    check_env_id(args.env)
    raw = _raw_hyperparams(args)
    seed = args.seed if args.seed >= 0 else randbelow(2**31)
    trained_agent = Path(args.trained_agent) if args.trained_agent else None
    if trained_agent is not None:
        from pipeline.model_loading import check_model_file

        check_model_file(trained_agent)
    spec = TrainSpec(
        algo=args.algo,
        env_id=args.env,
        hyperparams=hyperparams.split(raw),
        saved_hyperparams=raw,
        seed=seed,
        eval_freq=args.eval_freq,
        eval_episodes=args.eval_episodes,
        n_eval_envs=args.n_eval_envs,
        save_freq=args.save_freq,
        log_folder=Path(args.log_folder),
        tensorboard_log=Path(args.tensorboard_log) if args.tensorboard_log else None,
        trained_agent=trained_agent,
        vec_env=args.vec_env,
        device=args.device,
        num_threads=args.num_threads,
        log_interval=args.log_interval,
        verbose=args.verbose,
        progress=args.progress,
        gym_packages=tuple(args.gym_packages),
        unique_id=args.uuid,
    )
    if spec.hyperparams.n_timesteps is None and spec.hyperparams.n_episodes is None:
        raise UserError("how long to train? give -n STEPS or --n-episodes EPISODES")
    check_fit(spec)
    return spec


def _raw_hyperparams(args: argparse.Namespace) -> dict[str, Any]:
    """The file's entry for the environment, with what the command line says put over it."""
    changes = parse_assignments(args.hyperparams, "--hyperparams")
    try:
        entry = hyperparams.read_hyperparams(args.algo, args.env, args.conf_file)
    except hyperparams.NoEntryError:
        if not changes:
            raise
        entry = {}
    for key, given in (("env_kwargs", args.env_kwargs), ("eval_env_kwargs", args.eval_env_kwargs)):
        if given:
            changes[key] = {**(entry.get(key) or {}), **parse_assignments(given)}
    for key, budget in (("n_timesteps", args.n_timesteps), ("n_episodes", args.n_episodes)):
        if budget > 0:
            changes[key] = budget
    return hyperparams.override(entry, changes)
