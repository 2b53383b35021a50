"""What was left half written goes; what others are at, and what goes meanwhile, is no trouble."""

import os
from pathlib import Path

from pipeline.locks import remove_remains

REMAINS = f".x.{16 * '0'}.tmp"
GRAVE = f".lock.{32 * 'a'}.dead.tmp"


def long_ago(path):
    os.utime(path, (1, 1))


def test_old_remains_go_and_all_else_stays(tmp_path):
    (tmp_path / "run").mkdir()
    for folder in (tmp_path, tmp_path / "run"):
        (folder / REMAINS).touch()
        (folder / "kept.tmp").touch()
        (folder / f".new.{16 * '1'}.tmp").touch()
        for name in (REMAINS, "kept.tmp"):
            long_ago(folder / name)
    (tmp_path / GRAVE).mkdir()
    long_ago(tmp_path / GRAVE)
    remove_remains(tmp_path)
    left = sorted(path.relative_to(tmp_path).as_posix() for path in tmp_path.rglob("*"))
    new = f".new.{16 * '1'}.tmp"
    assert left == sorted(["run", "kept.tmp", new, "run/kept.tmp", f"run/{new}"])


def test_a_folder_may_go_while_it_is_looked_through(tmp_path, monkeypatch):
    """As the grave of a lock does, when another process has dug it."""
    (tmp_path / GRAVE).mkdir()
    list_all = Path.iterdir

    def going(folder):
        found = list(list_all(folder))
        if tmp_path / GRAVE in found:
            (tmp_path / GRAVE).rmdir()
        return iter(found)

    monkeypatch.setattr(Path, "iterdir", going)
    remove_remains(tmp_path)
    remove_remains(tmp_path / "nowhere")
    monkeypatch.undo()
    assert list(tmp_path.iterdir()) == []
