"""Packs of studies: what is in them and what is not, that they play elsewhere, and are no code."""

import base64
import csv
import gzip
import hashlib
import io
import json
import os
import re
import shutil
import stat
import zipfile
from pathlib import Path

import pytest
from rich.console import Console

from pipeline.digests import LOCK
from pipeline.errors import UserError
from pipeline.locks import mark
from pipeline.models.choose import ModelRequest, choose_model
from pipeline.packs import check_pack, is_study, pack_study, unpacked
from pipeline.settings.hyperparams import split
from pipeline.train_spec import TrainSpec
from pipeline.training import train
from safe_files.files import UnsafeFileError

RUN = "runs/qlearning/FrozenLake-v1_2.zip"
HOME = str(Path.home())


def packed_text(text):
    return base64.b64encode(gzip.compress(text.encode(), mtime=0)).decode()


@pytest.fixture(scope="module")
def trained(tmp_path_factory):
    entry = {"n_timesteps": 2000, "env_kwargs": {"is_slippery": False}}
    folder = tmp_path_factory.mktemp("logs")
    spec = TrainSpec("qlearning", "FrozenLake-v1", split(entry), entry, 0, log_folder=folder)
    return train(spec, Console(quiet=True), {}, "train.py").run.path


@pytest.fixture
def study(trained, tmp_path):
    """The folder of a study, as compare.py leaves it, by a command that was typed at home."""
    root = tmp_path / "a study"
    for place in (
        "qlearning/FrozenLake-v1_1",
        "qlearning/FrozenLake-v1_2",
        "sarsa/FrozenLake-v1_1",
    ):
        shutil.copytree(trained, root / "runs" / place)
    shutil.copytree(trained, root / "runs/sarsa/FrozenLake-v1_1.damaged-1")
    command = f"python {HOME}/code/compare.py --env-kwargs desc:{HOME}/map.txt"
    data = packed_text(json.dumps({"command": command}))
    (root / "report.html").write_text(
        f"<p>{command}</p><script>let a = '/home'</script><script id='x'>{data}</script>"
    )
    (root / "summary.csv").write_text(f"agent,path\nq,{HOME}/a/runs/qlearning/FrozenLake-v1_1\n")
    (root / "study.yml").write_text("agents: [qlearning]\n")
    for name in (
        "figures/a.png",
        "learning/a/b.html",
        "figures/notes.txt",
        "failures/a.txt",
        "mine.html",
        "looks.json",
    ):
        (root / name).parent.mkdir(parents=True, exist_ok=True)
        (root / name).write_bytes(b"x")
    return root


@pytest.fixture
def packed(study, tmp_path):
    pack_study(study, tmp_path / "study.zip", print)
    return tmp_path / "study.zip"


def members(path):
    with zipfile.ZipFile(path) as archive:
        return {name: archive.read(name) for name in archive.namelist()}


def test_it_holds_what_others_need_and_nothing_of_this_machine(study, packed, tmp_path):
    files = members(packed)
    runs = [RUN, RUN.replace("_2", "_1"), "runs/sarsa/FrozenLake-v1_1.zip"]
    names = "README.md report.html summary.csv study.yml figures/a.png learning/a/b.html study.json"
    assert files.keys() == {*runs, *names.split()}
    page = files["report.html"].decode()
    told = "python compare.py --env-kwargs desc:map.txt"
    assert re.findall("<p>(.*?)</p><script>(.*?)</script>", page) == [(told, "let a = '/home'")]
    data = re.search("<script id='x'>(.*)</script>", page)[1]
    assert json.loads(gzip.decompress(base64.b64decode(data))) == {"command": told}
    rows = list(csv.DictReader(io.StringIO(files["summary.csv"].decode())))
    assert [row["path"] for row in rows] == ["runs/qlearning/FrozenLake-v1_1.zip"]
    assert rows[0]["path"] in files
    card = files["README.md"].decode()
    assert "3 runs" in card
    assert "| qlearning | FrozenLake-v1 | 2 | runs/qlearning/FrozenLake-v1_1.zip |" in card
    assert check_pack(packed) == len(files)
    before = packed.read_bytes()
    pack_study(study, packed, print)
    assert packed.read_bytes() == before
    assert sorted(path.name for path in tmp_path.iterdir()) == ["a study", "study.zip"]
    assert not (study / LOCK).exists()


@pytest.mark.parametrize("inside", [RUN, RUN.removesuffix(".zip")])
def test_a_run_in_it_is_played(packed, inside):
    with unpacked(packed / inside) as (folder, zipped_in):
        chosen = choose_model(ModelRequest(path=folder, zipped_in=zipped_in))
        assert (chosen.spec.algo, chosen.spec.env_id) == ("qlearning", "FrozenLake-v1")
        assert zipped_in == packed
    assert not folder.exists()


def test_which_run_is_asked(packed):
    for path in (packed, packed / "runs" / "x"):
        with pytest.raises(UserError, match=r"such as .*study\.zip/runs/qlearning/FrozenLake-v1_1"):
            unpacked(path).__enter__()


