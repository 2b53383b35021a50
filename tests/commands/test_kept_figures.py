"""``--keep figures``: the same figures from a file, whatever is killed, damaged or made again."""

import base64
import gzip
import re
import shutil
import sqlite3
import subprocess
import sys
import time
from contextlib import closing, suppress
from pathlib import Path

import numpy as np
import pandas as pd
import pytest
from hypothesis import given
from hypothesis import strategies as st

import compare
from experiments.figures_store import checksum_of, packed, unpacked
from experiments.results import difference
from pipeline.runs import Run

ROOT = Path(compare.__file__).parent
NAME = "FrozenLake-v1_qlearning-sarsa"
TWO = ["--env", "FrozenLake-v1", "--algos", "qlearning", "sarsa", "--n-episodes", "30"]
KEEP = [*TWO, "--no-report", "--keep", "figures", "-j", "2"]
TIMES = ["seconds", "cpu_seconds", "path"]


@pytest.fixture
def typed(type_study, own_folder):
    """Run a command; what it says, provided that it ends with the code."""

    def run(*words, code=0):
        found, out, err = type_study(*words)
        assert found == code, err
        return " ".join((out + err).split())

    return run


def folders(study, agent="qlearning"):
    return sorted(path.name for path in (study / "runs" / agent).iterdir() if path.is_dir())


def summary(study):
    return pd.read_csv(study / "summary.csv").drop(columns=TIMES)


def rows_of(study, agent="qlearning"):
    with closing(sqlite3.connect(study / "runs" / agent / "FrozenLake-v1.sqlite")) as database:
        return [seed for (seed,) in database.execute("SELECT seed FROM runs ORDER BY seed")]


@pytest.fixture(scope="module")
def made(tmp_path_factory):
    return tmp_path_factory.mktemp("made"), []


@pytest.fixture
def both(made, typed, own_folder):
    """A study of 12 seeds with all folders, and a copy of it with a file in their place."""
    place, said = made
    if not said:
        typed(*TWO, "--seeds", 12, "-f", "all")
        shutil.copytree("all", "few")
        said.append(typed(*TWO, "--seeds", 12, "-f", "few", "--keep", "figures"))
        shutil.copytree("all", place / "all")
        shutil.copytree("few", place / "few")
    else:
        shutil.copytree(place / "all", "all")
        shutil.copytree(place / "few", "few")
    return own_folder / "all" / NAME, own_folder / "few" / NAME, said[0]


def in_all(text):
    """A page or table as of the other folder."""
    return re.sub(r" -(\{\})?-keep figures", "", text.replace("few", "all"))


def parts_of(page):
    """The sections of a page, and what its scripts work with, unpacked."""
    for part in re.split(r"(?=<section |<script)", page.read_text(encoding="utf-8")):
        name, _, content = part.partition(">")
        if "data-packed" in name:
            packed_text = content.partition("</script>")[0]
            yield in_all(name + gzip.decompress(base64.b64decode(packed_text)).decode())
        else:
            yield in_all(part)


def test_tables_verdicts_and_page_are_those_of_folders_to_the_bit(both):
    """But for the page's maps, which are of other runs."""
    all_there, few, said = both
    assert "24 runs, 24 of them there already" in said
    for name in ("summary.csv", "verdicts.md", "verdicts.tex"):
        texts = [(study / name).read_text(encoding="utf-8") for study in (all_there, few)]
        assert texts[0] == in_all(texts[1]), name
    curves = [gzip.decompress((study / "curves.csv.gz").read_bytes()) for study in (all_there, few)]
    assert curves[0].count(b"\n") > 1000
    assert curves[0] == curves[1]
    for path in (all_there / "figures").glob("*.png"):
        assert path.read_bytes() == (few / "figures" / path.name).read_bytes()
    assert rows_of(few) == list(range(12))
    assert len(folders(all_there)) == 12
    assert 1 <= len(folders(few)) <= 6
    assert "FrozenLake-v1_1" in folders(few)
    pages = [list(parts_of(study / "report.html")) for study in both[:2]]
    assert len(pages[0]) == len(pages[1]) > 15
    differ = [one[:80] for one, other in zip(*pages, strict=True) if one != other]
    assert all('id="data-policies' in part for part in differ), differ


