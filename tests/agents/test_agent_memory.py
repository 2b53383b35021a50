"""What an agent on a table keeps beside it: in both loops, and in no model file."""

from typing import NamedTuple

import numpy as np
import pytest
from stable_baselines3.common.env_util import make_vec_env

from agents import load_algorithm
from agents.common.callbacks import BlockCallback
from agents.compiled.worlds import UNDECIDED
from agents.tabular.one_step import QLearning
from agents.tabular.updates import td_learning
from machine_code.compiling import inlined


class Footprints(NamedTuple):
    """How often each environment was in each state, shape (n_envs, S)."""

    visits: np.ndarray


@inlined
def learning_with_footprints(agent, envs, progress):
    """Q-learning that notes where it was, and is paid for having been there before."""
    for i in range(len(envs)):
        agent.memory.visits[i, envs[i].obs] += 1
        envs[i].reward += 0.001 * agent.memory.visits[i, envs[i].obs]
    td_learning(agent, envs, progress)


class Walker(QLearning):
    """An agent with a memory."""

    learn_from_step = learning_with_footprints

    def _make_memory(self):
        return Footprints(np.zeros((self.n_envs, int(self.observation_space.n)), dtype=np.int64))


class Change(BlockCallback):
    """Does something to the agent after 500 steps of each environment."""

    every_n_steps = 1000

    def __init__(self, change):
        super().__init__()
        self.change = change

    def _on_step(self):
        if self.num_timesteps == 1000:
            self.change(self.model)
        return True


def walker(engine="compiled", n_envs=2):
    return Walker(env=make_vec_env("FrozenLake-v1", n_envs, seed=3), seed=1, engine=engine)


def replaced(values):
    return Change(lambda model: setattr(model, "_memory", Footprints(values)))


@pytest.mark.parametrize("change", [None, lambda: replaced(np.zeros((2, 16), dtype=np.int64))])
def test_both_loops_work_on_it_in_place(change):
    compiled, interpreted = (
        walker(engine).learn(2000, callback=None if change is None else change())
        for engine in ("compiled", "interpreted")
    )
    assert compiled.engine_in_use == "compiled"
    assert np.array_equal(compiled._memory.visits, interpreted._memory.visits)
    # The step on which a callback acts is learnt from after it.
    share = 1000 if change is None else 501
    assert compiled._memory.visits.sum(axis=1).tolist() == [share, share]
    assert np.array_equal(compiled.policy.q_table, interpreted.policy.q_table)
    # Another training begins with nothing; one that goes on keeps it.
    assert compiled.learn(200)._memory.visits.sum() == 200
    assert compiled.learn(200, reset_num_timesteps=False)._memory.visits.sum() == 400


@pytest.mark.parametrize("engine", ["compiled", "interpreted"])
@pytest.mark.parametrize("values", [np.zeros((1, 16), dtype=np.int64), np.zeros((2, 16))])
def test_one_of_another_shape_is_refused(engine, values):
    wrong = r"visits must be of shape \(2, 16\) and int64, not \("
    with pytest.raises(ValueError, match=wrong):
        walker(engine).learn(2000, callback=replaced(values))


def test_one_of_another_kind_is_refused():
    model = walker()
    model._memory = (model._memory.visits,)
    with pytest.raises(ValueError, match="the agent's memory must be a Footprints"):
        model.predict(0)


def test_a_loaded_agent_begins_with_an_empty_one(tmp_path):
    walker().learn(100).save(tmp_path / "model")
    loaded = Walker.load(tmp_path / "model", make_vec_env("FrozenLake-v1", 3))
    assert loaded._memory.visits.shape == (3, 16)
    assert not loaded._memory.visits.any()
    assert loaded.learn(300)._memory.visits.sum(axis=1).tolist() == [100, 100, 100]


@pytest.mark.parametrize("name", ["sarsa", "monte_carlo", "actor_critic", "reinforce"])
def test_a_loaded_agent_goes_on_in_the_middle_of_episodes(name, tmp_path):
    env = make_vec_env("FrozenLake-v1", 2, seed=3)
    model = load_algorithm(name)(env=env, seed=1, engine="interpreted").learn(50)
    model.save(tmp_path / "model")
    loaded = load_algorithm(name).load(tmp_path / "model", env, force_reset=False)
    assert loaded._last_obs.tolist() == model._last_obs.tolist()
    # What compiled functions are handed has a row for each environment, before the first step too.
    if name == "actor_critic":
        assert loaded.compiled_agent(loaded.rng).memory.discounts.tolist() == [1.0, 1.0]
    elif name == "reinforce":
        assert loaded.compiled_agent(loaded.rng).memory.lengths.tolist() == [0, 0]
    assert loaded._next_actions.tolist() == [UNDECIDED, UNDECIDED]
    assert loaded.learn(50, reset_num_timesteps=False).num_timesteps == 100
