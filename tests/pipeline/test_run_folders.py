"""Run folders: each run has its own and is found again; what it says of its files; whole files."""

import errno
import hashlib
import io
import json
import math
import os
import platform
import shutil
import subprocess
import sys
import zipfile
from pathlib import Path
from uuid import uuid4

import numpy as np
import pytest
from hypothesis import assume, example, given
from hypothesis import strategies as st
from hypothesis.extra import numpy as np_st

from pipeline import files, runs
from pipeline.digests import DamagedFileError, read_arrays, read_record, sealed
from pipeline.errors import UserError
from pipeline.locks import mark
from pipeline.models.find import check_digest
from pipeline.runs import NoRunError, Run, environment_name

ROOT = Path(runs.__file__).parent.parent
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
    (tmp_path / "sarsa" / "Taxi-v3_10").mkdir()
    (tmp_path / "sarsa" / "Taxi-v3_9").mkdir()
    assert claim_names(tmp_path, "Taxi-v3", 2) == ["Taxi-v3_11", "Taxi-v3_12"]
    assert Run.find(tmp_path, "sarsa", "Taxi-v3").path == run.path.with_name("Taxi-v3_12")
    assert Run.find(tmp_path, "sarsa", "Taxi-v3", 1) == run
    shutil.rmtree(tmp_path / "sarsa" / "Taxi-v3_9")
    with pytest.raises(UserError, match=r"no run 2 of sarsa on .*: there is 1, 10, 11, 12$"):
        Run.find(tmp_path, "sarsa", "Taxi-v3", 2)
    second = Run.find(tmp_path, "sarsa", TAXI)
    for _ in range(2):
        second.discard()
    assert Run.find(tmp_path, "sarsa", TAXI).path.name == "Taxi-v4_1"


OTHERS = "Taxi-v4 Taxi-v4_ Taxi-v4_0 Taxi-v4_x Taxi-v4_7_old Taxi-v4_7.zip Taxi-v4_-7 MyTaxi-v4_7 "
OTHERS += "taxi-v4_7 Taxi-v40_7 Taxi-v4_2_7"


def test_folders_of_other_names_do_not_count(tmp_path):
    for neighbour in OTHERS.split():
        (tmp_path / "sarsa" / neighbour).mkdir(parents=True)
        with pytest.raises(NoRunError, match="no run of sarsa on Taxi-v4"):
            Run.find(tmp_path, "sarsa", TAXI)
    assert claim_names(tmp_path, TAXI, 1) == ["Taxi-v4_1"]


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


def test_runs_with_a_unique_suffix_count_and_are_found(tmp_path):
    suffixes = [f"_{uuid4()}" for _ in range(2)]
    for suffix in suffixes:
        Run.claim(tmp_path, "sarsa", TAXI, suffix)
    newest = Run.find(tmp_path, "sarsa", TAXI)
    assert (newest.path.name, newest.model_path.name) == (f"Taxi-v4_2{suffixes[1]}", "Taxi-v4.zip")
    assert Run.find(tmp_path, "sarsa", TAXI, 1).path.name == f"Taxi-v4_1{suffixes[0]}"
    assert claim_names(tmp_path, TAXI, 1) == ["Taxi-v4_3"]


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


def test_a_machine_is_recorded_without_its_name():
    machine = runs.recorded_machine()
    assert machine["system"].startswith(platform.system())
    assert int(machine["cores"]) >= 1
    assert platform.node() not in str(machine)


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


def test_the_digests_are_those_of_sha256sum_and_the_record_has_its_own(run):
    record = run.read_info()
    listed = record["files"]
    assert list(listed) == ["0.monitor.csv", "Lake-v1/config.yml", "run.json"]
    known = subprocess.run(  # a fixed command
        ["/usr/bin/sha256sum", "0.monitor.csv", "Lake-v1/config.yml"],
        cwd=run.path,
        capture_output=True,
        text=True,
        check=True,
    )
    assert known.stdout == "".join(f"{listed[name]}  {name}\n" for name in list(listed)[:2])
    record = json.loads(run.info_path.read_text())
    own = record["files"].pop("run.json")
    text = json.dumps(record, sort_keys=True, separators=(",", ":"))
    assert own == hashlib.sha256(text.encode()).hexdigest()
    assert record["steps"] == [1, 2]
    run.update_info(state="failed")
    assert run.read_info()["state"] == "failed"
    assert sealed({"state": "running"}) == {"state": "running"}


# The last two lose the digests, for which one letter of a name is enough.
CHANGES = {
    '"finished"': '"finishee"',
    "0.1": "0.3",
    "Lake-v1/config.yml": "Lake-v1/confic.yml",
    '"run.json"': '"run.jsom"',
    '"steps"': '"stepz"',
    '"files"': '"file?"',
    '"record_version"': '"record_versio?"',
}


