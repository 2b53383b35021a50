"""The interpreted loop works on arrays that share the memory of the policy's tables."""

import copy
import json
import pickle
import zipfile

import numpy as np
import pytest
import torch as th
from stable_baselines3.common.callbacks import BaseCallback

from agents.tabular.one_step import SARSA, DoubleQLearning, QLearning

STEPS = 300


class Meddler(BaseCallback):
    """Changes the tables in the middle of a training, in one of several ways."""

    def __init__(self, meddle):
        super().__init__()
        self.meddle = meddle
        self.kept = None

    def _on_step(self):
        if self.n_calls == STEPS // 2:
            self.kept = self.meddle(self.model)
        return True


def load_zeros(model):
    policy = model.get_parameters()["policy"]
    model.set_parameters({"policy": {name: th.zeros_like(policy[name]) for name in policy}})


def write_zeros(model):
    model.policy.q_tables.zero_()
    model.policy.visit_counts.zero_()


def trained(algorithm, callback=None, **kwargs):
    return algorithm(
        env="FrozenLake-v1", engine="interpreted", seed=0, initial_q=0.5, **kwargs
    ).learn(STEPS, callback=callback)


@pytest.mark.parametrize("algorithm", [QLearning, SARSA, DoubleQLearning])
@pytest.mark.parametrize("meddle", [load_zeros, write_zeros])
def test_tables_changed_from_outside_are_learnt_on(algorithm, meddle):
    model = trained(algorithm, Meddler(meddle))
    # The step on which they were changed is learnt from afterwards.
    assert int(model.policy.visit_counts.sum()) == STEPS // 2 + 1
    assert not np.array_equal(model.policy.q_table, trained(algorithm).policy.q_table)


@pytest.mark.parametrize(
    "duplicate", [copy.deepcopy, lambda model: pickle.loads(pickle.dumps(model))]
)
def test_a_copy_made_during_training_is_independent(duplicate):
    def copied(model):
        # Neither the environment nor the logger's open files belong into a copy.
        model.env, env = None, model.env
        model._logger, logger = None, model._logger
        try:
            return duplicate(model)
        finally:
            model.env, model._logger = env, logger

    callback = Meddler(copied)
    model = trained(QLearning, callback, exploration_decay="constant", exploration_initial_eps=0)
    twin = callback.kept
    assert int(twin.policy.visit_counts.sum()) == STEPS // 2 - 1
    assert int(model.policy.visit_counts.sum()) == STEPS
    # Exploring reads the tables through the same door as training does.
    twin.policy.q_tables.zero_()
    twin.policy.q_tables[0, :, 2] = 1.0
    assert twin.predict(np.arange(16), deterministic=False)[0].tolist() == [2] * 16


def test_nothing_of_it_is_saved(tmp_path):
    trained(QLearning, Meddler(lambda model: model.save(tmp_path / "during.zip")))
    assert int(QLearning.load(tmp_path / "during.zip").policy.visit_counts.sum()) < STEPS
    assert "_workspaces" not in json.loads(zipfile.ZipFile(tmp_path / "during.zip").read("data"))
