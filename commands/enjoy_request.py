"""From the arguments of ``enjoy.py`` to the model that they mean."""

from __future__ import annotations

import argparse
from pathlib import Path
from secrets import randbelow
from typing import Literal

from commands.parsing import check_device
from pipeline.model_choice import ModelRequest
from pipeline.settings.literals import parse_assignments


def model_request(args: argparse.Namespace) -> ModelRequest:
    """The model that the arguments ask for.

    Raises:
        UserError: if the arguments of the environment cannot be read, or there is no such device.
    """
    check_device(args.device)
    return ModelRequest(
        path=None if args.model is None else Path(args.model),
        algo=args.algo,
        env_id=args.env,
        log_folder=Path(args.folder),
        run_number=args.exp_id,
        which=_which(args),
        is_trusted=args.trust,
        env_kwargs=parse_assignments(args.env_kwargs, "--env-kwargs"),
        gym_packages=tuple(args.gym_packages),
        seed=args.seed if args.seed >= 0 else randbelow(2**31),
        device=args.device,
    )


def _which(args: argparse.Namespace) -> Literal["final", "best", "last checkpoint"] | int:
    if args.load_best:
        return "best"
    if args.load_checkpoint is not None:
        return int(args.load_checkpoint)
    return "last checkpoint" if args.load_last_checkpoint else "final"
