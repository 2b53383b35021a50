"""What counts as a look at a study, what each may spend, and the file that remembers them."""

import json
from dataclasses import replace

import pandas as pd
import pytest

from experiments.growing import (
    counts_of,
    grown,
    remember,
    settled_looks,
    take_looks,
    take_planned_looks,
)
from experiments.looks import LOOKS_FILE, Looks, read_looks
from experiments.plan import plan
from experiments.results import CURVE_COLUMNS, RUN_COLUMNS, StudyResults
from experiments.study import AgentSpec, EnvironmentSpec, StudySpec
from pipeline.errors import UserError
from verdicts import level_of_look

LAKE = EnvironmentSpec("lake", "FrozenLake-v1", {"n_timesteps": 10})
TWO, THREE = ("qlearning", "sarsa"), ("qlearning", "sarsa", "expected_sarsa")
# The first is far ahead; the others overlap, and need more seeds.
ENDS = {
    "qlearning": [90 + k % 7 for k in range(60)],
    "sarsa": [(37 * k) % 50 for k in range(60)],
    "expected_sarsa": [(29 * k) % 50 + 1 for k in range(60)],
}
FEWER = {**ENDS, "sarsa": [None, *ENDS["sarsa"][1:]]}
OTHERS = {**ENDS, "sarsa": [99, *ENDS["sarsa"][1:]]}


def study_of(agents=TWO, n_seeds=10, **fields):
    specs = tuple(AgentSpec(name, name) for name in agents)
    return StudySpec("s", "S", specs, fields.pop("environments", (LAKE,)), n_seeds, **fields)


def results_of(study, root, ends=ENDS, counts=None):
    """A study whose runs ended so, by agent and seed; None for one that is missing."""
    planned = plan(study, root, counts)
    rows = []
    for run in planned:
        end = ends[run.agent][run.seed]
        if end is not None:
            row = {"agent": run.agent, "environment": run.environment, "env_id": run.spec.env_id}
            row |= {"seed": run.seed, "final": float(end), "area": float(end), "score": end / 100}
            rows.append({**row, "exact": True, "optimum": 100.0, "baseline": 0.0})
    tables = pd.DataFrame(rows, columns=RUN_COLUMNS), pd.DataFrame(columns=CURVE_COLUMNS)
    return StudyResults(study, root, *tables, tuple(planned))


def look(root, ends=ENDS, **fields):
    """Which look it is, and at the level of which."""
    standing = take_looks(results_of(study_of(**fields), root, ends))["lake"]
    levels = {level(k): k for k in range(1, 9)} | {level(1) / 4: "a quarter"}
    return standing.number, levels[standing.level]


def level(k):
    return level_of_look(0.05, k)


def number_of_looks(root, environment="lake"):
    return len(read_looks(root).get(environment, Looks()).taken)


def test_a_look_counts_when_the_runs_or_the_question_are_others(tmp_path):
    dry = replace(LAKE, label="dry")
    for place, fields in [
        (1, {}),
        (1, {}),
        (2, {"n_seeds": 20}),
        (1, {"n_seeds": 10}),
        (3, {"n_seeds": 20, "metric": "area"}),
        (4, {"n_seeds": 20, "margin": 1.0}),
        (5, {"n_seeds": 20, "agents": THREE}),
        (5, {"n_seeds": 20, "agents": THREE}),
        (6, {"n_seeds": 20, "first_seed": 30}),
        (7, {"n_seeds": 25, "environments": (LAKE, dry)}),
    ]:
        assert look(tmp_path, **fields) == (place, place)
    # Environments are counted by themselves.
    assert (number_of_looks(tmp_path), number_of_looks(tmp_path, "dry")) == (7, 1)
    (tmp_path / LOOKS_FILE).unlink()
    assert look(tmp_path, n_seeds=20) == (1, 1)


def test_too_few_seeds_to_say_anything_are_no_look(tmp_path):
    assert look(tmp_path, n_seeds=4) == (1, 1)
    assert not (tmp_path / LOOKS_FILE).exists()
    assert look(tmp_path, n_seeds=5) == (1, 1)
    # At the level of the second look it takes seven seeds.
    for n_seeds, n_looks in ((6, 1), (7, 2)):
        assert look(tmp_path, n_seeds=n_seeds) == (2, 2)
        assert number_of_looks(tmp_path) == n_looks