@pytest.mark.parametrize("old", CHANGES)
def test_a_changed_record_is_refused(run, old):
    text = run.info_path.read_text()
    assert text.count(old) == 1
    run.info_path.write_text(text.replace(old, CHANGES[old]))
    with pytest.raises(DamagedFileError, match=r"run\.json is damaged: it "):
        run.read_info()


@pytest.mark.parametrize("field", ["files", "record_version"])
def test_a_record_that_lost_its_digests_is_no_record_of_an_earlier_version(run, field):
    record = json.loads(run.info_path.read_text())
    del record[field]
    run.info_path.write_text(json.dumps(record))
    with pytest.raises(DamagedFileError, match=r"run\.json is damaged: it "):
        run.read_info()


JSON = st.recursive(
    st.none() | st.booleans() | st.integers() | st.floats() | st.text(max_size=4),
    lambda inner: st.lists(inner, max_size=3) | st.dictionaries(st.text(max_size=4), inner),
    max_leaves=8,
)


@given(content=st.binary(max_size=40) | JSON.map(lambda data: json.dumps(data).encode()))
def test_any_record_is_read_or_refused_in_one_line(tmp_path_factory, content):
    path = tmp_path_factory.mktemp("record") / "run.json"
    path.write_bytes(content)
    try:
        found = read_record(path)
    except DamagedFileError as error:
        found = error
    is_one_line = str(found).startswith(f"{path} is damaged: ") and "\n" not in str(found)
    assert isinstance(found, dict) or is_one_line


