"""Run folders: each run has one of its own, and is found again."""

import json
import platform
import shutil
import subprocess
import sys
from pathlib import Path
from uuid import uuid4

import pytest

from pipeline import runs
from pipeline.errors import UserError
from pipeline.locks import mark
from pipeline.runs import NoRunError, Run, environment_name

ROOT = Path(runs.__file__).parent.parent


def claim_names(folder, env_id, n, **kwargs):
    return [Run.claim(folder, "sarsa", env_id, **kwargs).path.name for _ in range(n)]


# --- claiming ------------------------------------------------------------------------------------


def test_runs_are_numbered_from_one(tmp_path):
    assert claim_names(tmp_path / "logs", "Taxi-v4", 3) == ["Taxi-v4_1", "Taxi-v4_2", "Taxi-v4_3"]
    assert Run.claim(tmp_path / "logs", "dqn", "Taxi-v4").path.name == "Taxi-v4_1"
    assert Run.claim(tmp_path / "logs", "sarsa", "Taxi-v3").path.name == "Taxi-v3_1"


def test_a_claimed_folder_holds_the_folder_of_its_settings_and_gaps_are_not_filled(tmp_path):
    run = Run.claim(tmp_path, "sarsa", "Taxi-v4")
    assert run.path == tmp_path / "sarsa" / "Taxi-v4_1"
    assert sorted(path.name for path in run.path.iterdir()) == ["Taxi-v4", "run.json"]
    assert run.params_path.is_dir()
    (tmp_path / "sarsa" / "Taxi-v4_10").mkdir()
    (tmp_path / "sarsa" / "Taxi-v4_9").mkdir()
    assert claim_names(tmp_path, "Taxi-v4", 2) == ["Taxi-v4_11", "Taxi-v4_12"]
    assert Run.find(tmp_path, "sarsa", "Taxi-v4").path == run.path.with_name("Taxi-v4_12")
    assert Run.find(tmp_path, "sarsa", "Taxi-v4", 1) == run
    shutil.rmtree(tmp_path / "sarsa" / "Taxi-v4_9")
    with pytest.raises(UserError, match=r"no run 2 of sarsa on .*: there is 1, 10, 11, 12$"):
        Run.find(tmp_path, "sarsa", "Taxi-v4", 2)


OTHERS = ["Taxi-v4", "Taxi-v4_", "Taxi-v4_0", "Taxi-v4_x", "Taxi-v4_7_old", "Taxi-v4_7.zip"]
OTHERS += ["Taxi-v4_-7", "MyTaxi-v4_7", "taxi-v4_7", "Taxi-v40_7", "Taxi-v4_2_7"]


@pytest.mark.parametrize("neighbour", OTHERS)
def test_folders_of_other_names_do_not_count(tmp_path, neighbour):
    (tmp_path / "sarsa" / neighbour).mkdir(parents=True)
    with pytest.raises(UserError, match="no run of sarsa on Taxi-v4"):
        Run.find(tmp_path, "sarsa", "Taxi-v4")
    assert claim_names(tmp_path, "Taxi-v4", 1) == ["Taxi-v4_1"]


def test_a_number_taken_meanwhile_is_passed_over(tmp_path, monkeypatch):
    claim_names(tmp_path, "Taxi-v4", 3)
    # As if the other runs had been started after this one looked.
    monkeypatch.setattr(runs, "numbered_runs", lambda parent, name: [])
    assert claim_names(tmp_path, "Taxi-v4", 1) == ["Taxi-v4_4"]


def test_processes_never_share_a_folder(tmp_path):
    program = """
import sys
from pathlib import Path
from pipeline.runs import Run
print("ready", flush=True)
sys.stdin.readline()
for _ in range(25):
    print(Run.claim(Path(sys.argv[1]), "sarsa", "Taxi-v4").path.name)
"""
    processes = [
        subprocess.Popen(
            [sys.executable, "-c", program, str(tmp_path)],
            cwd=ROOT,
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            text=True,
        )
        for _ in range(2)
    ]
    for process in processes:
        assert process.stdout.readline() == "ready\n"
    for process in processes:
        process.stdin.write("go\n")
        process.stdin.flush()
    names = [name for process in processes for name in process.communicate()[0].split()]
    assert sorted(names) == sorted(f"Taxi-v4_{n}" for n in range(1, 51))


def test_what_no_folder_can_be_made_of(tmp_path):
    (tmp_path / "sarsa").write_text("not a folder")
    with pytest.raises(UserError, match=f"cannot make a run folder in {tmp_path}/sarsa: "):
        Run.claim(tmp_path, "sarsa", "Taxi-v4")
    with pytest.raises(UserError, match=r"cannot make a run folder in .*: File name too long"):
        Run.claim(tmp_path, "dqn", "Taxi-v4", suffix="x" * 300)


def test_discarding_leaves_the_other_runs(tmp_path):
    first, second = (Run.claim(tmp_path, "sarsa", "Taxi-v4") for _ in range(2))
    second.update_info(state="running")
    second.discard()
    assert [path.name for path in first.path.parent.iterdir()] == ["Taxi-v4_1"]
    second.discard()


