"""Runs whose files are damaged: left out with the reason, and done again when that is asked for."""

import shutil
from dataclasses import replace
from pathlib import Path

import pytest
from rich.console import Console
from rl_yardstick.experiments.child_processes import NO_LIMITS
from rl_yardstick.experiments.run_folders import draft_path, move_damaged_aside
from rl_yardstick.experiments.run_in_child import do_run
from rl_yardstick.pipeline.digests import DamagedFileError
from rl_yardstick.pipeline.runs import PULLS_FILE, Run

from rl_yardstick.commands.compare import RunContext, repair, run_study
from rl_yardstick.experiments.bandits import STATISTICS_FILE
from rl_yardstick.experiments.plan import plan
from rl_yardstick.experiments.results import (
    read_episodes,
    read_results,
)
from rl_yardstick.experiments.study import AgentSpec, EnvironmentSpec, StudySpec

STEPS = {"n_timesteps": 60}
WAREHOUSE = EnvironmentSpec("grid", "Warehouse-v0", STEPS)
ARMS = EnvironmentSpec("arms", "BernoulliBandit-v0", STEPS)
PPO = {"policy": "MlpPolicy", "n_steps": 32, "batch_size": 32, "policy_kwargs": {"net_arch": [4]}}


def study_of(algo, environment, settings=None, n_seeds=2):
    agent = AgentSpec(algo, algo, settings or {}, tuned=not settings)
    return StudySpec("s", "S", (agent,), (environment,), n_seeds=n_seeds, eval_freq=30)


STUDIES = {
    "grid": study_of("qlearning", WAREHOUSE),
    "batch": study_of("ucb", ARMS),
    "pulls": study_of("ppo", ARMS, PPO, n_seeds=1),
}


@pytest.fixture(scope="module")
def whole(tmp_path_factory, do_study):
    root = tmp_path_factory.mktemp("whole")
    for name, study in STUDIES.items():
        do_study(study, root / name)
    return root


@pytest.fixture
def copied(whole, tmp_path):
    """A copy of a study that is done, to damage: its study, plan, and folder."""

    def copy(name):
        shutil.copytree(whole / name, tmp_path / name)
        return STUDIES[name], plan(STUDIES[name], tmp_path / name), tmp_path / name

    return copy


@pytest.fixture
def grid(copied):
    return copied("grid")


def flip(path):
    content = bytearray(path.read_bytes())
    content[len(content) // 2] ^= 4
    path.write_bytes(bytes(content))


READ = {
    "grid": ["0.monitor.csv", "evaluations.npz", "value_maps.npz", "Warehouse-v0.zip", "run.json"],
    "batch": [STATISTICS_FILE],
    "pulls": [PULLS_FILE],
}


@pytest.mark.parametrize(
    ("kind", "name", "damage"),
    [
        *((kind, name, flip) for kind, names in READ.items() for name in names),
        ("grid", "evaluations.npz", Path.unlink),
        ("grid", "run.json", Path.unlink),
    ],
)
def test_a_damaged_run_is_left_out_and_said_to_be(copied, kind, name, damage):
    study, planned, root = copied(kind)
    damage(planned[0].path / name)
    results = read_results(study, planned, root)
    (left_out,) = results.left_out
    assert left_out.planned is planned[0]
    said = ["missing"] if damage is Path.unlink else ["not as the run left it", "damaged"]
    assert any(words in left_out.reason for words in said)
    assert str(planned[0].path / name) in left_out.reason
    assert results.finished == tuple(planned[1:])
    assert not planned[0].is_to_do
    expected = [] if planned[0].is_batch or not planned[1:] else [1]
    assert results.summary["seed"].tolist() == expected
    assert len(results.pulls) == 0


def test_what_a_comparison_does_not_read_is_not_held_against_it(grid):
    study, planned, root = grid
    (planned[0].path / "notes.txt").write_text("mine")
    flip(planned[0].run.params_path / "config.yml")
    planned[1].run.model_path.unlink()  # no episode of this one is filmed
    results = read_results(study, planned, root)
    assert results.left_out == ()
    assert results.summary["seed"].tolist() == [0, 1]
    # Nor is a run of other settings damage.
    other = replace(study, eval_freq=20)
    assert all(run.is_to_do for run in plan(other, root))
    assert read_results(other, plan(other, root), root).left_out == ()


# --- What the command does about it.


def test_repair_moves_aside_what_is_done_again(grid, capsys):
    def compare_again():
        """What the command does and prints, in this process: exit code and output."""
        context = RunContext(root, "c", NO_LIMITS, Console(width=400), with_page=False)
        return run_study(context, study, planned), capsys.readouterr().out

    def figures():
        table = read_results(study, planned, root).summary
        return table.drop(columns=["seconds", "cpu_seconds", "engine"])

    study, planned, root = grid
    whole = figures()
    flip(planned[1].run.evaluations_path)
    path = planned[1].run.evaluations_path
    before = path.read_bytes()
    # Without being asked to the command leaves it as it is.
    code, out = compare_again()
    assert (code, path.read_bytes()) == (1, before)
    assert (
        f"left out: qlearning on grid, seed 1: {path} has changed since the run wrote it\n" in out
    )
    assert "1 run is damaged and in no figure; --repair does such runs again" in out
    assert "1 of 2 runs of qlearning is missing" in out
    repair(Console(width=400), study, planned)
    assert "its folder is grid_2.damaged-1 now" in capsys.readouterr().out
    aside = planned[1].path.with_name("grid_2.damaged-1")
    assert (aside / "evaluations.npz").read_bytes() == before
    assert [run.is_to_do for run in planned] == [False, True]
    do_run(planned[1], draft_path(root, planned[1]), "c")
    code, out = compare_again()
    assert (code, "damaged" in out) == (0, False)
    assert figures().equals(whole)
    # And once more: nothing is written over.
    flip(planned[1].run.evaluations_path)
    ((_, place),) = move_damaged_aside(study, planned)
    assert place.name == "grid_2.damaged-2"


# --- The files of a run's figures, where they have not the form that a run gives them.

# Rows after the first line and that of the names.
ROWS = ["1,2", "nan,2,3", "1,0,3", "1,two,3"]
MONITORS = ["", "r,l,t\n1,2,3\n", "#{}\nr,l\n1,2\n", "#{}\n\0\0\xff\n"]
MONITORS += [f"#{{}}\nr,l,t\n{row}\n" for row in ROWS]


@pytest.mark.parametrize("text", MONITORS)
def test_a_monitor_file_of_no_form(tmp_path, text):
    (tmp_path / "0.monitor.csv").write_bytes(text.encode("latin-1"))
    with pytest.raises(DamagedFileError, match=r"0\.monitor\.csv is damaged: ") as error:
        read_episodes(Run(tmp_path, "x"))
    assert "\n" not in str(error.value)
