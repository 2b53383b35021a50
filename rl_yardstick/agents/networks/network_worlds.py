"""The observations of compiled environments, as inputs of networks."""

from __future__ import annotations

from typing import Any

import numpy as np

from rl_yardstick.agents.compiled.env_states import number_at, observe
from rl_yardstick.agents.networks.perceptron import Inputs
from rl_yardstick.machine_code.compiling import inlined


@inlined
def look(seen: Any, env: Any, moment: int, inputs: Inputs, one_hot: int) -> None:
    """Write the observation at this moment into the first row of a network's inputs."""
    if one_hot:
        inputs.indices[0] = number_at(env, moment)
    else:
        observe(seen, env, moment, inputs.vectors[0])


@inlined
def show(inputs: Inputs, i: int, row: Any, one_hot: int) -> None:
    """Write a row of a buffer into the i-th row of a network's inputs."""
    if one_hot:
        inputs.indices[i] = int(row[0])
    else:
        for j in range(len(row)):
            inputs.vectors[i, j] = np.float32(row[j])
