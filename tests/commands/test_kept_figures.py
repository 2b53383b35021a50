"""``--keep figures``: the same figures from a file, whatever is killed, damaged or made again."""

import gzip
import shutil
import sqlite3
from contextlib import closing
from pathlib import Path

import numpy as np
import pandas as pd
import pytest
from hypothesis import given
from hypothesis import strategies as st
from rl_yardstick.experiments.figures_store import checksum_of, packed, unpacked
from rl_yardstick.pipeline.runs import Run

from rl_yardstick.experiments.results import difference

NAME = "FrozenLake-v1_qlearning-sarsa"
TWO = ["--env", "FrozenLake-v1", "--algos", "qlearning", "sarsa", "--n-episodes", "30", "-j", "2"]
ALL = [*TWO, "--seeds", 5, "--no-report", "-f", "all"]
REPORT = [*TWO, "--seeds", 5, "--keep", "figures", "-f", "folded"]
FEW = [*REPORT, "--no-report"]
# Another threshold than before, and as many seeds, of the same study.
LATER = "seeds: 5\nn_episodes: 30\nthreshold: 0.02\nagents: [qlearning, sarsa]\n"
LATER += "environments: [FrozenLake-v1]\n"


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
    return pd.read_csv(study / "summary.csv").drop(columns=["seconds", "cpu_seconds", "path"])


def file_of(study):
    return study / "runs" / "qlearning" / "FrozenLake-v1.sqlite"


def rows_of(study):
    with closing(sqlite3.connect(file_of(study))) as database:
        return [seed for (seed,) in database.execute("SELECT seed FROM runs ORDER BY seed")]


@pytest.fixture(scope="module")
def made(tmp_path_factory):
    return tmp_path_factory.mktemp("made"), []


@pytest.fixture
def both(made, typed, own_folder, monkeypatch):
    """A study with all folders, and a copy of it with a file in their place and a page."""
    place, said = made
    if not said:
        monkeypatch.setattr(
            "rl_yardstick.report.figures.write_figures", lambda *_: []
        )  # which take longest
        monkeypatch.setattr("rl_yardstick.report.films.film_of", lambda _: None)
        typed(*ALL)
        shutil.copytree("all", "folded")
        said.append(typed(*REPORT))
        shutil.copytree("all", place / "all")
        shutil.copytree("folded", place / "folded")
    else:
        shutil.copytree(place / "all", "all")
        shutil.copytree(place / "folded", "folded")
    return own_folder / "all" / NAME, own_folder / "folded" / NAME, said[0]


def test_tables_are_those_of_folders_to_the_bit_also_for_a_later_threshold(both, typed):
    all_there, few, said = both
    assert "10 runs, 10 of them there already" in said
    assert 'id="data-policies' in (few / "report.html").read_text(encoding="utf-8")
    assert rows_of(few) == list(range(5))
    assert "FrozenLake-v1_1" in folders(few)
    assert len(folders(few)) < 5
    Path(f"{NAME}.yml").write_text(LATER)
    for folder in ("folded", "all"):
        typed(f"{NAME}.yml", "--no-report", "-f", folder)
    for name in ("summary.csv", "verdicts.md", "verdicts.tex"):
        texts = [(study / name).read_text(encoding="utf-8") for study in (all_there, few)]
        assert texts[0] == texts[1].replace("folded", "all"), name
    table = summary(few)
    assert (table["threshold"] == 0.02).all()
    assert np.isfinite(table["steps_to_stay"]).any()
    curves = [gzip.decompress((study / "curves.csv.gz").read_bytes()) for study in (all_there, few)]
    assert curves[0].count(b"\n") > 400
    assert curves[0] == curves[1]


def absent_of(all_there, few):
    """A run whose folder is gone, and its seed."""
    name = next(name for name in folders(all_there) if name not in folders(few))
    return name, int(name.rpartition("_")[2]) - 1


