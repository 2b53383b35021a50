"""Maps of policies: by hand, against recomputation from the saved agents, and as pictures."""

import time

import numpy as np
import pytest
import torch as th
from matplotlib.colors import LinearSegmentedColormap, Normalize
from matplotlib.figure import Figure
from PIL import Image
from rich.console import Console

from agents import load_algorithm
from mdp import policy_return
from pipeline import map_pictures as drawing
from pipeline.environments import make_training_env
from pipeline.evaluation import value_maps
from pipeline.evaluation.exact import exact_evaluator
from pipeline.evaluation.value_maps import ValueMapRecorder, map_refusal, value_map
from pipeline.map_pictures import (
    decimals_for,
    draw_arrows,
    draw_ground,
    draw_numbers,
    draw_value_map,
    is_below,
    layer_name,
    mark_differing,
    policies_in,
    short_number,
    shown_layers,
)
from pipeline.models.load import load_model
from pipeline.settings.hyperparams import split
from pipeline.train_spec import TrainSpec
from pipeline.training import train

UP, DOWN, LEFT, RIGHT = range(4)
MINUS = "\N{MINUS SIGN}"
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
    ("name", "env_id", "entry"),
    [
        ("dqn", "FrozenLake-v1", {}),
        ("qlearning", "FrozenLake-v1", {}),
        ("ppo", "Warehouse-v0", {"env_kwargs": {"observation": "position"}}),
    ],
)
def test_values_mean_the_same_for_tables_and_networks_whatever_they_see(name, env_id, entry):
    spec = spec_of(env_id, entry=entry)
    evaluator = exact_evaluator(spec)
    agent = made(spec, name, **({"buffer_size": 10} if name == "dqn" else {}))
    found = value_map(evaluator, agent)
    actions, _ = agent.predict(evaluator.observations, deterministic=True)
    assert found.actions.tolist() == actions.tolist()
    earned = policy_return(evaluator.model, actions, evaluator.horizon).expected_return
    assert found.values @ evaluator.model.initial == pytest.approx(earned, abs=1e-9)
    assert evaluator(agent).mean_return == pytest.approx(earned, abs=1e-9)


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


TINY_DQN = {"buffer_size": 500, "learning_starts": 50, "batch_size": 16, "train_freq": 1}
TINY_DQN |= {"learning_rate": 0.01, "policy": "MlpPolicy", "policy_kwargs": {"net_arch": [8]}}
KEPT = {"eval_freq": 100, "save_freq": 100, "verbose": 0}


@pytest.mark.parametrize(
    ("algo", "entry"),
    [
        ("qlearning", {"policy": "QTablePolicy", "learning_rate": 0.5}),
        ("dqn", {**TINY_DQN, "env_kwargs": {"slip": 0.2}}),
    ],
)
def test_a_run_keeps_the_maps_of_the_agents_that_it_saves(algo, entry, tmp_path):
    spec = spec_of("Warehouse-v0", algo, 450, entry=entry, log_folder=tmp_path, **KEPT)
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
        fields |= {"entry": {"policy": "QTablePolicy"}, "log_folder": tmp_path, "verbose": 0}
        run = train(
            spec_of("FrozenLake-v1", n_timesteps=100, **fields), Console(quiet=True), {}, ""
        ).run
        assert {path.name for path in run.path.glob("value_map*")} == left


@pytest.fixture
def recorder(tmp_path):
    return ValueMapRecorder(tmp_path / "maps.npz", exact_evaluator(spec_of("FrozenLake-v1")))


def recorded(recorder):
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


def test_the_last_map_is_kept_once_and_the_file_written_once_in_a_while(recorder, monkeypatch):
    agent, clock = made(spec_of("FrozenLake-v1")), [time.monotonic()]
    monkeypatch.setattr(time, "monotonic", lambda: clock[0])
    for seconds, step, expected in (
        (1.1, 10, [10]),
        (0.9, 20, [10]),
        (0.2, 30, [10, 20, 30]),
        (0.0, 40, [10, 20, 30]),
    ):
        clock[0] += seconds
        recorder.record(agent, step)
        assert recorded(recorder) == expected
    for step, expected in ((40, [10, 20, 30, 40]), (41, [10, 20, 30, 40, 41])):
        recorder.finish(agent, step)
        assert recorded(recorder) == expected


