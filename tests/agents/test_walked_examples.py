"""The agents that CONTRIBUTING.md writes, as they stand there."""

import importlib.util
import re
from pathlib import Path

import numpy as np
import pytest
from stable_baselines3.common.env_util import make_vec_env

import envs  # noqa: F401  # registers the bandits
from agents.bandits.runs import run_batch, run_one_by_one

DOCUMENT = Path(__file__).parents[2] / "CONTRIBUTING.md"
EXAMPLES = re.findall(r"```python\n(.*?)```", DOCUMENT.read_text(), re.DOTALL)
# An entry in the table of agents, and hyperparameters.
OTHER_LINES = 7


@pytest.fixture
def example(tmp_path):
    """The class of one of the examples, from a module of its own, and the module's lines."""

    def load(name):
        (code,) = [code for code in EXAMPLES if f"class {name}(" in code]
        path = tmp_path / f"example_{name.lower()}.py"
        path.write_text(code)
        spec = importlib.util.spec_from_file_location(path.stem, path)
        module = importlib.util.module_from_spec(spec)
        spec.loader.exec_module(module)
        return getattr(module, name), len(code.splitlines())

    return load


def test_a_tabular_rule(example):
    cautious, lines = example("CautiousQLearning")
    assert lines + OTHER_LINES <= 45
    tables = []
    for engine in ("compiled", "interpreted"):
        env = make_vec_env("FrozenLake-v1", 2, seed=3)
        model = cautious(env=env, seed=1, caution=0.4, engine=engine).learn(2000)
        assert model.engine_in_use.startswith(engine)
        tables.append(model.policy.q_tables.numpy().copy())
    assert np.array_equal(*tables)
    assert tables[0].any()
    with pytest.raises(ValueError, match="caution must lie between 0 and 1, not 2"):
        cautious(env="FrozenLake-v1", caution=2)


def test_a_rule_worked_by_hand(example):
    """Next values 4, 8, 6: half the mean 6 and half the best 8 make 7, and 2 + 0.5 * 7 is 5.5."""
    cautious, _ = example("CautiousQLearning")
    env = make_vec_env("Taxi-v4", 1, seed=0)
    model = cautious(env=env, caution=0.5, gamma=0.5, learning_rate=1.0, seed=0)
    values = model.policy.q_tables.numpy()
    values[0, 1] = [4, 8, 6, 6, 6, 6]
    model._last_obs, model._next_actions = np.array([0]), np.array([-1])
    from agents.common.algorithm import Transitions

    step = np.array([0]), np.array([3]), np.array([2.0]), np.array([False]), np.array([False])
    model._learn_from(Transitions(*step, np.array([1])))
    assert values[0, 0, 3] == 2 + 0.5 * (0.5 * 6 + 0.5 * 8)


def test_a_bandit_index(example):
    moss, lines = example("MOSS")
    assert lines + OTHER_LINES <= 30
    arguments = moss, {}, "BernoulliBandit-v0", {}, [0, 1], 200
    batch, single = run_batch(*arguments), run_one_by_one(*arguments)
    assert np.array_equal(batch.arms, single.arms)
    assert np.array_equal(batch.rewards, single.rewards)
    assert batch.optimal[:, 100:].mean() > 0.5
