"""From the arguments of ``train.py`` to a spec; mistakes are found before anything is created."""

from __future__ import annotations

import argparse
from dataclasses import fields
from pathlib import Path
from secrets import randbelow
from tempfile import TemporaryFile
from typing import Any

from commands.parsing import check_device, check_tensorboard
from pipeline.agent_checks import check_algorithm, check_fit, with_engine
from pipeline.auto_settings import resolved_spec, training_follows
from pipeline.environments import check_env_id, with_logs_located, with_maps_read
from pipeline.errors import UserError
from pipeline.settings.hyperparams import NoEntryError, override, read_hyperparams
from pipeline.settings.values import parse_assignments
from pipeline.train_spec import TrainSpec
from pipeline.user_modules import import_typed


def train_spec(args: argparse.Namespace) -> TrainSpec:
    """The spec that the arguments ask for.

    Raises:
        UserError: if it would not work out.
    """
    modules = import_typed(args.gym_packages, [args.env])
    check_algorithm(args.algo)
    check_env_id(args.env)
    check_tensorboard(args.tensorboard_log)
    check_device(args.device)
    raw, typed = _raw_hyperparams(args)
    raw = with_logs_located(args.env, with_maps_read(args.env, raw))
    trained_agent = None
    if args.trained_agent:
        from pipeline.models.choose import agent_to_continue

        trained_agent = agent_to_continue(Path(args.trained_agent))
    # A flag that has the name of a field goes there as it is.
    names = {key.name for key in fields(TrainSpec)} - {"hyperparams"}
    named = {name: getattr(args, name) for name in names if name in args}
    changed = {
        "env_id": args.env,
        "seed": args.seed if args.seed >= 0 else randbelow(2**31),
        "log_folder": Path(args.log_folder),
        "tensorboard_log": Path(args.tensorboard_log) if args.tensorboard_log else None,
        "trained_agent": trained_agent,
        "gym_packages": tuple(module.name for module in modules),
        "user_modules": modules,
        "unique_id": args.uuid,
        "final_episodes": args.eval_episodes,
        "watch_learning": _page_path(args),
    }
    spec = resolved_spec(raw, origins=typed, **{**named, **changed})
    if spec.hyperparams.n_timesteps is None and spec.hyperparams.n_episodes is None:
        raise UserError("how long to train? give -n STEPS or --n-episodes EPISODES")
    check_fit(spec)
    return spec


def _page_path(args: argparse.Namespace) -> Path | None:
    """Where the page is to be written that shows the learning; None where none is asked for."""
    if args.watch_learning is None:
        if args.watch_episodes:
            raise UserError("--watch-episodes says how much --watch-learning shows: give that too")
        return None
    path = Path(args.watch_learning)
    if path.suffix != ".html":
        raise UserError(f"--watch-learning writes a .html file, not {path.name!r}")
    if not path.absolute().parent.is_dir():
        raise UserError(f"--watch-learning: there is no folder {path.parent}")
    if path.is_dir():
        raise UserError(f"--watch-learning: {path} is a folder")
    try:
        TemporaryFile(dir=path.absolute().parent).close()
    except OSError as error:
        reason = f"nothing can be written in {path.parent}: {error.strerror}"
        raise UserError(f"--watch-learning: {reason}") from error
    return path


def _raw_hyperparams(args: argparse.Namespace) -> tuple[dict[str, Any], dict[str, str] | None]:
    """The file's entry for the environment, changed as the command line says; and what gave way."""
    asked = parse_assignments(args.hyperparams, "--hyperparams")
    changes = with_engine(args.algo, asked, args.engine)
    kwargs = parse_assignments(args.env_kwargs, "--env-kwargs") or changes.get("env_kwargs")
    try:
        entry = read_hyperparams(args.algo, args.env, args.conf_file, kwargs)
    except NoEntryError:
        if not changes:
            raise
        entry = {}
    typed: dict[str, Any] = {"env_kwargs": changes.get("env_kwargs")}
    for key, given in (("env_kwargs", args.env_kwargs), ("eval_env_kwargs", args.eval_env_kwargs)):
        if given:
            named = parse_assignments(given, f"--{key.replace('_', '-')}")
            in_params = changes.get(key)
            named = {**(in_params if isinstance(in_params, dict) else {}), **named}
            typed[key], changes[key] = named, {**(entry.get(key) or {}), **named}
    for key, budget in (("n_timesteps", args.n_timesteps), ("n_episodes", args.n_episodes)):
        if budget > 0:
            changes[key] = budget
    return training_follows(override(entry, changes), {**changes, **typed})