# --- finding -------------------------------------------------------------------------------------


def test_runs_with_a_unique_suffix_count_and_are_found(tmp_path):
    suffixes = [f"_{uuid4()}" for _ in range(2)]
    for suffix in suffixes:
        Run.claim(tmp_path, "sarsa", "Taxi-v4", suffix)
    newest = Run.find(tmp_path, "sarsa", "Taxi-v4")
    assert newest.path.name == f"Taxi-v4_2{suffixes[1]}"
    assert newest.model_path.name == "Taxi-v4.zip"
    assert Run.find(tmp_path, "sarsa", "Taxi-v4", 1).path.name == f"Taxi-v4_1{suffixes[0]}"
    assert claim_names(tmp_path, "Taxi-v4", 1) == ["Taxi-v4_3"]


@pytest.mark.parametrize(
    ("env_id", "name"),
    [
        ("ALE/Pong-v5", "ALE-Pong-v5"),
        ("envs:Warehouse-v0", "Warehouse-v0"),
        ("ale_py:ALE/Pong-v5", "ALE-Pong-v5"),
        ("Odd.(+)[x]{1}$-v0", "Odd.(+)[x]{1}$-v0"),
        ("CON", "CON-a3dbc4b6"),
    ],
)
def test_names_of_environments_in_file_names(tmp_path, env_id, name):
    assert environment_name(env_id) == name
    # Where a dot, say, stood for any letter, this one would count.
    (tmp_path / "sarsa" / "Oddx(+)[x]{1}$-v0_9").mkdir(parents=True)
    assert claim_names(tmp_path, env_id, 2) == [f"{name}_1", f"{name}_2"]
    run = Run.find(tmp_path, "sarsa", env_id)
    assert run.path.name == f"{name}_2"
    assert run.path.parent == tmp_path / "sarsa"
    assert run.model_path == run.path / f"{name}.zip"
    assert run.vecnormalize_path == run.path / name / "vecnormalize.pkl"


def test_no_run_yet_says_what_to_train(tmp_path):
    for folder in (tmp_path, tmp_path / "nowhere"):
        with pytest.raises(NoRunError) as error:
            Run.find(folder, "sarsa", "envs:Warehouse-v0")
        assert str(error.value) == f"no run of sarsa on Warehouse-v0 in {folder}"
        asked = (error.value.algo, error.value.env_id, error.value.log_folder)
        assert asked == ("sarsa", "envs:Warehouse-v0", folder)


# --- what lies inside ----------------------------------------------------------------------------


def test_the_files_have_the_names_that_rl_zoo3_gives_them(tmp_path):
    run = Run(tmp_path, "Taxi-v4")
    names = {
        run.model_path: "Taxi-v4.zip",
        run.best_model_path: "best_model.zip",
        run.checkpoint_path(1000): "rl_model_1000_steps.zip",
        run.evaluations_path: "evaluations.npz",
        run.vecnormalize_path: "Taxi-v4/vecnormalize.pkl",
        run.info_path: "run.json",
    }
    assert {path.relative_to(tmp_path).as_posix() for path in names} == set(names.values())


def test_checkpoints_are_ordered_by_steps(tmp_path):
    run = Run.claim(tmp_path, "sarsa", "Taxi-v4")
    for name in ("1000", "200", "30", "x", "", "5_steps", "-7"):
        (run.path / f"rl_model_{name}_steps.zip").touch()
    (run.path / "rl_model_9_steps.zip.tmp").touch()
    (run.path / "rl_model_9_steps_zip").touch()
    assert run.checkpoints() == [run.checkpoint_path(n) for n in (30, 200, 1000)]


def test_info_names_the_process_while_it_is_at_work(tmp_path):
    run = Run.claim(tmp_path, "sarsa", "Taxi-v4")
    assert run.read_info() == {"state": "running", "process": mark()}
    run.update_info(seed=3)
    assert run.read_info() == {"state": "running", "seed": 3, "process": mark()}
    run.update_info(state="finished", final={"mean_return": 7.5})
    expected = {"state": "finished", "seed": 3, "final": {"mean_return": 7.5}}
    assert run.read_info() == json.loads(run.info_path.read_text()) == expected


@pytest.mark.parametrize(
    "content", [b"", b'{"state": "fini', b"[1, 2]", b"null", b'"text"', b"\xff\xfe\x00"]
)
def test_a_damaged_info_is_told_and_not_written_over(tmp_path, content):
    run = Run.claim(tmp_path, "sarsa", "Taxi-v4")
    run.info_path.write_bytes(content)
    for act in (run.read_info, lambda: run.update_info(state="finished")):
        with pytest.raises(UserError, match=r"run\.json is damaged: \S"):
            act()
    assert run.info_path.read_bytes() == content


def test_a_machine_is_recorded_without_its_name():
    machine = runs.recorded_machine()
    assert machine["system"].startswith(platform.system())
    assert int(machine["cores"]) >= 1
    assert platform.node() not in str(machine)
