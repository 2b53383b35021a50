"""From the arguments of ``enjoy.py`` to the model that they mean."""

from __future__ import annotations

import argparse
from pathlib import Path
from secrets import randbelow

from commands.parsing import check_device
from pipeline.errors import UserError
from pipeline.models.choose import ModelRequest
from pipeline.models.find import Which
from pipeline.settings.values import parse_assignments
from pipeline.user_modules import import_typed


def model_request(args: argparse.Namespace) -> ModelRequest:
    """The model that the arguments ask for.

    Raises:
        UserError: if a module of the user's cannot be imported, the arguments of the environment
            cannot be read, or there is no such device.
    """
    check_device(args.device)
    return ModelRequest(
        path=None if args.model is None else Path(args.model),
        algo=args.algo,
        env_id=args.env,
        log_folder=Path(args.folder),
        run_number=args.exp_id,
        which=_which(args),
        statistics=None if args.vec_normalize is None else Path(args.vec_normalize),
        env_kwargs=parse_assignments(args.env_kwargs, "--env-kwargs"),
        user_modules=import_typed(args.gym_packages, [args.env or ""]),
        seed=args.seed if args.seed >= 0 else randbelow(2**31),
        device=args.device,
    )


def check_playing(args: argparse.Namespace) -> None:
    """Refuse what cannot be done, in one line that says what can.

    Raises:
        UserError: if it is asked for.
    """
    if args.progress:
        raise UserError("-P: there is no bar; each episode is printed as it ends")
    if args.fps is not None and args.render != "ansi":
        raise UserError("--fps is the pace of --render ansi: give that too")
    if args.n_envs > 1 and (args.record is not None or args.render in ("human", "ansi")):
        flag = "--record" if args.record is not None else f"--render {args.render}"
        raise UserError(f"{flag} shows one environment: leave out --n-envs")


def _which(args: argparse.Namespace) -> Which:
    if args.load_best:
        return "best"
    if args.load_checkpoint is not None:
        return int(args.load_checkpoint)
    return "last checkpoint" if args.load_last_checkpoint else "final"