def outside(path, secret):
    path.unlink()
    path.symlink_to(secret)


@pytest.mark.parametrize(
    ("change", "complaint"),
    [
        (lambda root, _: shutil.rmtree(root / "runs"), "holds no finished run"),
        (lambda root, secret: outside(root / "report.html", secret), r"html .* link"),
        (lambda root, secret: outside(root / "figures/a.png", secret), r"png .* link"),
        (
            lambda root, secret: outside(root / "runs/sarsa/FrozenLake-v1_1/run.json", secret),
            r"json .* link",
        ),
        (lambda root, _: os.mkfifo(root / "verdicts.md"), "is no regular file"),
        (
            lambda root, _: (root / "runs/sarsa/FrozenLake-v1_1/FrozenLake-v1.zip").write_bytes(
                b""
            ),
            "is not as the run left it",
        ),
        (lambda root, _: (root / "summary.csv").write_text("a,b\n"), "summary.csv is damaged"),
        (
            lambda root, _: (root / "curves.csv.gz").write_bytes(gzip.compress(HOME.encode())),
            r"curves\.csv\.gz names .* nothing was packed",
        ),
        (
            lambda root, _: (root / "figures/a.png").write_text(f"{HOME}/x"),
            r"figures/a\.png names .* nothing was packed",
        ),
        (
            lambda root, _: (root / LOCK).write_text(json.dumps({**mark(), "token": "x"})),
            "is at work on it",
        ),
    ],
)
def test_what_is_not_packed(study, tmp_path, change, complaint):
    (tmp_path / "secret").write_text("secret")
    change(study, tmp_path / "secret")
    with pytest.raises((UserError, UnsafeFileError), match=complaint):
        pack_study(study, tmp_path / "study.zip", print)
    assert sorted(path.name for path in tmp_path.iterdir()) == ["a study", "secret"]


def test_a_folder_is_no_place_for_it(study, tmp_path):
    with pytest.raises(UserError, match=r"name it there\.zip"):
        pack_study(study, tmp_path / "there", print)
    with pytest.raises(UserError, match="there is no folder"):
        pack_study(study, tmp_path / "no" / "there.zip", print)
    assert is_study(study)
    assert not is_study(study / "runs/qlearning/FrozenLake-v1_1")


# --- packs of strangers ---------------------------------------------------------------------------


def sealed(files):
    digests = {n: hashlib.sha256(c).hexdigest() for n, c in files.items() if n != "study.json"}
    return {**files, "study.json": json.dumps({"files": digests}).encode()}


def rewrite(path, files, mode=0):
    with zipfile.ZipFile(path, "w") as archive:
        for name, content in files.items():
            info = zipfile.ZipInfo(name)
            info.external_attr = (mode if name == "runs/odd" else 0) << 16
            archive.writestr(info, content, zipfile.ZIP_DEFLATED)


@pytest.mark.parametrize(
    ("changes", "mode", "complaint"),
    [
        ({"../odd": b""}, 0, "'../odd', which would lie elsewhere"),
        ({"/odd": b""}, 0, "'/odd', which would lie elsewhere"),
        ({"runs/a/b/odd": b""}, 0, "'runs/a/b/odd', which would lie elsewhere"),
        ({"runs/odd": b"/etc/passwd"}, stat.S_IFLNK | 0o777, "which is no regular file"),
        ({"readme.md": b""}, 0, "two names that some systems take for one"),
        ({RUN: bytes(90 << 20)}, 0, "would take more memory than"),
        ({RUN: b"PK"}, 0, "is no pack that may be opened"),
    ],
)
def test_hostile_packs_are_refused(packed, tmp_path, changes, mode, complaint):
    """Their digests fit, as a forger's would."""
    rewrite(packed, sealed({**members(packed), **changes}), mode)
    if changes != {RUN: b"PK"}:
        with pytest.raises(UserError, match=complaint):
            check_pack(packed)
    with pytest.raises(UserError, match=complaint):
        unpacked(packed / RUN).__enter__()
    assert not list(tmp_path.rglob("*odd*"))


def test_what_a_zip_says_of_its_size_is_not_believed(packed):
    """A member that says of itself that it takes a gigabyte before it is unpacked, too."""
    rewrite(packed, sealed({**members(packed), RUN: bytes(90 << 20)}))
    content = bytearray(packed.read_bytes())
    place = content.rindex(RUN.encode(), 0, content.rindex(b"PK\5\6")) - 46
    assert content[place : place + 4] == b"PK\1\2"
    content[place + 20 : place + 24] = (1 << 30).to_bytes(4, "little")
    packed.write_bytes(content)
    with pytest.raises(UserError, match="would take more memory than"):
        unpacked(packed / RUN).__enter__()


@pytest.mark.parametrize(
    "changes",
    [{"report.html": b"other"}, {"more.py": b""}, {"study.json": b"[]"}, {"study.json": b"{"}],
)
def test_what_was_changed_is_found(packed, changes):
    rewrite(packed, {**members(packed), **changes})
    with pytest.raises(UserError, match="is not as it was packed"):
        check_pack(packed)
