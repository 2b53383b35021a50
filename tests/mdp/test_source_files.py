"""A digest of sources stands for their names and for what they say, and for no other files."""

import subprocess
import sys

from mdp import source_files


def test_names_and_contents_count_and_other_files_do_not(tmp_path, monkeypatch):
    monkeypatch.setattr(source_files, "ROOT", tmp_path)

    def digest():
        paths = source_files.source_paths(["second", "first"])
        return source_files.digest_of(source_files.content_lines(paths))

    for name in ("first", "second", "third"):
        (tmp_path / name / "deep").mkdir(parents=True)
    rule = tmp_path / "first" / "deep" / "rule.py"
    rule.write_text("x = 1")
    (tmp_path / "second" / "other.py").write_text("")
    before = digest()
    (tmp_path / "third" / "rule.py").write_text("x = 2")
    (tmp_path / "first" / "notes.txt").write_text("x = 2")
    assert digest() == before
    rule.write_text("x = 2")
    changed = digest()
    rule.write_text("x = 1")
    assert digest() == before
    moved = rule.rename(tmp_path / "first" / "rule.py")
    assert len({before, changed, digest()}) == 3
    paths = source_files.source_paths(["second", "first"])
    assert paths == [moved, tmp_path / "second" / "other.py"]
    # As Windows would write it too.
    assert source_files.content_lines(paths)[0].startswith("first/rule.py ")


def test_what_a_state_was_made_by_is_known_without_the_compiler():
    code = """
import sys
from pipeline.source_digest import source_digest
assert len(source_digest()) == 16 and source_digest() != source_digest("experiments")
assert not {"numba", "scipy", "torch"} & sys.modules.keys()
"""
    subprocess.run([sys.executable, "-c", code], check=True)
