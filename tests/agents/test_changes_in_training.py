"""What callbacks change in the middle of a training counts from then on, in both loops alike."""

import functools

import numpy as np
import pytest
import torch as th
from stable_baselines3.common.env_util import make_vec_env
from stable_baselines3.common.utils import FloatSchedule

import envs  # noqa: F401  # registers the bandits
from agents import load_algorithm
from agents.common.callbacks import BlockCallback, Horizon, calls_until_multiple
from machine_code.compiling import inlined


class Change(BlockCallback):
    """Changes the agent once, half-way."""

    def __init__(self, change):
        super().__init__()
        self.change = change

    def horizon(self):
        return Horizon(calls=calls_until_multiple(self.n_calls, 1000))

    def _on_step(self):
        if self.n_calls == 1000:
            self.change(self.model)
        return True


def double_values(model):
    model.policy.q_tables = model.policy.q_tables * 2


def replace_by_loading(model):
    state = {name: value.clone() for name, value in model.policy.state_dict().items()}
    model.policy.load_state_dict(state, assign=True)


CHANGES = {
    "gamma": lambda model: setattr(model, "gamma", 0.3),
    "step size": lambda model: setattr(model, "lr_schedule", FloatSchedule(0.5)),
    "sample averages": lambda model: setattr(model, "learning_rate", "sample_average"),
    "epsilon": lambda model: setattr(model, "exploration_schedule", FloatSchedule(0.9)),
    "ties": lambda model: setattr(model, "tie_breaking", "first"),
    "generator": lambda model: setattr(model, "rng", np.random.default_rng(5)),
    "environment's generator": lambda model: setattr(
        model.env.envs[0].unwrapped, "np_random", np.random.default_rng(3)
    ),
    "tables": double_values,
    "tables of the same values": replace_by_loading,
}


def trained(name, engine, change=None, n_envs=1):
    env = make_vec_env("FrozenLake-v1", n_envs, seed=3)
    model = load_algorithm(name)(
        env=env, seed=1, engine=engine, exploration_decay="constant", exploration_initial_eps=0.3
    )
    callback = None if change is None else Change(change)
    return model.learn(2000 * n_envs, callback=callback).policy.q_table.copy()


@pytest.mark.parametrize("name", ["qlearning", "sarsa"])
@pytest.mark.parametrize("what", CHANGES)
def test_a_change_counts_in_both_loops(name, what):
    compiled, interpreted = (
        trained(name, engine, CHANGES[what]) for engine in ("compiled", "interpreted")
    )
    assert np.array_equal(compiled, interpreted)
    is_noticed = not np.array_equal(compiled, trained(name, "compiled"))
    assert is_noticed == (what != "tables of the same values")


@pytest.mark.parametrize("name", ["ucb", "thompson", "epsilon_greedy"])
def test_tables_of_a_bandit_that_are_replaced_go_on_learning(name):
    def replace(model):
        for buffer in ("scores", "sums", "counts"):
            setattr(model.policy, buffer, getattr(model.policy, buffer).clone())

    model = load_algorithm(name)(env=make_vec_env("BernoulliBandit-v0", seed=0), seed=0)
    model.learn(1500, callback=Change(replace))
    assert int(model.policy.counts.sum()) == 1500


def test_tables_of_another_shape_are_refused():
    model = load_algorithm("qlearning")(env="FrozenLake-v1", seed=0)
    model.policy.q_tables = th.zeros(1, 2, 4, dtype=th.float64)
    with pytest.raises(ValueError, match=r"tables must be 1 or 2, of shape \(1, 16, 4\), not"):
        model.learn(10)


def test_other_environments_than_it_was_made_for_are_refused():
    model = load_algorithm("qlearning")(env="FrozenLake-v1", seed=0)
    model.env = make_vec_env("FrozenLake-v1", 5)
    with pytest.raises(ValueError, match="the agent works on 1 environments, not 5"):
        model.learn(10)


def test_exploring_draws_from_a_generator_that_is_alive():
    """The schedule seeds the agent anew while an action is being chosen."""
    model = load_algorithm("qlearning")(env="FrozenLake-v1", seed=0, exploration="boltzmann")
    model.exploration_schedule = lambda _: (model.set_random_seed(5), 1.0)[1]
    model.set_random_seed(5)
    choices = [model.predict(np.zeros(9, int), deterministic=False)[0].tolist() for _ in range(20)]
    assert choices == [choices[0]] * 20


def test_what_a_loop_is_compiled_from_cannot_be_exchanged():
    @inlined
    def another(agent, env, progress, table):
        return 100.0

    with pytest.raises(AttributeError, match=r"QLearning\.next_value is compiled into its loop"):
        load_algorithm("qlearning").next_value = another


class Partial(load_algorithm("qlearning")):
    _learn_from = functools.partialmethod(lambda self, transitions: None)


class Moving(load_algorithm("qlearning")):
    gamma = property(lambda self: 0.5, lambda self, value: None)


class Described(load_algorithm("qlearning")):
    def __repr__(self):
        return "a name of its own"


@pytest.mark.parametrize(("algorithm", "name"), [(Partial, "_learn_from"), (Moving, "gamma")])
def test_what_python_does_instead_is_not_compiled_away(algorithm, name):
    model = algorithm(env="FrozenLake-v1", seed=0).learn(100)
    assert model.engine_in_use == (
        f"interpreted: {algorithm.__name__} has a {name} of its own in Python"
    )


def test_what_has_nothing_to_do_with_training_keeps_nothing_from_compiling():
    assert Described(env="FrozenLake-v1", seed=0).learn(100).engine_in_use == "compiled"
    model = load_algorithm("qlearning")(env="FrozenLake-v1", seed=0)
    model._learn_from = lambda transitions: None
    assert model.learn(100).engine_in_use == (
        "interpreted: this agent has a _learn_from of its own in Python"
    )


def test_arguments_that_nobody_declared_are_refused():
    with pytest.raises(TypeError, match="UCB has no argument 'policy_kwargs'"):
        load_algorithm("ucb")(env="BernoulliBandit-v0", policy_kwargs={})
    with pytest.raises(TypeError, match="QLearning has no argument 'gama'"):
        load_algorithm("qlearning")(env="FrozenLake-v1", gama=0.5)


class First:
    def __init__(self, *, first=1, **kwargs):
        super().__init__(**kwargs)
        self.first = first


class Second:
    def __init__(self, *, second=2, **kwargs):
        super().__init__(**kwargs)
        self.second = second


def test_mixins_may_come_before_the_algorithm():
    class Mixed(First, Second, load_algorithm("qlearning")):
        pass

    assert {"first", "second", "gamma", "seed"} <= set(Mixed.__signature__.parameters)
    model = Mixed(env="FrozenLake-v1", first=3, gamma=0.5, seed=0).learn(100)
    assert (model.first, model.second, model.gamma) == (3, 2, 0.5)
    assert model.engine_in_use == "compiled"
