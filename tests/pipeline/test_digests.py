"""What a run says of its files, and what becomes of files that are not so any more."""

import hashlib
import io
import json
import os
import subprocess
import zipfile
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra import numpy as np_st

from pipeline.digests import DamagedFileError, read_arrays, read_record, sealed
from pipeline.errors import UserError
from pipeline.models.find import check_digest
from pipeline.runs import Run


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


def test_the_digests_are_those_of_sha256sum(run):
    files = run.read_info()["files"]
    assert list(files) == ["0.monitor.csv", "Lake-v1/config.yml", "run.json"]
    known = subprocess.run(  # a fixed command
        ["/usr/bin/sha256sum", "0.monitor.csv", "Lake-v1/config.yml"],
        cwd=run.path,
        capture_output=True,
        text=True,
        check=True,
    )
    assert known.stdout == "".join(f"{files[name]}  {name}\n" for name in list(files)[:2])


def test_the_record_has_a_digest_of_its_own(run):
    record = json.loads(run.info_path.read_text())
    own = record["files"].pop("run.json")
    text = json.dumps(record, sort_keys=True, separators=(",", ":"))
    assert own == hashlib.sha256(text.encode()).hexdigest()
    assert record["steps"] == [1, 2]


def test_a_record_may_be_written_again(run):
    run.update_info(state="failed")
    assert run.read_info()["state"] == "failed"
    assert sealed({"state": "running"}) == {"state": "running"}


@pytest.mark.parametrize(
    ("old", "new"),
    [
        ('"finished"', '"finishee"'),
        ("0.1", "0.3"),
        ("Lake-v1/config.yml", "Lake-v1/confic.yml"),
        ('"run.json"', '"run.jsom"'),
        ('"steps"', '"stepz"'),
    ],
)
def test_a_changed_record_is_refused(run, old, new):
    text = run.info_path.read_text()
    assert text.count(old) == 1
    run.info_path.write_text(text.replace(old, new))
    with pytest.raises(UserError, match=r"run\.json is damaged: it is not as the run left it"):
        run.read_info()


@pytest.mark.parametrize("field", ["files", "record_version"])
def test_a_record_that_lost_its_digests_is_no_record_of_an_earlier_version(run, field):
    """One letter of a name is enough to lose them."""
    text = run.info_path.read_text()
    run.info_path.write_text(text.replace(f'"{field}"', f'"{field[:-1]}?"'))
    with pytest.raises(DamagedFileError, match=r"run\.json is damaged: it "):
        run.read_info()
    record = json.loads(text)
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
def test_odd_records(tmp_path, content):
    path = tmp_path / "run.json"
    path.write_bytes(content)
    with pytest.raises(DamagedFileError, match=r"run\.json is damaged: "):
        read_record(path)


def test_a_record_that_is_no_file(tmp_path):
    folder, pipe = tmp_path / "folder", tmp_path / "pipe"
    folder.mkdir()
    os.mkfifo(pipe)
    for path in (folder, pipe):
        with pytest.raises(DamagedFileError, match="is no regular file"):
            read_record(path)


def test_files_are_held_against_their_digests(run):
    csv = run.path / "0.monitor.csv"
    assert run.files.read(csv) == b"r,l,t\n"
    csv.write_bytes(b"r,l,u\n")
    for read in (run.files.read, run.files.check):
        with pytest.raises(DamagedFileError, match=r"0\.monitor\.csv is not as the run left it"):
            read(csv)
    with pytest.raises(UserError, match=r"left it: train again, or name another copy of it$"):
        check_digest(run, csv)
    csv.unlink()
    for read in (run.files.read, run.files.check):
        with pytest.raises(DamagedFileError, match=r"0\.monitor\.csv is missing"):
            read(csv)


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


def test_a_path_through_a_link_is_the_same_file(run, tmp_path_factory):
    link = tmp_path_factory.mktemp("links") / "run"
    link.symlink_to(run.path)
    (run.path / "0.monitor.csv").write_bytes(b"changed")
    with pytest.raises(DamagedFileError):
        Run(link, "Lake-v1").files.check(run.path / "0.monitor.csv")


def test_a_link_in_the_place_of_a_file_is_no_way_round_its_digest(run, tmp_path_factory):
    elsewhere = tmp_path_factory.mktemp("elsewhere") / "0.monitor.csv"
    elsewhere.write_bytes(b"another's")
    (run.path / "0.monitor.csv").unlink()
    (run.path / "0.monitor.csv").symlink_to(elsewhere)
    for read in (run.files.read, run.files.check):
        with pytest.raises(DamagedFileError, match="is no regular file: it is a link"):
            read(run.path / "0.monitor.csv")


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
