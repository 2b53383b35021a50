"""A run in Weights & Biases, through its own integration of TensorBoard (``train.py --track``)."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

from rl_yardstick.pipeline.errors import as_user_error
from rl_yardstick.pipeline.run import Run
from rl_yardstick.pipeline.spec import TrainSpec


@contextmanager
def tracked(run: Run, spec: TrainSpec, where: dict[str, Any]) -> Iterator[None]:
    """Send what TensorBoard is told to Weights & Biases, until the block ends.

    Args:
        run: whose name and folder are used; ``WANDB_MODE=offline`` leaves the records there.
        spec: whose settings become the configuration.
        where: entity, project, group and tags of ``wandb.init``.

    Raises:
        UserError: if Weights & Biases refuses, e.g. without a key.
    """
    import wandb

    config = {"algo": spec.algo, "env": spec.env_id, "seed": spec.seed, **spec.hyperparams}
    with as_user_error("--track", wandb.Error):
        tracking = wandb.init(
            name=f"{spec.algo}/{run.path.name}",
            dir=run.path,
            config=config,
            sync_tensorboard=True,
            settings=wandb.Settings(console="off", silent=run.console.quiet),
            **where,
        )
    with tracking:
        yield
