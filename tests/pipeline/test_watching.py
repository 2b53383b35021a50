"""What a person watching reads and sees of a training: maps, curves and progress."""

import io
import re

import numpy as np
import pytest
from rich.console import Console

from rl_yardstick.agents import load_algorithm
from rl_yardstick.pipeline import callbacks, pictures, watching
from rl_yardstick.pipeline.callbacks import ProgressCallback
from rl_yardstick.pipeline.environments import make_training_env
from rl_yardstick.pipeline.errors import UserError
from rl_yardstick.pipeline.evaluation.exact import exact_evaluator
from rl_yardstick.pipeline.evaluation.value_maps import value_map
from rl_yardstick.pipeline.pictures import read_monitors
from rl_yardstick.pipeline.watching import TERMINATED, TableRecorder
from tests.pipeline.short_runs import CART, LAKE, WAREHOUSE, agent_of, run_of, spec_of, trained


def watched_spec(algo="qlearning", settings=None, **fields):
    """Of a run that is watched, for a page that nobody writes."""
    fields = {"n_timesteps": 300, "seed": 3, "eval_episodes": 5, "final_episodes": 5, **fields}
    return spec_of(algo, entry=settings, **{"watch_learning": "page.html", **fields})


def watched(env, name="qlearning", n_timesteps=300, **settings):
    """An agent that was watched while it learnt, and what was kept."""
    recorder = TableRecorder(0)
    agent = load_algorithm(name)(env=env, seed=1, **settings).learn(n_timesteps, recorder)
    return agent, recorder


@pytest.mark.parametrize("engine", ["compiled", "interpreted"])
def test_targets_are_those_of_the_rule_to_the_last_bit(engine):
    agent, recorder = watched(LAKE, n_timesteps=2000, engine=engine, learning_rate=0.3)
    assert agent.engine_in_use.startswith(engine)
    table = recorder.initial["q_tables"].copy()[0]
    changes = {row["step"]: row for row in recorder.rows()["changes"]}
    assert len(changes) == recorder.n_changes  # one entry at a time
    for move in recorder.rows()["moves"]:
        follows = 0.0 if move["end"] == TERMINATED else 0.99 * table[move["next_obs"]].max()
        assert move["target"] == move["reward"] + follows
        at = move["obs"], move["action"]
        assert move["td_error"] == move["target"] - table[at]
        after = table[at] + 0.3 * move["td_error"]
        if after != table[at]:
            change = changes[move["step"]]
            assert (change["entry"], change["after"]) == (at[0] * 4 + at[1], after)
            table[at] = after
    assert np.array_equal(table, agent.policy.q_table)
    assert table.any()


@pytest.mark.parametrize("name", ["double_qlearning", "dyna_q"])
def test_tables_with_a_number_for_each_action_come_first(name):
    _, recorder = watched(LAKE, name, engine="interpreted")
    assert next(iter(recorder.initial)) == "q_tables"
    assert recorder.has_actions


SMALL_PPO = {"n_steps": 32, "batch_size": 32}


def test_of_a_network_there_is_a_map_at_each_evaluation(tmp_path):
    _, outcome = run_of(watched_spec("ppo", SMALL_PPO, eval_freq=50), tmp_path)
    numbers, timesteps, values, _ = zip(*outcome.watch.moments, strict=True)
    assert timesteps == (50, 100, 150, 200, 250, 300, 320)
    assert numbers == (1, 2, 3, 4, 5, 6, 6)
    # What the start is worth at the end is the return that was computed of the final agent.
    at_start = values[-1] @ outcome.watch.evaluator.model.initial
    assert at_start == pytest.approx(outcome.final.mean_return, abs=1e-12)


def test_what_cannot_be_shown_is_refused_before_anything_is_trained(tmp_path, monkeypatch):
    small = {"learning_starts": 50, "buffer_size": 200}
    with pytest.raises(UserError, match="dqn on CartPole-v1 has neither"):
        run_of(watched_spec("dqn", small, env_id=CART), tmp_path / "logs")
    with pytest.raises(UserError, match="--watch-episodes is for agents with tables: dqn"):
        run_of(watched_spec("dqn", small, watch_episodes=3), tmp_path / "logs")
    monkeypatch.setattr(watching, "MOST_ENTRIES", 63)
    with pytest.raises(UserError, match=r"up to 63 entries; those of qlearning on Froz.* have 64"):
        run_of(watched_spec(), tmp_path / "logs")
    assert not (tmp_path / "logs").exists()


def text_shown(n_steps, *, live):
    """What is written while an agent learns."""
    file = io.StringIO()
    console = Console(file=file, width=120, force_terminal=live, color_system=None)
    learner = load_algorithm("qlearning")(env=LAKE, seed=0, engine="interpreted")
    learner.learn(n_steps, callback=ProgressCallback(console, n_steps))
    return file.getvalue()


