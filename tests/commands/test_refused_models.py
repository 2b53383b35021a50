"""What a user sees whose environment does other than its P says."""

import json
import re
import sys
from pathlib import Path
from types import SimpleNamespace

import gymnasium as gym
import pytest
from rich.console import Console

import enjoy
import train
from commands.cli import run_command
from commands.compare import StudyProgress

WINDY = """
import gymnasium as gym
import numpy as np

class Windy(gym.Env):
    observation_space = gym.spaces.Discrete(6)
    action_space = gym.spaces.Discrete(2)
    initial_state_distrib = np.eye(6)[0]

    def __init__(self, wind=0.3):
        self.wind = wind
        self.P = {s: {a: [(1.0, *self.move(s, a))] for a in (0, 1)} for s in range(6)}

    def move(self, state, action):
        state = min(max(state + 2 * action - 1, 0), 5)
        return state, 9.0 if state == 5 else -1.0, state == 5

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        self.s = 0
        return self.s, {}

    def step(self, action):
        if self.np_random.random() < self.wind:
            self.s = max(self.s - 2, 0)
            return self.s, -1.0, False, False, {}
        self.s, reward, terminated = self.move(self.s, action)
        return self.s, reward, terminated, False, {}

gym.register("Windy-v0", entry_point=Windy, max_episode_steps=100)
"""
REFUSAL = "the environment's P is not what step does: state 1, action "
ENV = ("--env", "Windy-v0", "--gym-packages", "windy_of_mine", "--algo", "qlearning")


@pytest.fixture
def type_command(monkeypatch, capsys, tmp_path):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "windy_of_mine.py").write_text(WINDY)
    monkeypatch.syspath_prepend(tmp_path)
    # What another test imported and registered.
    monkeypatch.delitem(sys.modules, "windy_of_mine", raising=False)
    monkeypatch.delitem(gym.registry, "Windy-v0", raising=False)

    def run(main, *words):
        monkeypatch.setattr(sys, "argv", ["it", *ENV, *words])
        with pytest.raises(SystemExit) as stop:
            run_command(main)
        captured = capsys.readouterr()
        return stop.value.code, " ".join(captured.out.split()), captured.err

    return run


def test_the_figures_are_those_of_step(type_command, tmp_path):
    code, out, err = type_command(train.main, "-n", "4000", "--seed", "0")
    assert (code, err) == (0, "")
    assert out.count(f"{REFUSAL}") == 2  # once for the figures, once for the engine
    assert "; figures are sampled" in out
    assert f"engine interpreted: {REFUSAL}" in out
    assert "(exact)" not in out
    assert re.search(r"over \d+ episodes", out)
    info = json.loads((tmp_path / "logs/qlearning/Windy-v0_1/run.json").read_text())
    assert info["model_refused"].startswith(REFUSAL)
    assert not info["final"]["exact"]
    # Without wind the corridor takes five steps, and earns 5; with it 20 steps or so.
    assert info["final"]["mean_return"] < 2

    code, out, err = type_command(enjoy.main, "--n-episodes", "3", "--render", "none")
    assert (code, err) == (0, "")
    assert out.count(f"{REFUSAL}") == 1
    assert "exact" not in out


def test_where_it_does_what_it_says_nothing_is_said(type_command, tmp_path):
    words = ("-n", "2000", "--seed", "0", "--env-kwargs", "wind:0.0")
    code, out, err = type_command(train.main, *words)
    assert (code, err) == (0, "")
    assert "not what step does" not in out
    assert "final return 5.00 (exact)" in out
    assert "engine compiled" in out
    info = json.loads((tmp_path / "logs/qlearning/Windy-v0_1/run.json").read_text())
    assert "model_refused" not in info


def test_a_planner_refuses_in_one_line(type_command, tmp_path):
    code, _, err = type_command(train.main, "--algo", "optimal", "-n", "100")
    assert code == 2
    assert err.count("\n") == 1
    assert f"needs an environment whose transition model is known: {REFUSAL}" in err
    assert not list((tmp_path / "logs").rglob("run.json"))


def test_a_study_says_it_once_for_each_environment(capsys):
    runs = [
        SimpleNamespace(
            agent=agent,
            environment=environment,
            labels=(agent, environment),
            seed=seed,
            path=Path(agent, f"{environment}_{seed}"),
            spec=SimpleNamespace(
                algo=agent, hyperparams=SimpleNamespace(n_timesteps=500, n_episodes=None)
            ),
            run=SimpleNamespace(read_info=lambda info=info: info),
        )
        for agent in ("sarsa", "qlearning")
        for seed in range(3)
        for environment, info in (
            ("mine", {"model_refused": "P lies"}),
            ("yours", {"model_refused": "P is odd"}),
            ("known", {}),
        )
    ]
    with StudyProgress(Console(), runs, []) as progress:
        for run in runs:
            progress.note(run, None)
    lines = capsys.readouterr().out.splitlines()
    assert [line for line in lines if "sampled" in line] == [
        "mine: P lies; figures are sampled",
        "yours: P is odd; figures are sampled",
    ]
