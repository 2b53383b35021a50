"""Studies that get more seeds until they are decided, and their planned looks."""

from dataclasses import replace

import pandas as pd
import pytest

from rl_yardstick.experiments.analysis import analyse, looked
from rl_yardstick.experiments.plan import StudyRecord, look_sizes, plan, plan_of_looks
from rl_yardstick.experiments.results import CURVE_COLUMNS, RUN_COLUMNS, StudyResults
from rl_yardstick.experiments.study import AgentSpec, EnvironmentSpec, StudySpec
from rl_yardstick.pipeline.errors import UserError

LAKE = EnvironmentSpec("lake", "FrozenLake-v1", {"n_timesteps": 10})
THREE = ("qlearning", "sarsa", "expected_sarsa")
# The first is far ahead; the others overlap, and need more seeds.
ENDS = {
    "qlearning": [90 + k % 7 for k in range(60)],
    "sarsa": [(37 * k) % 50 for k in range(60)],
    "expected_sarsa": [(29 * k) % 50 + 1 for k in range(60)],
}


def study_of(agents=THREE, n_seeds=10, **fields):
    specs = tuple(AgentSpec(name, name) for name in agents)
    return StudySpec("s", "S", specs, (LAKE,), n_seeds, **fields)


def results_of(study, root, ends=ENDS, counts=None):
    """A study, grown to these counts, whose runs ended so; None for one that is missing."""
    study = replace(study, n_seeds=max(counts.values())) if counts else study
    planned = plan(study, root, counts)
    rows = []
    for run in planned:
        end = ends[run.agent][run.seed - study.first_seed]
        if end is not None:
            row = {"agent": run.agent, "environment": run.environment, "env_id": run.spec.env_id}
            row |= {"seed": run.seed, "final": float(end), "area": float(end), "score": end / 100}
            rows.append({**row, "exact": True, "optimum": 100.0, "baseline": 0.0})
    tables = pd.DataFrame(rows, columns=RUN_COLUMNS), pd.DataFrame(columns=CURVE_COLUMNS)
    return StudyResults(study, root, *tables, tuple(planned))


def next_counts(said):
    """The numbers of seeds at the next look."""
    return {(agent, e): n for e, by in said.seeds.items() for agent, n in by.items()}


def grow(study, root, most=None, steps=99):
    """What the command does, with made-up runs; the verdicts after each look."""
    looks = plan_of_looks(study, root, most)
    StudyRecord(study, {}, looks).write(root)
    counts, found = {(agent.label, "lake"): study.n_seeds for agent in study.agents}, []
    for _ in range(steps):
        found.append(looked(results_of(study, root, counts=counts), looks))
        if found[-1].is_done:
            break
        counts = next_counts(found[-1])
    return found


def test_a_study_grows_where_it_is_undecided(tmp_path):
    found = grow(study_of(), tmp_path, most=40)
    assert StudyRecord.read(tmp_path).looks == (10, 20, 40)
    assert [each.n_looks for each in found] == [1, 2, 3]
    assert [each.seeds["lake"]["sarsa"] for each in found] == [20, 40, 40]
    assert {each.seeds["lake"]["qlearning"] for each in found} == {10}
    undecided = [(p.first, p.second) for p in found[-1].pairs if p.word == "undecided"]
    assert undecided == [("sarsa", "expected_sarsa")]
    # The same command goes on from the first look, with the runs that are there.
    assert grow(study_of(), tmp_path)[-1] == found[-1]


def test_a_growing_study_is_judged_by_its_looks_wherever_it_is_shown(tmp_path):
    said = grow(study_of(), tmp_path, most=40)[-1]
    results = results_of(study_of(), tmp_path, counts=next_counts(said))
    shown = analyse(results, looks=(10, 20, 40))
    assert shown.verdicts == said
    assert {agent.n_runs for agent in shown.environments[0].agents} == {10, 40}


def test_sizes_of_looks():
    assert look_sizes(10, 80) == (10, 20, 40, 80)
    assert look_sizes(10, 50) == (10, 20, 40, 50)
    assert look_sizes(5, 5) == (5,)


PLANNED = [
    ({}, 60, "looks [10, 20, 40], now [10, 20, 40, 60]"),
    ({"n_seeds": 12}, None, "looks [10, 20, 40], now [12, 24, 40]"),
    ({"metric": "area"}, None, "metric final, now area"),
    ({"margin": 1.0}, None, "margin None, now 1.0"),
    ({"agents": THREE[:2]}, None, "agents ['expected_sarsa', 'qlearning', 'sarsa'], now "),
]


def test_what_was_planned_cannot_change(tmp_path):
    grow(study_of(), tmp_path, most=40, steps=1)
    for changes, most, words in PLANNED:
        with pytest.raises(UserError, match="looks were planned before the first") as refusal:
            plan_of_looks(study_of(**changes), tmp_path, most)
        assert words in str(refusal.value)