def test_a_run_that_is_damaged_since_costs_no_look_and_one_that_is_new_does(tmp_path):
    assert look(tmp_path) == look(tmp_path, FEWER) == (1, 1)
    assert look(tmp_path, OTHERS) == (2, 2)
    (tmp_path / LOOKS_FILE).unlink()
    assert look(tmp_path, FEWER) == (1, 1)
    assert look(tmp_path) == (2, 2)


# --- The file.


def test_a_file_that_was_edited_or_is_of_another_kind_is_refused(tmp_path):
    path = tmp_path / LOOKS_FILE
    look(tmp_path)
    look(tmp_path, n_seeds=20)
    edited = json.loads(path.read_text())
    del edited["environments"]["lake"]["taken"][0]  # a second look at the level of a first
    for text in (json.dumps(edited), "", "{"):
        path.write_text(text)
        with pytest.raises(UserError, match=r"looks\.json is damaged: .* are forgotten$"):
            read_looks(tmp_path)
    path.write_text('{"format": 1, "environments": {"lake": {}}}')
    with pytest.raises(UserError, match=r"by an earlier version, .* give the study another name"):
        read_looks(tmp_path)


# --- Studies that grow.


def grow(study, root, most=None, steps=99, ends=ENDS):
    """What the command does, with made-up runs; the steps."""
    root.mkdir(exist_ok=True)
    looks = settled_looks(study, root, most)
    remember(root, read_looks(root), looks)
    counts, taken = counts_of(study, looks), []
    for _ in range(steps):
        taken.append(take_planned_looks(results_of(grown(study, counts), root, ends, counts)))
        if all(step.growth.is_done for step in taken[-1]):
            break
        counts = counts_of(study, read_looks(root))
    return counts, taken


def test_a_study_grows_where_it_is_undecided_and_remembers_each_look(tmp_path):
    counts, steps = grow(study_of(THREE), tmp_path, most=40)
    assert {name: n for (name, _), n in counts.items()} == dict(
        zip(THREE, (10, 40, 40), strict=True)
    )
    assert [step.growth.n_looks for (step,) in steps] == [1, 2, 3, 4]
    assert steps[-1][0].undecided == [("sarsa", "expected_sarsa")]
    taken = read_looks(tmp_path)["lake"].taken
    assert [dict(each.seeds)["sarsa"] for each in taken] == [10, 16, 25, 40]
    assert [dict(each.seeds)["qlearning"] for each in taken] == [10] * 4
    assert {(each.level, each.planned) for each in taken} == {(level(1) / 4, True)}
    # Grown by hand, it is looked at with what is left.
    assert look(tmp_path, agents=THREE, n_seeds=50) == (5, 2)
    assert look(tmp_path, agents=THREE, n_seeds=60) == (6, 3)
    # The same runs as at a look that was settled are that look.
    assert look(tmp_path, agents=THREE, n_seeds=10) == (1, "a quarter")


SETTLED = [
    ({}, 60, "looks at seeds [10, 16, 25, 40], now [10, 16, 24, 38, 60]"),
    ({"n_seeds": 12}, None, "looks at seeds"),
    ({"metric": "area"}, None, "metric final, now area"),
    ({"agents": TWO}, None, "agents ['expected_sarsa', 'qlearning', 'sarsa'], now "),
]


def test_what_was_settled_cannot_change(tmp_path):
    grow(study_of(THREE), tmp_path, most=40, steps=1)
    for changes, most, words in SETTLED:
        with pytest.raises(UserError, match="looks were fixed before the first") as refusal:
            settled_looks(study_of(**{"agents": THREE, **changes}), tmp_path, most)
        assert words in str(refusal.value)


def test_runs_that_were_looked_at_and_are_others_now_are_refused(tmp_path):
    study = study_of(THREE)
    grow(study, tmp_path, most=40, steps=2)
    with pytest.raises(UserError, match="on lake, runs have changed since they were looked at"):
        grow(study, tmp_path, ends=OTHERS)
    # One that is missing now makes no such claim, nor one that was missing then.
    grow(study, tmp_path, ends=FEWER, steps=1)
    grow(study, tmp_path, steps=1)