# --- the picture ---------------------------------------------------------------------------------


def map_of(env_id, actions=None, **env_kwargs):
    """The map of a table that is zero, so that its policy is action 0, or of given actions."""
    entry = {"n_timesteps": 1, "env_kwargs": env_kwargs}
    spec = TrainSpec("qlearning", env_id, split(entry), entry, seed=0)
    agent = load_algorithm("qlearning")("QTablePolicy", make_training_env(spec, None), seed=0)
    if actions is not None:
        agent.policy.q_tables[0, range(len(actions)), actions] = 1.0
    return value_map(exact_evaluator(spec), agent)


@pytest.fixture
def corner():
    return policies_in(map_of("Warehouse-v0", [RIGHT, LEFT, DOWN, LEFT, UP, UP], **CORNER), 0)


@pytest.fixture
def axes():
    return Figure().subplots()


def test_frames_stand_where_agent_and_optimum_part(corner, axes):
    for policy in corner:
        mark_differing(axes, policy, cell=36)
        centres = [segment[:4].mean(axis=0) for segment in axes.collections[-1].get_segments()]
        # Columns across, rows down: cells 1 and 3.
        np.testing.assert_allclose(centres, [(1, 0), (0, 1)])


def test_what_is_worth_less_than_the_scale_shows_is_hatched(corner, axes):
    scale, colours = Normalize(97, 100), LinearSegmentedColormap.from_list("", ["blue", "red"])
    for policy, expected in zip(corner, ([(0, 0), (1, 0), (0, 1)], []), strict=True):
        draw_ground(axes, policy, scale, colours)
        hatched = axes.collections[-1]
        assert hatched.get_hatch() == "////"
        corners = [path.vertices.min(axis=0) + 0.5 for path in hatched.get_paths()]
        np.testing.assert_array_equal(np.reshape(corners, (-1, 2)), np.reshape(expected, (-1, 2)))
    # Of the optimum, whose lowest value is below the start and whose highest above the goal.
    ground = axes.collections[-2].get_array()
    assert ground[1, 0].tolist() == [0, 0, 1]
    assert ground[0, 2].tolist() == [1, 0, 0]


def test_rounding_is_not_below_the_scale():
    scale = Normalize(0.3, 0.7)
    values = np.array([0.3, 0.1 + 0.2 - 1e-15, 0.2999, 0.8])
    assert is_below(values, scale).tolist() == [False, False, True, False]


def arrows(axes):
    """Middle and direction of every arrow, with how strong it is."""
    return [
        (round(x + u / 2, 6), round(y + v / 2, 6), np.sign(u), np.sign(v), quiver.get_alpha())
        for quiver in axes.collections
        for (x, y), u, v in zip(quiver.XY, quiver.U, quiver.V, strict=True)
    ]


def test_arrows_show_what_is_done_and_where_the_agent_comes_to(corner, axes):
    draw_arrows(axes, corner[0], 0.08, with_numbers=False)
    assert sorted(arrows(axes)) == [
        (0, 0, 1, 0, 1.0),
        (0, 1, -1, 0, 0.45),
        (1, 0, -1, 0, 1.0),
        (2, 0, 0, 1, 0.45),
    ]


def test_numbers_are_the_values(corner, axes):
    numbers = (["-10", "-10", "100", "-10"], ["98", "99", "100", "97"])
    for policy, expected in zip(corner, numbers, strict=True):
        before = len(axes.texts)
        draw_numbers(axes, policy, 8, decimals=0)
        texts = [text.get_text() for text in axes.texts[before:]]
        assert texts == [text.replace("-", MINUS) for text in expected]
        places = [text.get_position() for text in axes.texts[before:]]
        assert [(x, round(y)) for x, y in places] == [(0, 0), (1, 0), (2, 0), (0, 1)]