def test_a_run_is_made_again_to_the_bit(both, typed):
    all_there, few, _ = both
    name = next(name for name in folders(all_there) if name not in folders(few))
    seed = int(name.rpartition("_")[2]) - 1
    words = [*TWO, "--seeds", 12, "-f", "few", "--keep", "figures"]
    assert name in typed(*words, "--make-again", f"qlearning:{seed}")
    one, other = (study / "runs" / "qlearning" / name for study in (all_there, few))
    assert difference(Run(one, "FrozenLake-v1"), Run(other, "FrozenLake-v1")) == ""
    for file in ("evaluations.npz", "value_maps.npz"):
        arrays = [np.load(folder / file) for folder in (one, other)]
        assert all(arrays[0][key].tobytes() == arrays[1][key].tobytes() for key in arrays[0])
    typed(*words, "--no-report")
    assert name in folders(few)  # it stays
    said = typed(*words, "--make-again", "qlearning:99", code=2)
    assert "the study has no single run qlearning:99" in said
    assert "did you mean 'sarsa'?" in typed(*words, "--make-again", "sarse:1", code=2)


def test_a_run_that_comes_out_otherwise_is_told(both, typed):
    _, study, _ = both
    seed = next(s for s in range(12) if f"FrozenLake-v1_{s + 1}" not in folders(study))
    path = study / "runs" / "qlearning" / "FrozenLake-v1.sqlite"
    with sqlite3.connect(path) as database:
        row = list(database.execute("SELECT * FROM runs WHERE seed = ?", (seed,)).fetchone())
        (origin,) = database.execute("SELECT content FROM origins").fetchone()
        row[-2] = bytes(16)  # the digest of another agent
        row[-1] = checksum_of(seed, origin, row[2:-1])
        change = "UPDATE runs SET model = ?, checksum = ? WHERE seed = ?"
        database.execute(change, (*row[-2:], seed))
    said = typed(*KEEP, "--seeds", 12, "-f", "few", "--make-again", f"qlearning:{seed}", code=1)
    assert f"seed {seed}: came out differently than the first time" in said
    assert f"FrozenLake-v1_{seed + 1}.otherwise" in folders(study)


def test_after_a_kill_no_run_is_lost_or_counted_twice(both, typed, own_folder):
    all_there, _, _ = both
    words, study = [*KEEP, "--seeds", 40, "-f", "killed"], own_folder / "killed" / NAME
    command = [sys.executable, str(ROOT / "compare.py"), *map(str, words)]
    (study / "runs/qlearning").mkdir(parents=True)
    process = subprocess.Popen(
        command, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, start_new_session=True
    )
    deadline, n_seen = time.monotonic() + 120, 0
    while n_seen < 3:
        assert process.poll() is None
        assert time.monotonic() < deadline
        time.sleep(0.02)
        with suppress(sqlite3.OperationalError):  # not there yet, or being written
            n_seen = len(rows_of(study))
    process.kill()
    process.communicate()
    assert 3 <= len(rows_of(study)) < 40
    typed(*words)
    for agent in ("qlearning", "sarsa"):
        assert rows_of(study, agent) == list(range(40))
        assert len(folders(study, agent)) <= 7
    table = summary(study)
    first = table[table["seed"] < 12].reset_index(drop=True)
    pd.testing.assert_frame_equal(summary(all_there), first, check_dtype=False)


def test_what_a_kill_between_commit_and_removal_leaves_is_removed(both, typed):
    all_there, few, _ = both
    before = folders(few)
    name = next(name for name in folders(all_there) if name not in before)
    shutil.copytree(all_there / "runs" / "qlearning" / name, few / "runs" / "qlearning" / name)
    words = [*KEEP, "--seeds", 12, "-f", "few"]
    assert "24 runs, 24 of them there already" in typed(*words)
    assert folders(few) == before
    assert len(summary(few)) == 24


