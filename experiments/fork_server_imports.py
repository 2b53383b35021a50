"""Imported by the server that runs are forked from, so that what takes long is done once.

Imports alone take two seconds, and loading the compiled loops half a second: a short training does
both. Where nothing is compiled yet, it is done here too.
"""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from tempfile import TemporaryDirectory

from rich.console import Console

from pipeline.settings.hyperparams import split
from pipeline.train_spec import TrainSpec
from pipeline.training import train


def _warm_up() -> None:
    raw = {"n_timesteps": 100}
    spec = TrainSpec("qlearning", "Warehouse-v0", split(raw), raw, 0, pictures=False)
    with TemporaryDirectory() as folder:
        train(replace(spec, log_folder=Path(folder)), Console(quiet=True), {}, "")


_warm_up()
