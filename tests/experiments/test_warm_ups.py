"""What is compiled once for a study: rules of the user's own, and nothing else."""

import json
from dataclasses import replace

import pytest

import agents
from agents.tabular.algorithm import TabularAlgorithm
from experiments import run_in_child
from experiments.plan import plan
from experiments.study import AgentSpec, EnvironmentSpec, StudySpec
from machine_code.compiling import inlined
from pipeline.user_modules import UserModule


@inlined
def mean_value(agent, env, progress, table):
    """The mean value of the next actions."""
    return agent.room.values.mean()


class Mean(TabularAlgorithm):
    next_value = mean_value


class Other(agents.load_algorithm("dqn")):
    """One that is not compiled."""


MODULES = (UserModule("gymnasium", "gymnasium"),)


@pytest.fixture
def planned(tmp_path):
    before = dict(agents.ALGORITHMS)
    for cls in (Mean, Other):
        agents.register(cls.__name__.lower(), f"{__name__}:{cls.__name__}")
    algos, env_ids = ("mean", "other", "qlearning"), ("FrozenLake-v1", "Warehouse-v0")
    study = StudySpec(
        "s",
        "s",
        tuple(AgentSpec(algo, algo, {"n_episodes": 50}) for algo in algos),
        tuple(EnvironmentSpec(env_id, env_id) for env_id in env_ids),
        n_seeds=2,
        user_modules=MODULES,
    )
    yield plan(study, tmp_path)
    agents.ALGORITHMS.clear()
    agents.ALGORITHMS.update(before)


def test_each_rule_of_the_users_is_compiled_once_on_each_environment(planned, monkeypatch):
    trained = []
    monkeypatch.setattr(run_in_child, "train_aside", trained.append)
    run_in_child.take_steps(run_in_child.warm_ups(planned))
    assert [(spec.algo, spec.env_id) for spec in trained] == [
        ("mean", "FrozenLake-v1"),
        ("mean", "Warehouse-v0"),
    ]
    assert {spec.hyperparams.n_timesteps for spec in trained} == {run_in_child.N_STEPS}
    assert {spec.hyperparams.n_episodes for spec in trained} == {None}
    assert {spec.user_modules for spec in trained} == {MODULES}


def test_without_modules_of_the_users_there_is_nothing_to_do(planned, monkeypatch):
    bare = [replace(run, spec=replace(run.spec, user_modules=())) for run in planned]
    assert json.loads(run_in_child.warm_ups(bare)) == []
    monkeypatch.setattr(run_in_child, "MAX_CHARACTERS", 10)
    assert json.loads(run_in_child.warm_ups(planned)) == []


def test_what_fails_is_left_to_the_run():
    item = {"algo": "no_such", "env_id": "x", "hyperparams": {}, "modules": []}
    run_in_child.take_steps(json.dumps([item, {}]))
