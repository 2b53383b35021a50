"""Maps of policies: by hand, against recomputation from the saved agents, and their limits."""

import numpy as np
import pytest
import torch as th
from rich.console import Console

from agents import load_algorithm
from mdp import policy_return
from pipeline.environments import make_training_env
from pipeline.evaluation import value_maps
from pipeline.evaluation.exact import exact_evaluator
from pipeline.evaluation.value_maps import ValueMapRecorder, map_refusal, value_map
from pipeline.models.load import load_model
from pipeline.settings.hyperparams import split
from pipeline.train_spec import TrainSpec
from pipeline.training import train

UP, DOWN, LEFT, RIGHT = range(4)
# The cells are 0 S, 1 free, 2 free; 3 free, 4 shelf, 5 goal.
CORNER = {"desc": ["S..", ".#G"], "max_episode_steps": 10}


def spec_of(env_id, algo="qlearning", n_timesteps=1, **fields):
    entry = {"n_timesteps": n_timesteps, **fields.pop("entry", {})}
    return TrainSpec(algo, env_id, split(entry), entry, seed=0, **fields)


def made(spec, name="qlearning", **kwargs):
    algorithm = load_algorithm(name)
    env = make_training_env(spec, None)
    return algorithm(next(iter(algorithm.policy_aliases)), env, seed=0, **kwargs)


def agent_that_does(spec, actions):
    agent = made(spec)
    agent.policy.q_tables[0] = th.from_numpy(np.eye(4)[actions])
    return agent


# --- one map -------------------------------------------------------------------------------------


def test_a_map_worked_by_hand():
    spec = spec_of("Warehouse-v0", entry={"env_kwargs": CORNER})
    # Right, left again; down onto the goal; up against the outer wall from below the start.
    agent = agent_that_does(spec, [RIGHT, LEFT, DOWN, LEFT, UP, UP])
    found = value_map(exact_evaluator(spec), agent)
    assert found.layout.rows == ("S..", ".#G")
    assert found.matters.tolist() == [True, True, True, True, False, False]
    assert found.initial.tolist() == [1, 0, 0, 0, 0, 0]
    assert found.actions[:4].tolist() == [RIGHT, LEFT, DOWN, LEFT]
    assert found.values.tolist() == [-10, -10, 100, -10, 0, 0]
    assert found.optimal_values.tolist() == [98, 99, 100, 97, 0, 0]
    assert found.optimal_actions[:4].tolist() == np.eye(4, dtype=bool)[[3, 3, 1, 0]].tolist()
    assert found.differs.tolist() == [False, True, False, True, False, False]
    assert found.visited.tolist() == [True, True, False, False, False, False]
    assert found.optimal_visited.tolist() == [True, True, True, False, False, False]


def test_an_action_among_several_best_ones_does_not_differ():
    square = {"desc": ["..G", "...", "S.."], "max_episode_steps": 20}
    spec = spec_of("Warehouse-v0", entry={"env_kwargs": square})
    for first in (UP, RIGHT):
        agent = agent_that_does(spec, [RIGHT, RIGHT, 0, RIGHT, RIGHT, UP, first, RIGHT, UP])
        found = value_map(exact_evaluator(spec), agent)
        assert not found.differs.any()
        assert found.values[6] == found.optimal_values[6] == 97
    assert found.optimal_actions[6].tolist() == [True, False, False, True]


@pytest.mark.parametrize(
    ("name", "kwargs"), [("dqn", {"buffer_size": 10}), ("ppo", {}), ("qlearning", {})]
)
def test_values_mean_the_same_for_tables_and_networks(name, kwargs):
    spec = spec_of("FrozenLake-v1")
    evaluator, agent = exact_evaluator(spec), made(spec, name, **kwargs)
    found = value_map(evaluator, agent)
    actions, _ = agent.predict(np.arange(16), deterministic=True)
    assert found.actions.tolist() == actions.tolist()
    earned = policy_return(evaluator.model, actions, evaluator.horizon).expected_return
    assert found.values[0] == pytest.approx(earned, abs=1e-12)
    assert evaluator(agent).mean_return == pytest.approx(earned, abs=1e-12)


def test_what_is_observed_does_not_matter():
    entry = {"env_kwargs": {"observation": "position"}}
    spec = spec_of("Warehouse-v0", entry=entry)
    agent = made(spec, "ppo")
    evaluator = exact_evaluator(spec)
    actions, _ = agent.predict(evaluator.observations, deterministic=True)
    assert value_map(evaluator, agent).actions.tolist() == actions.tolist()


@pytest.mark.parametrize("env_id", ["FrozenLake-v1", "MineMaze-v0", "CliffWalking-v1"])
def test_the_optimum_differs_nowhere(env_id):
    spec = spec_of(env_id, entry={"env_kwargs": {"max_episode_steps": 60}})
    agent = made(spec, "optimal")
    agent.plan()
    found = value_map(exact_evaluator(spec), agent)
    assert not found.differs.any()
    np.testing.assert_allclose(found.values, found.optimal_values, rtol=0, atol=1e-12)