def test_elsewhere_plain_lines_now_and_then_and_in_a_terminal_a_bar(monkeypatch):
    monkeypatch.setattr(callbacks, "SECONDS_BETWEEN_LINES", 0.0)
    lines = text_shown(1000, live=False).splitlines()
    form = r" *(\d+)%  ([\d,]+) steps(  mean return in training 0\.\d\d)?"
    assert all(re.fullmatch(form, line) for line in lines)
    assert lines[-1].startswith("100%  1,000 steps")
    monkeypatch.setattr(callbacks, "SECONDS_BETWEEN_LINES", 1e9)
    assert text_shown(1000, live=False) == ""
    assert "\x1b[" in text_shown(1000, live=True)


UP, DOWN, LEFT, RIGHT = range(4)
# The cells are 0 S, 1 free, 2 free; 3 free, 4 shelf, 5 goal.
CORNER = {"desc": ["S..", ".#G"], "max_episode_steps": 10}


def map_of(actions, **env_kwargs):
    """The map of a table on a warehouse that prefers these actions, and action 0 elsewhere."""
    spec = spec_of("qlearning", WAREHOUSE, {"env_kwargs": env_kwargs})
    agent = agent_of("qlearning", make_training_env(spec, None))
    agent.policy.q_tables[0, range(len(actions)), actions] = 1.0
    return value_map(exact_evaluator(spec), agent)


# Right, left again; down onto the goal; up against the outer wall from below the start.
THERE_AND_BACK = [RIGHT, LEFT, DOWN, LEFT, UP, UP]


def test_a_map_worked_by_hand():
    found = map_of(THERE_AND_BACK, **CORNER)
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


def test_the_picture_of_costs_has_the_scales_of_both_maps(monkeypatch):
    drawn = []
    monkeypatch.setattr(pictures, "write_png", lambda figure, path: drawn.append(figure))
    found = map_of(THERE_AND_BACK, **CORNER)
    pictures.draw_cost_map("costs.png", "costs", found, np.eye(6)[1])
    labels = [axes.get_ylabel() for axes in drawn[0].axes[2:]]
    assert labels == ["expected return from here on", "share of the gap, in per cent"]
    assert [axes.get_ylim() for axes in drawn[0].axes[2:]] == [(97, 100), (0, 100)]


def test_an_action_among_several_best_ones_does_not_differ():
    square = {"desc": ["..G", "...", "S.."], "max_episode_steps": 20}
    for first in (UP, RIGHT):
        found = map_of([RIGHT, RIGHT, 0, RIGHT, RIGHT, UP, first, RIGHT, UP], **square)
        assert not found.differs.any()
        assert found.values[6] == found.optimal_values[6] == 97
    assert found.optimal_actions[6].tolist() == [True, False, False, True]


def test_a_run_keeps_the_maps_of_the_agents_that_it_saves(tmp_path):
    entry = {"learning_rate": 0.5, "env_kwargs": {"slip": 0.2}}
    kept = {"n_timesteps": 450, "eval_freq": 100, "save_freq": 100, "pictures": True}
    kept["diagnose"] = True
    run, outcome = trained("qlearning", WAREHOUSE, entry, folder=tmp_path, **kept)
    with np.load(run.path / "value_maps.npz") as file:
        maps = dict(file)
    assert maps["timesteps"].tolist() == [100, 200, 300, 400, 450]
    evaluator = exact_evaluator(spec_of("qlearning", WAREHOUSE, entry))
    paths = [*run.checkpoints().values(), run.path / f"{WAREHOUSE}.zip"]
    for path, values, actions in zip(paths, maps["values"], maps["actions"], strict=True):
        found = value_map(evaluator, load_algorithm("qlearning").load(path))
        np.testing.assert_array_equal(values, found.values)
        np.testing.assert_array_equal(actions, found.actions)
    np.testing.assert_array_equal(maps["optimal_values"], found.optimal_values)
    np.testing.assert_array_equal(maps["optimal_actions"], found.optimal_actions)
    # The agent did change, or there would be nothing to tell apart.
    assert len(np.unique(maps["values"], axis=0)) > 1
    with np.load(run.path / "evaluations.npz") as evaluations:
        at_start = maps["values"][:-1] @ evaluator.model.initial
        np.testing.assert_allclose(at_start, evaluations["results"][:, 0], rtol=1e-12)
    for name in ("learning_curve.png", "value_map.png"):
        assert (run.path / name).stat().st_size > 5000
        assert (run.path / name).read_bytes().startswith(b"\x89PNG")
    assert outcome.can_be_explained


def test_the_episodes_of_several_environments_in_the_order_in_which_they_ended(tmp_path):
    assert [array.shape for array in read_monitors(tmp_path)] == [(0,), (0,)]
    # Three environments step together: the second one's first episode ends after 3 x 4 steps.
    # Clocks do not count: processes start when they can.
    for name, rows in enumerate(("1,10,9.0\n2,5,9.5\n", "3,4,0.1\n4,8,0.2\n", "5,11,50.0\n")):
        (tmp_path / f"{name}.monitor.csv").write_text("#{}\nr,l,t\n" + rows)
    steps, returns = read_monitors(tmp_path)
    assert steps.tolist() == [12, 30, 33, 36, 45]
    assert returns.tolist() == [3, 1, 5, 4, 2]
