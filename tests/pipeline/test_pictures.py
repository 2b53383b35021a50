"""Maps of policies, by hand and against the agents that a run saves; its pictures."""

import json

import numpy as np
from matplotlib.figure import Figure

from pipeline import map_pictures as drawing
from pipeline.curve_pictures import read_monitors
from pipeline.environments import make_training_env
from pipeline.evaluation.exact import exact_evaluator
from pipeline.evaluation.value_maps import value_map
from pipeline.models.load import load_model
from tests.pipeline.short_runs import WAREHOUSE, agent_of, spec_of, trained

UP, DOWN, LEFT, RIGHT = range(4)
MINUS = "\N{MINUS SIGN}"
# The cells are 0 S, 1 free, 2 free; 3 free, 4 shelf, 5 goal.
CORNER = {"desc": ["S..", ".#G"], "max_episode_steps": 10}


def made(env_id, name="qlearning", env_kwargs=None):
    """An evaluator, and an agent that has learnt nothing."""
    spec = spec_of(name, env_id, {"env_kwargs": env_kwargs or {}})
    return exact_evaluator(spec), agent_of(name, make_training_env(spec, None))


def map_of(env_id, actions=(), **env_kwargs):
    """The map of a table that prefers these actions, and action 0 elsewhere."""
    evaluator, agent = made(env_id, env_kwargs=env_kwargs)
    agent.policy.q_tables[0, range(len(actions)), list(actions)] = 1.0
    return value_map(evaluator, agent)


# --- one map -------------------------------------------------------------------------------------

# Right, left again; down onto the goal; up against the outer wall from below the start.
THERE_AND_BACK = [RIGHT, LEFT, DOWN, LEFT, UP, UP]


def test_a_map_worked_by_hand():
    found = map_of(WAREHOUSE, THERE_AND_BACK, **CORNER)
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
    for first in (UP, RIGHT):
        actions = [RIGHT, RIGHT, 0, RIGHT, RIGHT, UP, first, RIGHT, UP]
        found = map_of(WAREHOUSE, actions, **square)
        assert not found.differs.any()
        assert found.values[6] == found.optimal_values[6] == 97
    assert found.optimal_actions[6].tolist() == [True, False, False, True]


# --- over the training ---------------------------------------------------------------------------


def test_a_run_keeps_the_maps_of_the_agents_that_it_saves(tmp_path):
    entry = {"learning_rate": 0.5, "env_kwargs": {"slip": 0.2}}
    kept = {"n_timesteps": 450, "eval_freq": 100, "save_freq": 100, "pictures": True}
    run = trained("qlearning", WAREHOUSE, entry, log_folder=tmp_path, **kept).run
    with np.load(run.value_maps_path) as file:
        maps = dict(file)
    assert maps["timesteps"].tolist() == [100, 200, 300, 400, 450]
    evaluator = exact_evaluator(spec_of("qlearning", WAREHOUSE, entry))
    paths = [*(run.checkpoint_path(n) for n in (100, 200, 300, 400)), run.model_path]
    for path, values, actions in zip(paths, maps["values"], maps["actions"], strict=True):
        found = value_map(evaluator, load_model("qlearning", path))
        np.testing.assert_array_equal(values, found.values)
        np.testing.assert_array_equal(actions, found.actions)
    np.testing.assert_array_equal(maps["optimal_values"], found.optimal_values)
    np.testing.assert_array_equal(maps["optimal_actions"], found.optimal_actions)
    # The agent did change, or there would be nothing to tell apart.
    assert len(np.unique(maps["values"], axis=0)) > 1
    with np.load(run.evaluations_path) as evaluations:
        at_start = maps["values"][:-1] @ evaluator.model.initial
        np.testing.assert_allclose(at_start, evaluations["results"][:, 0], rtol=1e-12)
    assert run.value_map_path.read_bytes().startswith(b"\x89PNG")


# --- the picture of a map ------------------------------------------------------------------------


def test_frames_and_arrows_are_what_the_map_says():
    """Frames where agent and optimum part; arrows where each of them goes."""
    policies = drawing.policies_in(map_of(WAREHOUSE, THERE_AND_BACK, **CORNER), 0)
    for policy in policies:
        axes = Figure().subplots()
        drawing.mark_differing(axes, policy, cell=36)
        centres = [segment[:4].mean(axis=0) for segment in axes.collections[-1].get_segments()]
        np.testing.assert_allclose(centres, [(1, 0), (0, 1)])  # columns across, rows down
    axes = Figure().subplots()
    drawing.draw_arrows(axes, policies[0], 0.08, with_numbers=False)
    # Middle and direction of every arrow, with how strong it is: dark where the agent comes to.
    arrows = [
        (round(x + u / 2, 6), round(y + v / 2, 6), np.sign(u), np.sign(v), quiver.get_alpha())
        for quiver in axes.collections
        for (x, y), u, v in zip(quiver.XY, quiver.U, quiver.V, strict=True)
    ]
    right, left = [(0, 0, 1, 0, 1.0), (0, 1, -1, 0, 0.45)], [(1, 0, -1, 0, 1.0), (2, 0, 0, 1, 0.45)]
    assert sorted(arrows) == right + left


# --- the learning curve --------------------------------------------------------------------------


def write_monitor(folder, name, rows, start=1000.0):
    header = json.dumps({"t_start": start, "env_id": "FrozenLake-v1"})
    lines = [f"#{header}", "r,l,t", *(",".join(map(str, row)) for row in rows)]
    (folder / f"{name}.monitor.csv").write_text("\n".join(lines) + "\n")


def test_the_episodes_of_several_environments_in_the_order_in_which_they_ended(tmp_path):
    assert [array.shape for array in read_monitors(tmp_path)] == [(0,), (0,)]
    # Three environments step together: the second one's first episode ends after 3 x 4 steps.
    write_monitor(tmp_path, 0, [(1, 10, 9.0), (2, 5, 9.5)])
    # Clocks do not count: processes start when they can.
    write_monitor(tmp_path, 1, [(3, 4, 0.1), (4, 8, 0.2)], start=2000.0)
    write_monitor(tmp_path, 2, [(5, 11, 50.0)], start=500.0)
    steps, returns = read_monitors(tmp_path)
    assert steps.tolist() == [12, 30, 33, 36, 45]
    assert returns.tolist() == [3, 1, 5, 4, 2]
