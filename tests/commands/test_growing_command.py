"""compare.py --until-decided as a user types it: what it runs, says, and survives."""

import json
import os
import sys
from pathlib import Path

import pandas as pd
import pytest

import compare
from commands.cli import run_command
from experiments import launching
from pipeline.errors import UserError

WALK = '''
import gymnasium as gym


class Fragile(gym.Env):
    """Two actions, one step; a run with seed 1 breaks."""

    observation_space = gym.spaces.Discrete(1)
    action_space = gym.spaces.Discrete(2)

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        if seed == 1:
            raise RuntimeError("thin ice")
        return 0, {}

    def step(self, action):
        return 0, float(self.np_random.random()), True, False, {}


gym.register("Brittle-v0", Fragile)
'''
BANDITS = """
title: Two bandits
seeds: 6
metric: regret
margin: 1
n_timesteps: 60
environments: [BernoulliBandit-v0]
agents: [ucb, thompson, epsilon_greedy]
"""


@pytest.fixture
def type_command(tmp_path, monkeypatch, capfd):
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("PYTHONPATH", f"{tmp_path}{os.pathsep}{Path(compare.__file__).parent}")
    (tmp_path / "bandits.yml").write_text(BANDITS)

    def run(*words):
        monkeypatch.setattr(sys, "argv", ["compare.py", *map(str, words), "--no-report"])
        with pytest.raises(SystemExit) as stop:
            run_command(compare.main)
        captured = capfd.readouterr()
        return stop.value.code, captured.out, captured.err

    return run


def figures(folder):
    """What a study has come to, but for times."""
    table = pd.read_csv(folder / "summary.csv").drop(columns=["seconds", "cpu_seconds", "path"])
    looks = json.loads((folder / "looks.json").read_text())
    for environment in looks["environments"].values():
        for look in environment["taken"]:
            del look["date"]
    return table.sort_values(["agent", "seed"]).to_csv(index=False), looks


def last_line(out):
    return [line for line in out.splitlines() if line][-1]


def test_it_grows_until_decided_also_when_it_is_stopped_between(
    type_command, tmp_path, monkeypatch
):
    words = ["bandits.yml", "--until-decided", "--max-seeds", 14, "-j", 2]
    code, whole, err = type_command(*words, "-f", "whole")
    assert (code, err) == (0, "")
    assert "BernoulliBandit-v0, look 1 of " in whole
    counts = pd.read_csv("whole/bandits/summary.csv")["agent"].value_counts()
    assert last_line(whole).startswith(
        f"{counts.sum()} runs, where 14 seeds of each agent would be 42; "
    )
    do_runs, calls = launching.execute, []

    def stopped(runs, *args):
        calls.append(len(runs))
        if len(calls) == 2:
            do_runs(runs[:1], *args)
            raise UserError("the power is gone")
        return do_runs(runs, *args)

    with monkeypatch.context() as patch:
        patch.setattr(launching, "execute", stopped)
        assert type_command(*words, "-f", "parts")[0] == 2
    code, out, _ = type_command("bandits.yml", "--until-decided", "-f", "parts")
    assert (code, last_line(out)) == (0, last_line(whole))
    assert figures(tmp_path / "parts" / "bandits") == figures(tmp_path / "whole" / "bandits")
    again = figures(tmp_path / "whole" / "bandits")
    code, out, _ = type_command(*words, "-f", "whole")
    assert (code, last_line(out)) == (0, last_line(whole))
    assert "3 runs, 3 of them there already" in out
    assert figures(tmp_path / "whole" / "bandits") == again


def test_runs_that_fail_are_tried_once_and_do_not_hold_a_study_up(type_command, tmp_path):
    (tmp_path / "fragile.py").write_text(WALK)
    words = ["--env", "Brittle-v0", "--gym-packages", "fragile", "--algos", "qlearning", "sarsa"]
    words += ["--seeds", 6, "--until-decided", "--max-seeds", 7, "-n", 20, "-j", 2, "-f", "s"]
    code, out, _ = type_command(*words)
    assert code == 1
    assert out.count("thin ice; see ") == 2
    assert "Brittle-v0, look 1 of 2: 1 of 1 pairs is undecided" in out
    assert "qlearning and sarsa go on to 7 seeds" in out
    assert last_line(out) == (
        "14 runs, where 7 seeds of each agent would be 14; "
        "undecided: qlearning and sarsa on Brittle-v0"
    )


def test_a_damaged_memory_stops_a_study_before_anything_is_run(type_command, tmp_path):
    folder = tmp_path / "s" / "bandits"
    folder.mkdir(parents=True)
    (folder / "looks.json").write_text('{"format": 2}')
    for more in ([], ["--until-decided"]):
        code, _, err = type_command("bandits.yml", *more, "-f", "s")
        assert (code, err.count("\n")) == (2, 1)
        assert "looks.json is damaged" in err
        assert [path.name for path in folder.iterdir()] == ["looks.json"]
