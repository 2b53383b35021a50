"""What a training of networks takes, in the library's loop and in compiled code.

For ``engine: auto`` this decides which of them runs. It goes by the settings alone, never by the
machine or by what has been compiled before: the two draw other random numbers, so the same settings
and the same seed must always choose the same one.
"""

from __future__ import annotations

import statistics
import time
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, Literal

import torch as th
from gymnasium import spaces
from torch import nn

from machine_code.cache import is_compiled_before

# Processor seconds, measured on one core with one thread; `machine_pace` compares other machines.
# Of the library's loop:
CALL = 0.3e-3  # choosing actions for all environments, and keeping what comes of them
ENV_STEP = 0.05e-3  # a step of one environment in Python, Monitor on
UPDATE = {"q": 0.8e-3, "policy": 1.0e-3}  # learning from a minibatch: so much in any case,
UPDATE_LAYER = {"q": 0.3e-3, "policy": 0.7e-3}  # for each layer,
UPDATE_WEIGHT = 2.2e-10  # and for each weight and row of the minibatch
# Of compiled code, the environment too:
COMPILED_STEP = 1.5e-6
COMPILED_ROW = 0.15e-6  # a row of a minibatch: so much in any case,
COMPILED_WEIGHT = 1.2e-10  # and for each weight, but those of one-hot observations
# Of compiled code with the environment in Python, for each call of it and in the environment:
BRIDGE_CALL = 0.05e-3
# Of compiling, once on a machine for all trainings of a kind.
COMPILING = 9.0

# What compiling must save, against the library's loop: as much as half of what it takes. Whoever
# trains a second time has it back then.
WORTH_COMPILING = 5.0
# Where a budget counts episodes, their length is guessed.
STEPS_OF_EPISODE = 100

PACE_AT_HOME = 3.9e-3  # of `machine_pace`'s work, where the others were measured


@dataclass(frozen=True)
class Work:
    """What a training does.

    Attributes:
        kind: ``"q"`` or ``"policy"``, which is a network of values too.
        n_steps: environment steps, over all environments.
        n_envs: environments at once.
        n_updates: minibatches that are learnt from.
        batch_size: rows of a minibatch.
        n_layers: of one network.
        n_weights: of all networks that learn.
        n_dense_weights: of them, those that are multiplied where observations are one-hot.
    """

    kind: Literal["q", "policy"]
    n_steps: float
    n_envs: int
    n_updates: float
    batch_size: float
    n_layers: int
    n_weights: int
    n_dense_weights: int

    @property
    def library_seconds(self) -> float:
        """Processor seconds in the library's loop."""
        update = UPDATE[self.kind] + UPDATE_LAYER[self.kind] * self.n_layers
        update += UPDATE_WEIGHT * self.batch_size * self.n_weights
        return self._n_calls * CALL + self.n_steps * ENV_STEP + self.n_updates * update

    @property
    def compiled_seconds(self) -> float:
        """The same in compiled code, without compiling."""
        row = COMPILED_ROW + COMPILED_WEIGHT * self.n_dense_weights
        step = COMPILED_STEP + COMPILED_WEIGHT * self.n_dense_weights
        return self.n_steps * step + self.n_updates * self.batch_size * row

    @property
    def bridged_seconds(self) -> float:
        """The same with the environment in Python."""
        in_python = self._n_calls * BRIDGE_CALL + self.n_steps * ENV_STEP
        return self.compiled_seconds + in_python

    @property
    def is_worth_compiling(self) -> bool:
        """Whether ``auto`` compiles it."""
        return self.library_seconds - self.compiled_seconds >= WORTH_COMPILING

    @property
    def _n_calls(self) -> float:
        return self.n_steps / self.n_envs


def work_of(
    kind: Literal["q", "policy"],
    networks: Sequence[nn.Module],
    observations: spaces.Space[Any],
    n_steps: float,
    n_envs: int,
    n_updates: float,
    batch_size: float,
) -> Work:
    """The work of perceptrons; other arguments are attributes of `Work`.

    Args:
        kind: of the agent.
        networks: that learn.
        observations: what they see.
        n_steps: likewise.
        n_envs: likewise.
        n_updates: likewise.
        batch_size: likewise.
    """
    linears = [[m for m in net.modules() if isinstance(m, nn.Linear)] for net in networks]
    n_weights = sum(layer.weight.numel() for layers in linears for layer in layers)
    is_one_hot = isinstance(observations, spaces.Discrete)
    by_number = sum(layers[0].weight.numel() for layers in linears if is_one_hot and layers)
    n_layers = max(len(layers) for layers in linears)
    return Work(
        kind, n_steps, n_envs, n_updates, batch_size, n_layers, n_weights, n_weights - by_number
    )


# The function whose machine code is there once a training of the kind has been compiled.
_LAST_COMPILED = {"q": "learn_from_minibatch", "policy": "learn_from_rollout_minibatch"}


def compiling_seconds(work: Work) -> float:
    """What compiling is still to take on this machine: nothing where its result is on the disk."""
    return 0.0 if is_compiled_before(_LAST_COMPILED[work.kind]) else COMPILING


def machine_pace() -> float:
    """How long this machine takes for what takes 1 where the constants were measured."""
    rows, weights = th.ones(64, 64), th.full((64, 64), 1 / 64)
    taken = []
    with th.no_grad():
        for _ in range(7):
            began = time.process_time()
            for _ in range(150):
                rows = th.tanh(rows @ weights) + 0.1
            taken.append(time.process_time() - began)
    return statistics.median(taken) / PACE_AT_HOME