def changed(path, order):
    with sqlite3.connect(path) as database:
        database.execute(order)


DAMAGE = {
    "a figure": lambda path: changed(path, "UPDATE runs SET final = final + 0.5 WHERE seed = 3"),
    "half of it": lambda path: path.write_bytes(path.read_bytes()[: path.stat().st_size // 2]),
    "another table": lambda path: changed(path, "CREATE VIEW more AS SELECT 1"),
}


@pytest.mark.parametrize("damage", DAMAGE)
def test_a_damaged_file_is_named_and_repaired(both, typed, damage):
    _, few, _ = both
    path = few / "runs" / "qlearning" / "FrozenLake-v1.sqlite"
    before = summary(few)
    DAMAGE[damage](path)
    words = [*KEEP, "--seeds", 12, "-f", "few"]
    said = typed(*words, code=2)
    assert "few/" + str(path.relative_to(few.parent)) + " is damaged: " in said
    assert "--repair" in said
    assert "Traceback" not in said
    said = typed(*words, "--repair")
    assert "FrozenLake-v1.sqlite.damaged-1" in said
    assert path.with_name("FrozenLake-v1.sqlite.damaged-1").exists()
    pd.testing.assert_frame_equal(summary(few), before)


def test_stored_runs_of_other_settings_are_replaced_only_when_asked(both, typed):
    _, few, _ = both
    other = [*KEEP, "--seeds", 12, "-f", "few", "-params", "gamma:0.9"]
    said = typed(*other, code=2)
    assert "24 finished runs have other settings (gamma: 0.995 there, 0.9 now)" in said
    assert "24 runs, 0 of them there already" in typed(*other, "--replace")
    moved = sorted(path.parent.name for path in few.glob("replaced/*/*/*.sqlite"))
    assert moved == ["qlearning", "sarsa"]
    assert rows_of(few) == list(range(12))


def test_stored_runs_stay_done_without_the_flag_and_with_more_seeds(both, typed):
    all_there, few, _ = both
    words = [*TWO, "--no-report", "--seeds", 13]
    assert "26 runs, 24 of them there already" in typed(*words, "-f", "few")
    assert "FrozenLake-v1_13" in folders(few)
    typed(*words, "-f", "all")
    pd.testing.assert_frame_equal(summary(few), summary(all_there))


def test_the_threshold_may_change_later(both, typed):
    text = "seeds: 12\nn_episodes: 30\nthreshold: 0.02\nagents: [qlearning, sarsa]\n"
    text += "environments: [FrozenLake-v1]\n"
    Path(f"{NAME}.yml").write_text(text)
    for folder in ("few", "all"):
        typed(f"{NAME}.yml", "--no-report", "-f", folder)
    one, other = summary(both[0]), summary(both[1])
    assert (one["threshold"] == 0.02).all()
    assert np.isfinite(one["steps_to_stay"]).any()
    pd.testing.assert_frame_equal(one, other)


def test_runs_on_bandits_keep_their_folders(typed, own_folder):
    words = ["--env", "BernoulliBandit-v0", "--algos", "ucb", "qlearning", "--seeds", 2, "-n", 60]
    typed(*words, "--no-report", "--keep", "figures", "-f", "few")
    (study,) = (own_folder / "few").iterdir()
    assert not list(study.rglob("*.sqlite"))
    assert folders(study) == ["BernoulliBandit-v0_1", "BernoulliBandit-v0_2"]


def test_what_needs_whole_runs_is_refused(typed):
    for flag in (["--episodes-table", 10], ["--tensorboard"]):
        said = typed(*KEEP, "--seeds", 2, *flag, code=2)
        assert f"{flag[0]} needs more of each run than --keep figures keeps" in said


FLOATS = st.lists(st.floats(width=64) | st.integers(-(2**60), 2**60).map(float))


@given(st.lists(FLOATS, min_size=1, max_size=8))
def test_columns_come_back_to_the_bit(columns):
    arrays = [np.array(column, dtype=np.float64) for column in columns]
    again = unpacked(packed(arrays))
    assert [one.tobytes() for one in again] == [one.tobytes() for one in arrays]
