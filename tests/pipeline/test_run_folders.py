"""Run folders: each run has its own and is found again; what it says of its files; whole files."""

import hashlib
import io
import json
import math
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from uuid import uuid4

import numpy as np
import pytest
from hypothesis import example, given
from hypothesis import strategies as st

from rl_yardstick.pipeline import files
from rl_yardstick.pipeline.digests import DamagedFileError, read_arrays
from rl_yardstick.pipeline.errors import UserError
from rl_yardstick.pipeline.models.find import check_digest
from rl_yardstick.pipeline.runs import NoRunError, Run, environment_name

TAXI = "Taxi-v4"


def claim_names(folder, env_id, n, **kwargs):
    return [Run.claim(folder, "sarsa", env_id, **kwargs).path.name for _ in range(n)]


def names(folder):
    return sorted(path.name for path in folder.iterdir())


# --- folders -------------------------------------------------------------------------------------


def test_runs_are_numbered_from_one_and_gaps_are_not_filled(tmp_path):
    assert claim_names(tmp_path, TAXI, 2) == ["Taxi-v4_1", "Taxi-v4_2"]
    assert Run.claim(tmp_path, "dqn", TAXI).path.name == "Taxi-v4_1"
    run = Run.claim(tmp_path, "sarsa", "Taxi-v3")
    assert run.path == tmp_path / "sarsa" / "Taxi-v3_1"
    assert names(run.path) == ["Taxi-v3", "run.json"]
    for number in (10, 9):
        (tmp_path / "sarsa" / f"Taxi-v3_{number}").mkdir()
    assert claim_names(tmp_path, "Taxi-v3", 2) == ["Taxi-v3_11", "Taxi-v3_12"]
    assert Run.find(tmp_path, "sarsa", "Taxi-v3").path == run.path.with_name("Taxi-v3_12")
    assert Run.find(tmp_path, "sarsa", "Taxi-v3", 1) == run
    with pytest.raises(UserError, match=r"no run 2 of sarsa on .*: there is 1, 9, 10, 11, 12$"):
        Run.find(tmp_path, "sarsa", "Taxi-v3", 2)
    # A unique suffix counts and is found.
    suffix = f"_{uuid4()}"
    Run.claim(tmp_path, "a", TAXI, suffix)
    newest = Run.find(tmp_path, "a", TAXI)
    assert (newest.path.name, newest.model_path.name) == (f"Taxi-v4_1{suffix}", "Taxi-v4.zip")
    with pytest.raises(NoRunError, match="no run of b on Taxi-v4"):
        Run.find(tmp_path, "b", TAXI)


def test_names_of_environments_in_file_names(tmp_path):
    assert environment_name("envs:Warehouse-v0") == "Warehouse-v0"
    run = Run.claim(tmp_path, "sarsa", "ale_py:ALE/Pong-v5")
    assert Run.find(tmp_path, "sarsa", "ale_py:ALE/Pong-v5").path == run.path
    assert run.model_path == tmp_path / "sarsa" / "ALE-Pong-v5_1" / "ALE-Pong-v5.zip"
    assert run.vecnormalize_path == run.path / "ALE-Pong-v5" / "vecnormalize.pkl"


def test_checkpoints_are_ordered_by_steps(tmp_path):
    run = Run.claim(tmp_path, "sarsa", "Taxi-v4")
    for name in ("1000", "200", "30", "x"):
        (run.path / f"rl_model_{name}_steps.zip").touch()
    (run.path / "rl_model_9_steps.zip.tmp").touch()
    assert run.checkpoints() == [run.checkpoint_path(n) for n in (30, 200, 1000)]


# --- the record and the digests ------------------------------------------------------------------


@pytest.fixture
def run(tmp_path):
    """A run that has ended."""
    run = Run(tmp_path, "Lake-v1")
    run.params_path.mkdir()
    (run.params_path / "config.yml").write_bytes(b"a: 1\n")
    (tmp_path / "0.monitor.csv").write_bytes(b"r,l,t\n")
    (tmp_path / ".best_model.zip.77.tmp").write_bytes(b"half")
    run.end(state="finished", final={"mean_return": 0.1}, steps=(1, 2))
    return run


def test_the_digests_are_those_of_the_files_and_the_record_has_its_own(run):
    record = run.read_info()
    listed = record["files"]
    assert list(listed) == ["0.monitor.csv", "Lake-v1/config.yml", "run.json"]
    for name in list(listed)[:2]:
        assert listed[name] == hashlib.sha256((run.path / name).read_bytes()).hexdigest()
    record = json.loads(run.info_path.read_text())
    own = record["files"].pop("run.json")
    text = json.dumps(record, sort_keys=True, separators=(",", ":"))
    assert own == hashlib.sha256(text.encode()).hexdigest()
    assert record["steps"] == [1, 2]
    run.update_info(state="failed")
    assert run.read_info()["state"] == "failed"


# The last one loses the digests, for which one letter of a name is enough.
CHANGES = {
    '"finished"': '"finishee"',
    "0.1": "0.3",
    "Lake-v1/config.yml": "Lake-v1/confic.yml",
    '"files"': '"file?"',
}