def test_a_run_is_made_again_to_the_bit_or_is_told_to_come_out_otherwise(both, typed):
    all_there, few, _ = both
    name, seed = absent_of(all_there, few)
    assert name in typed(*FEW, "--make-again", f"qlearning:{seed}")
    one, other = (study / "runs" / "qlearning" / name for study in (all_there, few))
    assert difference(Run(one, "FrozenLake-v1"), Run(other, "FrozenLake-v1")) == ""
    for file in ("evaluations.npz", "value_maps.npz"):
        arrays = [np.load(folder / file) for folder in (one, other)]
        assert all(arrays[0][key].tobytes() == arrays[1][key].tobytes() for key in arrays[0])
    typed(*FEW)
    assert name in folders(few)  # it stays
    said = typed(*FEW, "--make-again", "qlearning:99", code=2)
    assert "the study has no single run qlearning:99" in said
    shutil.rmtree(other)
    with sqlite3.connect(file_of(few)) as database:
        row = list(database.execute("SELECT * FROM runs WHERE seed = ?", (seed,)).fetchone())
        (origin,) = database.execute("SELECT content FROM origins").fetchone()
        row[-2] = bytes(16)  # the digest of another agent
        row[-1] = checksum_of(seed, origin, row[2:-1])
        change = "UPDATE runs SET model = ?, checksum = ? WHERE seed = ?"
        database.execute(change, (*row[-2:], seed))
    said = typed(*FEW, "--make-again", f"qlearning:{seed}", code=1)
    assert f"seed {seed}: came out differently than the first time" in said
    assert f"{name}.otherwise" in folders(few)


def test_what_a_kill_left_is_removed_and_stored_runs_stay_done_without_the_flag(both, typed):
    all_there, few, _ = both
    before = folders(few)
    name, _ = absent_of(all_there, few)
    shutil.copytree(all_there / "runs" / "qlearning" / name, few / "runs" / "qlearning" / name)
    assert "10 runs, 10 of them there already" in typed(*FEW)
    assert folders(few) == before
    more = [*TWO, "--seeds", 6, "--no-report", "-f", "folded"]
    assert "12 runs, 10 of them there already" in typed(*more)
    assert folders(few) == [*before, "FrozenLake-v1_6"]
    table = summary(few)
    first = table[table["seed"] < 5].reset_index(drop=True)
    pd.testing.assert_frame_equal(summary(all_there), first, check_dtype=False)


def test_a_damaged_file_is_named_and_repaired(both, typed):
    _, few, _ = both
    path, before = file_of(few), summary(few)
    whole = path.read_bytes()
    with sqlite3.connect(path) as database:
        database.execute("UPDATE runs SET final = final + 0.5 WHERE seed = 3")
    for damaged in (path.read_bytes(), whole[: len(whole) // 2]):
        path.write_bytes(damaged)
        said = typed(*FEW, code=2)
        assert "folded/" + str(path.relative_to(few.parent)) + " is damaged: " in said
        assert "--repair" in said
        assert "Traceback" not in said
    assert "FrozenLake-v1.sqlite.damaged-1" in typed(*FEW, "--repair")
    assert path.with_name("FrozenLake-v1.sqlite.damaged-1").exists()
    pd.testing.assert_frame_equal(summary(few), before)


def test_stored_runs_of_other_settings_are_replaced_only_when_asked(both, typed):
    _, few, _ = both
    other = [*FEW, "-params", "gamma:0.9"]
    said = typed(*other, code=2)
    assert "10 finished runs have other settings (gamma: 0.995 there, 0.9 now): --name" in said
    assert "10 runs, 0 of them there already" in typed(*other, "--replace")
    moved = sorted(path.parent.name for path in few.glob("replaced/*/*/*.sqlite"))
    assert moved == ["qlearning", "sarsa"]
    assert rows_of(few) == list(range(5))


def test_what_needs_whole_runs_is_refused(typed):
    for flag in (["--episodes-table", 10], ["--tensorboard"]):
        said = typed(*FEW, *flag, code=2)
        assert f"{flag[0]} needs more of each run than --keep figures keeps" in said


FLOATS = st.lists(st.floats(width=64) | st.integers(-(2**60), 2**60).map(float))


@given(st.lists(FLOATS, min_size=1, max_size=8))
def test_columns_come_back_to_the_bit(columns):
    arrays = [np.array(column, dtype=np.float64) for column in columns]
    again = unpacked(packed(arrays))
    assert [one.tobytes() for one in again] == [one.tobytes() for one in arrays]
