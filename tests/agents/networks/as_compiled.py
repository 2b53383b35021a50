"""Lets the library's agents draw the numbers that compiled code draws, in the same order."""

import numpy as np
import torch as th
from torch.distributions import Categorical


def draw_as_compiled(patch, model, rng):
    """Patch what the library draws from, so that this generator's numbers are drawn instead."""
    drawn, n_actions = [], int(model.action_space.n)

    def randint(low, high=None, size=None):
        if not drawn:
            limits = model.replay_buffer.size(), model.n_envs
            drawn.extend((rng.random((model.batch_size, 2)) * limits).astype(int).T)
        return drawn.pop(0)

    def permutation(n):
        numbers = np.arange(n)
        for i in range(n - 1, 0, -1):
            j = int(rng.random() * (i + 1))
            numbers[[i, j]] = numbers[[j, i]]
        # The library counts all steps of an environment before those of the next.
        return numbers % model.n_envs * model.n_steps + numbers // model.n_envs

    def sample(distribution):
        cumulative = distribution.probs.double().cumsum(dim=1).numpy()
        uniform = rng.random(len(cumulative))[:, np.newaxis]
        return th.as_tensor((cumulative[:, :-1] <= uniform).sum(axis=1))

    patch.setattr(np.random, "rand", rng.random)
    patch.setattr(np.random, "randint", randint)
    patch.setattr(np.random, "permutation", permutation)
    patch.setattr(Categorical, "sample", sample)
    patch.setattr(model.action_space, "sample", lambda: int(rng.random() * n_actions))
