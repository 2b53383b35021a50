"""From the arguments of ``tune.py`` to a tuning."""

from __future__ import annotations

import argparse
import importlib.util
from pathlib import Path
from typing import Any

from agents import ALGORITHMS
from commands.flag_values import LONGEST_FOLDER_NAME
from experiments.study_spec import AgentSpec, EnvironmentSpec, StudySpec, file_name, layered
from pipeline.agent_checks import with_engine
from pipeline.environments import check_env_id
from pipeline.errors import UserError, unknown
from pipeline.run_files import environment_name
from pipeline.settings.literals import parse_assignments
from pipeline.user_modules import import_typed
from tuning.trial_storage import kind_of
from tuning.tuning_spec import AUTO, SHIPPED, TuningSpec

NEEDED = {"optuna": "tune"}


def tuning_spec(args: argparse.Namespace) -> TuningSpec:
    """The tuning that the arguments mean.

    Raises:
        UserError: if it could not be done so.
    """
    check_installed()
    modules = import_typed(args.gym_packages, [args.env])
    if args.algo not in ALGORITHMS:
        raise unknown("unknown agent", args.algo, ALGORITHMS)
    check_env_id(args.env)
    for flag, name in (("--conf-file", args.conf_file), ("--search-space", args.search_space)):
        if name is not None and not Path(name).is_file():
            raise UserError(f"{flag}: there is no file {name}")
    study = StudySpec(
        name=args.name
        or file_name(f"{environment_name(args.env)}_{args.algo}", LONGEST_FOLDER_NAME),
        title=f"{args.algo} on {args.env}: a search for settings",
        agents=(_agent(args),),
        environments=(EnvironmentSpec(args.env, args.env),),
        n_seeds=args.seeds_per_trial,
        first_seed=args.first_seed,
        eval_freq=args.eval_freq,
        eval_episodes=args.eval_episodes or StudySpec.eval_episodes,
        threshold=args.threshold,
        gym_packages=tuple(module.name for module in modules),
        user_modules=modules,
        run_timeout=args.run_timeout,
        run_memory=args.run_memory,
    )
    tuning = TuningSpec(
        study=study,
        n_trials=args.n_trials,
        figure=args.metric or AUTO,
        objective=args.objective,
        sampler=args.sampler,
        pruner=args.pruner,
        n_startup_trials=args.n_startup_trials,
        seed=args.seed,
        search_space=None if args.search_space is None else Path(args.search_space),
        retest=args.retest,
        retest_seeds=args.retest_seeds,
        first_retest_seed=args.first_retest_seed,
    )
    tuning.check()
    if args.storage is not None:
        kind_of(args.storage)
    return tuning


def check_installed() -> None:
    """Make sure that there is what searches.

    Raises:
        UserError: if it is not installed.
    """
    for module, extra in NEEDED.items():
        if importlib.util.find_spec(module) is None:
            raise UserError(f"tuning needs: pip install 'rl-yardstick[{extra}]'")


def _agent(args: argparse.Namespace) -> AgentSpec:
    """The agent with the settings that the command line fixes."""
    settings: dict[str, Any] = parse_assignments(args.hyperparams, "--hyperparams")
    if args.env_kwargs:
        named = {"env_kwargs": parse_assignments(args.env_kwargs, "--env-kwargs")}
        settings = layered(settings, named)
    if args.n_timesteps is not None and args.n_episodes is not None:
        raise UserError("how long to train? give -n or --n-episodes, not both")
    for key in ("n_timesteps", "n_episodes"):
        if getattr(args, key) is not None:
            settings[key] = getattr(args, key)
    conf_file = None if args.conf_file is None else Path(args.conf_file)
    settings = with_engine(args.algo, settings, args.engine)
    return AgentSpec(SHIPPED, args.algo, settings, conf_file=conf_file)