@pytest.mark.parametrize(
    ("value", "decimals", "text"),
    [
        (79.0, 0, "79"),
        (-1000.0, 0, "-1000"),
        (0.744, 2, "0.74"),
        (-0.004, 2, "0.00"),
        (-0.006, 2, "-0.01"),
        (57.64, 1, "57.6"),
        (-718.7, 1, "-719"),
        (99.46, 1, "99.5"),
        (99.6, 2, "100"),
        (9999.4, 2, "9999"),
        (9999.6, 0, "10k"),
        (-27_427.0, 0, "-27k"),
        (999_499.0, 0, "999k"),
        (-999_500.0, 0, "-1.0M"),
        (0.0, 0, "0"),
    ],
)
def test_numbers_are_short(value, decimals, text):
    assert short_number(value, decimals) == text.replace("-", MINUS)


def test_whole_values_need_no_decimals():
    assert decimals_for(map_of("Warehouse-v0")) == 0
    assert decimals_for(map_of("Warehouse-v0", slip=0.1)) == 1
    assert decimals_for(map_of("FrozenLake-v1")) == 2


def test_of_a_maze_the_layers_are_drawn_that_somebody_comes_to():
    # Always up: the agent stays on the start, and the best way collects power.
    found = map_of("MineMaze-v0")
    assert shown_layers(found) == [0, 1]
    names = [layer_name(found.layout, layer) for layer in (0, 1, 5)]
    assert names == [
        "nothing collected",
        "power collected at row 2, column 4",
        "power collected at row 2, column 4; row 6, column 2",
    ]
    agent, optimum = policies_in(found, 1)
    assert optimum.visited[9]
    assert agent.matters[9]
    assert not policies_in(found, 0)[0].matters[9]


@pytest.mark.parametrize("desc", [["S..", ".#G"], ["S" + "." * 11, "." * 11 + "G"]])
def test_rows_and_columns_count_from_one_as_pages_and_advice_do(desc, monkeypatch, tmp_path):
    figures = []
    monkeypatch.setattr(drawing, "write_png", lambda figure, path: figures.append(figure))
    found = map_of("Warehouse-v0", desc=desc)
    draw_value_map(tmp_path / "map.png", "title", found)
    panel = figures[0].axes[0]
    goal = len(desc) * len(desc[0]) - 1
    shown = [
        dict(zip(axis.get_ticklocs().tolist(), texts, strict=True))
        for axis, texts in (
            (panel.yaxis, [text.get_text() for text in panel.get_yticklabels()]),
            (panel.xaxis, [text.get_text() for text in panel.get_xticklabels()]),
        )
    ]
    row, column = divmod(goal, len(desc[0]))
    expected = f"row {shown[0][row]}, column {shown[1][column]}"
    assert found.layout.place_name(goal) == expected == f"row 2, column {len(desc[0])}"


@pytest.mark.parametrize(
    ("env_id", "env_kwargs", "is_wide"),
    [
        ("Warehouse-v0", {}, True),
        ("Warehouse-v0", {"desc": ["SG"]}, False),
        ("RandomWarehouse-v0", {"size": 50}, True),
        ("MineMaze-v0", {}, False),
        ("FrozenLake-v1", {"map_name": "8x8"}, True),
    ],
)
def test_every_kind_of_map_can_be_drawn(env_id, env_kwargs, is_wide, tmp_path):
    draw_value_map(tmp_path / "map.png", "a title", map_of(env_id, **env_kwargs))
    with Image.open(tmp_path / "map.png") as image:
        image.load()
        assert image.format == "PNG"
        width, height = image.size
    assert (width > height) == is_wide
    assert max(width, height) < 2000
    assert [path.name for path in tmp_path.iterdir()] == ["map.png"]
