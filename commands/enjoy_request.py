"""From the arguments of ``enjoy.py`` to the model that they mean."""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import Literal

from pipeline.model_choice import ModelRequest
from pipeline.settings.literals import parse_assignments
from pipeline.user_modules import import_typed


def model_request(args: argparse.Namespace) -> ModelRequest:
    """The model that the arguments ask for.

    Raises:
        UserError: if a module of the user's cannot be imported, or the arguments of the environment
            cannot be read.
    """
    return ModelRequest(
        path=None if args.model is None else Path(args.model),
        algo=args.algo,
        env_id=args.env,
        log_folder=Path(args.folder),
        run_number=args.exp_id,
        which=_which(args),
        is_trusted=args.trust,
        env_kwargs=parse_assignments(args.env_kwargs),
        user_modules=import_typed(args.gym_packages, [args.env or ""]),
        seed=args.seed,
        device=args.device,
    )


def _which(args: argparse.Namespace) -> Literal["final", "best", "last checkpoint"] | int:
    if args.load_best:
        return "best"
    if args.load_checkpoint is not None:
        return int(args.load_checkpoint)
    return "last checkpoint" if args.load_last_checkpoint else "final"