@pytest.mark.parametrize("old", CHANGES)
def test_a_changed_record_is_refused(run, old):
    text = run.info_path.read_text()
    assert text.count(old) == 1
    run.info_path.write_text(text.replace(old, CHANGES[old]))
    with pytest.raises(DamagedFileError, match=r"run\.json is damaged: it "):
        run.read_info()


@pytest.mark.parametrize(
    "content",
    [
        *(b"", b"[1]", b'{"a": "\xff"}', b"[" * 100_000, b'{"files": {"x": 3}}'),
    ],
    ids=lambda content: f"{content[:9]!r} x {len(content)}",
)
def test_a_damaged_record_is_told_and_not_written_over(tmp_path, content):
    run = Run.claim(tmp_path, "sarsa", TAXI)
    run.info_path.write_bytes(content)
    for act in (run.read_info, lambda: run.update_info(state="finished")):
        with pytest.raises(DamagedFileError, match=r"run\.json is damaged: \S"):
            act()
    assert run.info_path.read_bytes() == content


def test_files_are_held_against_their_digests(run):
    def check_refused(said):
        for read in (run.files.read, run.files.check):
            with pytest.raises(DamagedFileError, match=rf"0\.monitor\.csv {said}"):
                read(csv)

    csv = run.path / "0.monitor.csv"
    assert run.files.read(csv) == b"r,l,t\n"
    # Files of the user's are nobody's business, and are not read as if the run had left them.
    for name in ("notes.txt", "1.monitor.csv"):
        (run.path / name).write_text("mine")
        run.files.check(run.path / name)
    check_digest(run, run.path.parent / "elsewhere.zip")
    check_digest(None, csv)
    assert [path.name for path in run.files.matching("*.monitor.csv")] == ["0.monitor.csv"]
    csv.write_bytes(b"r,l,u\n")
    check_refused("has changed since the run wrote it")
    with pytest.raises(UserError, match=r"wrote it: train again, or name another copy of it$"):
        check_digest(run, csv)
    csv.unlink()
    check_refused("is missing")


# --- arrays --------------------------------------------------------------------------------------
PATH = Path("run/evaluations.npz")


def archive(**arrays):
    stream = io.BytesIO()
    np.savez(stream, **arrays)
    return stream.getvalue()


@pytest.mark.parametrize(
    ("content", "reason"),
    [
        (archive(a=np.arange(9))[:-30], "not a zip file"),
        (archive(a=np.array([{}], object)), "Object arrays cannot be loaded"),
        (archive(a=np.array(["text"])), "where numbers belong"),
    ],
)
def test_anything_else_is_refused_in_one_line(content, reason):
    with pytest.raises(DamagedFileError, match=reason) as caught:
        read_arrays(PATH, content)
    assert str(caught.value).startswith("run/evaluations.npz is damaged: ")


# --- files that are there whole, or as before ----------------------------------------------------


def test_a_writer_that_is_stopped_changes_nothing(tmp_path):
    path = tmp_path / "model.zip"
    path.write_text("old")
    with pytest.raises(KeyboardInterrupt), files.replacing(path) as file:  # noqa: PT012  # half of it
        file.write(b"half")
        raise KeyboardInterrupt
    assert names(tmp_path) == ["model.zip"]
    assert path.read_text() == "old"


# --- names and JSON ------------------------------------------------------------------------------
LETTERS = st.characters(exclude_categories=["Cs"])
NAMES = st.text(LETTERS) | st.sampled_from([".", "..", "a.", "a:b", "a/b", "a?b", "CON"])


@given(NAMES | st.text(LETTERS, min_size=100, max_size=400), NAMES)
@example("a:", "a?")
@example("x" * 150, "x" * 151)
def test_a_name_is_one_that_systems_take_and_two_stay_two(name, other):
    portable = files.portable_name(name)
    assert 0 < len(portable.encode()) <= 100
    assert not set(portable) & {*'<>:"/\\|?*', *map(chr, range(32))}
    assert not portable.endswith((" ", "."))
    assert files.portable_name(portable) == portable
    assert (portable == files.portable_name(other)) == (name == other)


def test_what_is_no_json_is_written_as_the_nearest_that_is():
    odd = {
        "nan": math.nan,
        "limits": (-math.inf, np.float32(np.inf)),
        "array": np.arange(3, dtype=np.int8),
        1: np.bool_(True),
    }
    text = files.json_text(odd, indent=2)
    # A strict reader takes it.
    assert json.loads(text, parse_constant=pytest.fail) == {
        "nan": None,
        "limits": [-math.inf, math.inf],
        "array": [0, 1, 2],
        "1": True,
    }


def test_claims_at_the_same_time_never_share_a_folder(tmp_path):
    with ThreadPoolExecutor(8) as pool:
        claimed = pool.map(lambda _: claim_names(tmp_path, TAXI, 1), range(40))
    assert sorted(claimed) == sorted([f"Taxi-v4_{n}"] for n in range(1, 41))
