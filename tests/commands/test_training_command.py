"""train.py and tune.py as a user types them: what is run, what is said, what is written down."""

import json
from pathlib import Path

import yaml


def test_the_head_says_what_auto_stands_for_and_what_a_discount_costs(type_command, tmp_path):
    slipping = ["--algo", "qlearning", "--env", "Warehouse-v0", "--env-kwargs", "slip:0.2"]
    code, out, _ = type_command("train.py", *slipping, "-n", "500", "--seed", "0")
    assert code == 0
    assert "gamma=0.9995 (auto: 1 - 1/(2 x time limit of 1,000))" in " ".join(out.split())
    assert "exact planning" not in out
    run = tmp_path / "logs" / "qlearning" / "Warehouse-v0_1"
    spec = json.loads((run / "run.json").read_text())["spec"]
    assert (spec["hyperparams"]["gamma"], *spec["origins"]) == (0.9995, "gamma", "learning_rate")
    assert yaml.safe_load((run / "Warehouse-v0" / "config.yml").read_text())["gamma"] == 0.9995
    code, out, _ = type_command(
        *("train.py", *slipping, "-n", "500", "--seed", "0", "-params", "gamma:0.99")
    )
    assert code == 0
    assert "at gamma 0.99 even exact planning scores 0.00 here; 0.9995: 1.00" in out


def test_a_run_that_fails_leaves_the_page_of_what_it_came_to(type_command, tmp_path):
    words = "--algo qlearning --env Warehouse-v0 --seed 0 -n 3000 --watch-learning page.html"
    words += " -params learning_rate:30 gamma:1 --eval-freq -1"
    code, out, err = type_command("train.py", *words.split())
    assert (code, err.count("\n")) == (2, 1)
    assert "q_tables of the agent at step 3,000 is nan" in err
    assert out.splitlines()[-1] == "learning page.html: step by step, 3,000 steps, 3 whole episodes"
    assert "3,000 steps" in (tmp_path / "page.html").read_text(encoding="utf-8")


# --- a search ---------------------------------------------------------------------------------


SPACE = """\
default:
  learning_rate: {low: 0.01, high: 1.0, scale: log}
  gamma: {low: 0.5, high: 1.0}
"""
# Without a look ahead nothing is learnt but the last step.
BLIND = "FrozenLake-v1: {n_episodes: 600, learning_rate: 0.1, gamma: 0.0}"
SEARCH = (
    "--env FrozenLake-v1 --env-kwargs is_slippery:False --algo qlearning --n-episodes 600 "
    "--search-space space.yml --conf-file blind.yml --storage journal:trials.log -j 1 --no-report "
    "--trials 4 --seeds-per-trial 1 --n-startup-trials 3 --retest 1 --retest-seeds 8 "
    "--until-decided --max-retest-seeds 12"
)


def test_a_search_finds_better_settings_and_its_re_test_grows_until_decided(type_study, own_folder):
    (own_folder / "space.yml").write_text(SPACE)
    (own_folder / "blind.yml").write_text(BLIND)
    words = SEARCH.split()
    code, out, err = type_study(*words, program="tune.py")
    assert (code, err) == (0, "")
    assert "look 1 of 2, at 8 seeds: all pairs are decided" in out
    assert "better than the shipped settings, on average" in out
    record = json.loads(Path("logs/tuning/FrozenLake-v1_qlearning/tuning.json").read_text())
    assert len(record["trials"]) == 4
    for trial in record["trials"]:
        assert sorted(trial["figures"]) == [str(seed) for seed in record["seeds"]]
        assert [trial["value"]] == [*trial["figures"].values()]  # one seed
    _, best = record["retest"]["settings"]
    winner = best["label"]
    assert winner != "trial 0"
    assert record["retest"]["winner"] == winner
    assert record["retest"]["optimism"] == best["in_search"] - best["held_out"]
    assert record["held_out_seeds"] == [*range(1000, 1008)]
    code, again, _ = type_study(*words, program="tune.py")
    assert code == 0
    assert "16 runs, 16 of them there already" in again
    code, _, err = type_study(*words, "--max-retest-seeds", "20", program="tune.py")
    assert (code, err.count("\n")) == (2, 1)
    assert "the looks were planned before the first of them and cannot change" in err