@pytest.mark.parametrize(
    ("env_id", "env_kwargs", "agent"),
    [
        ("Taxi-v4", {}, "qlearning"),
        ("RandomWarehouse-v0", {"size": 51}, "qlearning"),
        ("Warehouse-v0", {}, "random"),
    ],
    ids=["no grid", "too large", "no one action"],
)
def test_where_there_is_no_map(env_id, env_kwargs, agent, tmp_path):
    spec = spec_of(env_id, entry={"env_kwargs": env_kwargs})
    evaluator = exact_evaluator(spec)
    assert value_map(evaluator, made(spec, agent)) is None
    too_large = "no value map: 2,601 states are too many to see, it has up to 2,500"
    assert map_refusal(evaluator) == (too_large if env_kwargs else None)
    recorder = ValueMapRecorder(tmp_path / "maps.npz", evaluator)
    recorder.record(made(spec, agent), 1)
    recorder.finish(made(spec, agent), 2)
    assert list(tmp_path.iterdir()) == []


# --- over the training ---------------------------------------------------------------------------


TINY_DQN = {
    "buffer_size": 500,
    "learning_starts": 50,
    "batch_size": 16,
    "train_freq": 1,
    "learning_rate": 0.01,
    "policy": "MlpPolicy",
    "policy_kwargs": {"net_arch": [8]},
}


@pytest.mark.parametrize(
    ("algo", "entry"),
    [
        ("qlearning", {"policy": "QTablePolicy", "learning_rate": 0.5}),
        ("dqn", {**TINY_DQN, "env_kwargs": {"slip": 0.2}}),
    ],
)
def test_a_run_keeps_the_maps_of_the_agents_that_it_saves(algo, entry, tmp_path):
    spec = spec_of(
        "Warehouse-v0",
        algo,
        n_timesteps=450,
        entry=entry,
        eval_freq=100,
        save_freq=100,
        log_folder=tmp_path,
        verbose=0,
    )
    run = train(spec, Console(quiet=True), {}, "").run
    with np.load(run.value_maps_path) as file:
        maps = dict(file)
    assert maps["timesteps"].tolist() == [100, 200, 300, 400, 450]
    evaluator = exact_evaluator(spec)
    paths = [*(run.checkpoint_path(n) for n in (100, 200, 300, 400)), run.model_path]
    for path, values, actions in zip(paths, maps["values"], maps["actions"], strict=True):
        found = value_map(evaluator, load_model(algo, path))
        np.testing.assert_array_equal(values, found.values)
        np.testing.assert_array_equal(actions, found.actions)
    np.testing.assert_array_equal(maps["optimal_values"], found.optimal_values)
    np.testing.assert_array_equal(maps["optimal_actions"], found.optimal_actions)
    assert maps["optimal_actions"].shape == (100, 4)
    # The agent did change, or there would be nothing to tell apart.
    assert len(np.unique(maps["values"], axis=0)) > 1
    # The values at the start are the evaluations.
    with np.load(run.evaluations_path) as evaluations:
        at_start = maps["values"][:-1] @ evaluator.model.initial
        np.testing.assert_allclose(at_start, evaluations["results"][:, 0], rtol=1e-12)
    assert run.value_map_path.read_bytes().startswith(b"\x89PNG")
    assert [path for path in run.path.iterdir() if path.name.endswith(".tmp")] == []


def test_without_evaluation_or_pictures_there_are_none(tmp_path):
    for fields, left in (({"eval_freq": -1}, set()), ({"pictures": False}, {"value_maps.npz"})):
        spec = spec_of(
            "FrozenLake-v1",
            n_timesteps=100,
            entry={"policy": "QTablePolicy"},
            log_folder=tmp_path,
            verbose=0,
            **fields,
        )
        run = train(spec, Console(quiet=True), {}, "").run
        assert {path.name for path in run.path.glob("value_map*")} == left


@pytest.fixture
def recorder(tmp_path):
    return ValueMapRecorder(tmp_path / "maps.npz", exact_evaluator(spec_of("FrozenLake-v1")))


def recorded(recorder: ValueMapRecorder) -> list[int]:
    with np.load(recorder.path) as file:
        return file["timesteps"].tolist()


def test_of_very_many_maps_every_second_is_kept(recorder, monkeypatch):
    monkeypatch.setattr(value_maps, "MAX_MAPS", 4)
    agent = made(spec_of("FrozenLake-v1"))
    for step, expected in [
        (40, [10, 20, 30, 40]),
        (50, [20, 40, 50]),
        (80, [20, 40, 60, 80]),
        (90, [40, 80, 90]),
        (170, [80, 160, 170]),
    ]:
        again = ValueMapRecorder(recorder.path, recorder.evaluator)
        for earlier in range(10, step + 1, 10):
            again.record(agent, earlier)
        again.finish(agent, step)
        assert recorded(again) == expected


def test_the_last_map_is_kept_once(recorder):
    agent = made(spec_of("FrozenLake-v1"))
    recorder.record(agent, 10)
    recorder.finish(agent, 10)
    assert recorded(recorder) == [10]
    recorder.finish(agent, 11)
    assert recorded(recorder) == [10, 11]


def test_the_file_is_written_no_more_than_once_in_a_while(recorder, monkeypatch):
    clock = [recorder._last_write]
    monkeypatch.setattr(value_maps.time, "monotonic", lambda: clock[0])
    agent = made(spec_of("FrozenLake-v1"))
    recorder.record(agent, 10)
    assert not recorder.path.exists()
    clock[0] += 1.1
    recorder.record(agent, 20)
    assert recorded(recorder) == [10, 20]
    clock[0] += 0.9
    recorder.record(agent, 30)
    assert recorded(recorder) == [10, 20]
    clock[0] += 0.2
    recorder.record(agent, 40)
    assert recorded(recorder) == [10, 20, 30, 40]