@pytest.mark.parametrize(
    "content",
    [
        *(b"", b"null", b"[1]", b"{", b'{"a": "\xff"}', b"[" * 100_000),
        b'{"a": ' + b"[" * 200 + b"]" * 200 + b"}",
        b'{"a": ' + b"9" * 5000 + b"}",
        *(b'{"files": 3}', b'{"files": {"x": 3}}', b'{"files": {}}'),
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


def test_files_are_held_against_their_digests(run, tmp_path_factory):
    def check_refused(said):
        for read in (run.files.read, run.files.check):
            with pytest.raises(DamagedFileError, match=rf"0\.monitor\.csv {said}"):
                read(csv)

    csv, elsewhere = run.path / "0.monitor.csv", tmp_path_factory.mktemp("elsewhere")
    assert run.files.read(csv) == b"r,l,t\n"
    csv.write_bytes(b"r,l,u\n")
    check_refused("is not as the run left it")
    with pytest.raises(UserError, match=r"left it: train again, or name another copy of it$"):
        check_digest(run, csv)
    (elsewhere / "link").symlink_to(run.path)
    with pytest.raises(DamagedFileError):
        Run(elsewhere / "link", "Lake-v1").files.check(csv)
    csv.unlink()
    check_refused("is missing")
    (elsewhere / csv.name).write_bytes(b"r,l,t\n")
    csv.symlink_to(elsewhere / csv.name)
    check_refused("is no regular file: it is a link")
    csv.unlink()
    os.mkfifo(csv)
    with pytest.raises(DamagedFileError, match="is no regular file"):
        read_record(csv)


def test_files_of_the_user_are_nobodys_business(run):
    (run.path / "notes.txt").write_text("mine")
    (run.path / "1.monitor.csv").write_text("mine")
    (run.path / "notes.txt").write_text("mine, changed")
    run.files.check(run.path / "notes.txt")
    check_digest(run, run.path.parent / "elsewhere.zip")
    check_digest(None, run.path / "0.monitor.csv")
    # What the run did not leave is not read as if it had.
    assert [path.name for path in run.files.matching("*.monitor.csv")] == ["0.monitor.csv"]


def test_a_run_of_an_earlier_version_is_taken_as_it_is(tmp_path):
    run = Run(tmp_path, "Lake-v1")
    run.update_info(state="finished")
    (tmp_path / "0.monitor.csv").write_bytes(b"anything")
    assert run.files.digests is None
    assert run.files.read(tmp_path / "0.monitor.csv") == b"anything"
    run.files.check(tmp_path / "0.monitor.csv")
    assert [path.name for path in run.files.matching("*.csv")] == ["0.monitor.csv"]


# --- arrays --------------------------------------------------------------------------------------
PATH = Path("run/evaluations.npz")


def archive(save=np.savez, **arrays):
    stream = io.BytesIO()
    save(stream, **arrays)
    return stream.getvalue()


def zipped(members, **options):
    stream = io.BytesIO()
    with zipfile.ZipFile(stream, "w", **options) as file:
        for name, content in members:
            file.writestr(name, content)
    return stream.getvalue()


def npy(array):
    stream = io.BytesIO()
    np.save(stream, array)
    return stream.getvalue()


@given(
    array=np_st.arrays(
        st.sampled_from(["?", "i1", "<u4", ">i8", "<f2", ">f8"]), np_st.array_shapes(min_dims=0)
    ),
    is_fortran=st.booleans(),
    save=st.sampled_from([np.savez, np.savez_compressed]),
)
def test_what_numpy_writes_is_read_as_numpy_does(array, is_fortran, save):
    array = np.asfortranarray(array) if is_fortran and array.ndim else array
    (found,) = read_arrays(PATH, archive(save, a=array)).values()
    assert found.dtype == array.dtype
    assert found.flags.writeable
    assert np.array_equal(found, array, equal_nan=array.dtype.kind == "f")


def header(shape):
    text = f"{{'descr': '<f8', 'fortran_order': False, 'shape': {shape}, }}".ljust(117) + "\n"
    return b"\x93NUMPY\x01\x00" + len(text).to_bytes(2, "little") + text.encode()


GOOD = npy(np.arange(3.0))


@pytest.mark.parametrize(
    ("content", "reason"),
    [
        (b"", "not a zip file"),
        (b"PK\x03\x04", "not a zip file"),
        (archive(a=np.arange(9))[:-30], "not a zip file"),
        (archive(a=np.array([{}], object)), "Object arrays cannot be loaded"),
        (archive(a=np.array(["text"])), "where numbers belong"),
        (archive(a=np.array([1j])), "complex128 where numbers belong"),
        (archive(a=np.zeros(1, "M8[s]")), "where numbers belong"),
        (archive(a=np.zeros(1, [("x", "f8")])), "where numbers belong"),
        (zipped([("a.txt", b"")]), "what is no array"),
        (zipped([("a.npy", b"")]), "what is no array"),
        (zipped([("a.npy", b"\x93NUMPY\x03\x00")]), "EOF"),
        (zipped([("a.npy", header("(1000000000000,)"))]), "Unable to allocate|EOF"),
        (zipped([("a.npy", header("(9000,)") + bytes(8))]), "EOF"),
        (zipped([("a.npy", header("(-1,)") + bytes(8))]), "negative"),
        (zipped([("a.npy", header("(1L,)") + bytes(8))]), "Python 2"),
        (zipped([("a.npy", header("(1") + bytes(8))]), "parse|EOF"),
        (zipped([("a.npy", GOOD)], compression=zipfile.ZIP_BZIP2), "compressed in a way"),
        (zipped([(f"{i}.npy", GOOD) for i in range(1001)]), "too many of them"),
    ],
)
def test_anything_else_is_refused_in_one_line(content, reason):
    with pytest.raises(DamagedFileError, match=reason) as caught:
        read_arrays(PATH, content)
    assert str(caught.value).startswith("run/evaluations.npz is damaged: ")


def test_a_bomb_is_not_unpacked():
    small = archive(np.savez_compressed, a=np.zeros(1_000_000))
    assert read_arrays(PATH, small)["a"].size == 1_000_000
    bomb = archive(np.savez_compressed, a=np.zeros(10_000_000))
    with pytest.raises(DamagedFileError, match="would take more memory than 4 times its"):
        read_arrays(PATH, bomb)
    # One that is stored as it is may be of any size.
    assert read_arrays(PATH, archive(a=np.zeros(10_000_000)))["a"].size == 10_000_000


# --- files that are there whole, or as before ----------------------------------------------------


def test_the_draft_lies_beside_and_the_old_file_stays_until_the_end(tmp_path):
    path = tmp_path / "model.zip"
    path.write_text("old")
    with files.replacing(path) as file:
        file.write(b"new")
        # Only a file of the same folder can be renamed into place in one step.
        draft, other = names(tmp_path)
        assert draft.startswith(".model.zip.")
        assert other == "model.zip"
        assert path.read_text() == "old"
    assert path.read_text() == "new"
    assert names(tmp_path) == ["model.zip"]
    # Nobody can tell its name: a link there would lead what is written to another's file.
    with files.replacing(path), files.replacing(path):
        assert len({draft, *names(tmp_path)}) == 4


@pytest.mark.parametrize("error", [OSError, KeyboardInterrupt])
@pytest.mark.parametrize("old", ["old", None])
def test_a_writer_that_fails_changes_nothing(tmp_path, error, old):
    path = tmp_path / "model.zip"
    if old is not None:
        path.write_text(old)
    with pytest.raises(error), files.replacing(path) as file:  # noqa: PT012  # half of it is the point
        file.write(b"half")
        raise error
    assert names(tmp_path) == ([] if old is None else ["model.zip"])
    assert old is None or path.read_text() == old


@pytest.mark.parametrize(
    ("n_refused", "platform_", "tries"),
    [(0, "linux", 1), (99, "linux", 1), (0, "win32", 1), (3, "win32", 4), (99, "win32", 6)],
)
def test_what_a_scanner_of_windows_holds_is_renamed_soon_or_an_error(
    tmp_path, monkeypatch, n_refused, platform_, tries
):
    tried, replace = [], os.replace

    def refusing(path, target, **folders):
        tried.append(target)
        if len(tried) <= n_refused:
            raise PermissionError(errno.EACCES, "is being used by another process")
        return replace(path, target, **folders)

    monkeypatch.setattr(os, "replace", refusing)
    monkeypatch.setattr(files.time, "sleep", lambda seconds: None)
    monkeypatch.setattr(sys, "platform", platform_)
    (tmp_path / "draft").write_text("new")
    if n_refused == 99:
        with pytest.raises(PermissionError):
            files.put_in_place(tmp_path / "draft", tmp_path / "file")
    else:
        files.put_in_place(tmp_path / "draft", tmp_path / "file")
        assert (tmp_path / "file").read_text() == "new"
    assert len(tried) == tries


def test_a_folder_that_is_gone_is_not_made_anew(tmp_path):
    """Some libraries would do that in `write`, and leave a run in two places."""
    path = tmp_path / "gone" / "a.zip"
    with (
        pytest.raises(FileNotFoundError, match="its folder is gone"),
        files.replacing(path) as draft,
    ):
        draft.parent.mkdir()
    assert not path.parent.exists()


# --- names and JSON ------------------------------------------------------------------------------
DEVICES = {"CON", "PRN", "AUX", "NUL", "CONIN$", "CONOUT$"}
DEVICES |= {f"{port}{digit}" for port in ("COM", "LPT") for digit in "0123456789¹²³"}
NAMES = st.text(st.characters(exclude_categories=["Cs"])) | st.sampled_from(
    [*DEVICES, "con", "Nul.txt", "aux .zip", "com1.a.b", "a.", "a ", ".", "..", "a:b", "a/b", "a?b"]
)


def is_acceptable(name):
    """The rules of Windows, which are the strictest, and Linux's for the length."""
    base = name.partition(".")[0].rstrip(" ").upper()
    return (
        0 < len(name.encode()) <= 255
        and not set(name) & {*'<>:"/\\|?*', *map(chr, range(32))}
        and not name.endswith((" ", "."))
        and base not in DEVICES
    )


@given(NAMES | st.text(min_size=100, max_size=400))
@example("COM¹.x")
def test_a_name_is_one_that_every_system_takes(name):
    portable = files.portable_name(name)
    assert is_acceptable(portable)
    assert files.portable_name(portable) == portable
    assert len(portable.encode()) <= 100
    if is_acceptable(name) and len(name.encode()) <= 100:
        assert portable == name


@given(NAMES, NAMES)
@example("CON", "con")
@example("a:", "a?")
@example("a.", "a")
@example("x" * 150, "x" * 151)
def test_two_names_stay_two(first, second):
    assume(first != second)
    a, b = files.portable_name(first), files.portable_name(second)
    # Names that a system takes as they are may differ in upper and lower case alone.
    assert a != b
    if (a, b) != (first, second):
        assert a.casefold() != b.casefold()


leaves = st.none() | st.booleans() | st.integers() | st.floats(allow_nan=False) | st.text()
values = st.recursive(
    leaves, lambda inner: st.lists(inner) | st.dictionaries(st.text(), inner), max_leaves=10
)


def strictly(text):
    """The value of a text that a strict reader takes."""

    def refuse(name):
        raise AssertionError(f"{name} is no JSON")

    return json.loads(text, parse_constant=refuse)


@given(values)
def test_what_is_written_is_read_again_as_it_was(value):
    assert strictly(files.json_text(value)) == value


def test_what_is_no_json_is_written_as_the_nearest_that_is():
    odd = {
        "nan": math.nan,
        "limits": (-math.inf, np.float32(np.inf)),
        "array": np.arange(3, dtype=np.int8),
        "NaN, Infinity": "NaN",
        "surrogate": "\udcff",
        1: np.bool_(True),
    }
    assert strictly(files.json_text(odd, indent=2)) == {
        "nan": None,
        "limits": [-math.inf, math.inf],
        "array": [0, 1, 2],
        "NaN, Infinity": "NaN",
        "surrogate": "\udcff",
        "1": True,
    }
    with pytest.raises(TypeError, match="object"):
        files.plain([object()])
