"""tune.py as a user types it: what is run, what is said, what is written down."""

import json
from pathlib import Path

import pytest
from filelock import FileLock

SPACE = """\
default:
  learning_rate: {low: 0.01, high: 1.0, scale: log}
  gamma: {low: 0.5, high: 1.0}
"""
# Without a look ahead nothing is learnt but the last step.
BLIND = "FrozenLake-v1: {n_episodes: 600, learning_rate: 0.1, gamma: 0.0}"
SEARCH = """
--env FrozenLake-v1 --env-kwargs is_slippery:False --algo qlearning --n-episodes 600
--search-space space.yml --conf-file blind.yml -j 1 --no-report
--trials 4 --seeds-per-trial 1 --n-startup-trials 3 --retest 1 --retest-seeds 8
--until-decided --max-retest-seeds 12
"""
PLACE = Path("logs/tuning/FrozenLake-v1_qlearning")


@pytest.fixture
def files(own_folder):
    (own_folder / "space.yml").write_text(SPACE)
    (own_folder / "blind.yml").write_text(BLIND)


def test_a_search_finds_better_settings_and_its_re_test_grows_until_decided(type_study, files):
    code, out, err = type_study(*SEARCH.split(), program="tune.py")
    assert (code, err) == (0, "")
    assert "look 1 of 2, at 8 seeds: all pairs are decided" in out
    record = json.loads((PLACE / "tuning.json").read_text())
    assert len(record["trials"]) == 4
    for trial in record["trials"]:
        assert sorted(trial["figures"]) == [str(seed) for seed in record["seeds"]]
        assert [trial["value"]] == [*trial["figures"].values()]  # one seed
    _, best = record["retest"]["settings"]
    winner = best["label"]
    assert winner != "trial 0"
    assert f"winner: {winner}, in {PLACE / 'winner.yml'}" in out
    assert f"{winner}: 1 (95 % interval of the mean: 1 to 1), 8 runs" in out
    assert record["retest"]["winner"] == winner
    assert record["retest"]["optimism"] == best["in_search"] - best["held_out"]
    assert record["held_out_seeds"] == [*range(1000, 1008)]
    code, again, _ = type_study(*SEARCH.split(), program="tune.py")
    assert code == 0
    assert "16 runs, 16 of them there already" in again
    code, _, err = type_study(*SEARCH.split(), "--max-retest-seeds", "20", program="tune.py")
    assert (code, err.count("\n")) == (2, 1)
    assert "the looks were planned before the first of them and cannot change" in err


def test_one_command_at_a_time_works_on_a_search(type_study, files):
    PLACE.mkdir(parents=True)
    with FileLock(PLACE / ".lock"):
        code, _, err = type_study(*SEARCH.split(), program="tune.py")
    assert (code, err.count("\n")) == (2, 1)
    assert f"{PLACE} is in use by another command" in err
    assert not (PLACE / "trials.db").exists()
