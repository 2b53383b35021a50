"""``audit`` as a user types it: a script, a class, and mistakes that end in one line."""

import json

import pytest

from rl_yardstick.diagnosis import target_probes
from rl_yardstick.diagnosis.audit import audit

SCRIPT = '''
import numpy as np


def train(make_env, seed, gamma, steps):
    """Q-learning in which an episode that is cut off counts as ended."""
    rng, env = np.random.default_rng(seed), make_env()
    q = np.zeros((env.observation_space.n, 2))
    obs, _ = env.reset(seed=seed)
    for _ in range(steps):
        action = int(rng.integers(2)) if rng.random() < 0.5 else int(q[obs].argmax())
        following, reward, terminated, truncated, _ = env.step(action)
        done = terminated or truncated
        q[obs, action] += 0.1 * (reward + gamma * q[following].max() * (not done) - q[obs, action])
        obs = env.reset()[0] if done else following

    class Agent:
        def act(self, obs):
            return int(q[obs].argmax())

        def values(self, obs):
            return q[obs]

    return Agent()


number = 3


def bare():
    pass


def broken(make_env, seed, gamma, steps):
    1 / 0
'''


def test_a_script_of_ones_own(type_command, tmp_path):
    (tmp_path / "my_audited_script.py").write_text(SCRIPT)
    words = ("--script", "my_audited_script:train", "--kind", "q_learning", "--json", "out.json")
    code, out, err = type_command("audit", *words)
    assert (code, err) == (1, "")
    assert "an episode that is cut off          FAULT\n" in out
    assert "\nfault: no-bootstrap-at-truncation. A truncated episode is treated as " in out
    assert "right would be: 5 in both" in " ".join(out.split())
    found = json.loads((tmp_path / "out.json").read_text())
    assert (found["verdict"], found["fault"]) == ("fault", "no-bootstrap-at-truncation")
    assert found["faults"][0]["source"].startswith("Pardo et al. (2018)")


def test_a_class_of_ones_own(type_command, tmp_path, monkeypatch):
    text = "from rl_yardstick.agents.tabular.one_step import QLearning\n\nMine = QLearning\n"
    (tmp_path / "my_audited_agents.py").write_text(text)
    few = (target_probes.probe_ends, target_probes.probe_discount)
    monkeypatch.setattr(audit, "__defaults__", (few,))
    code, out, err = type_command("audit", "--algo", "my_audited_agents:Mine")
    assert (code, err) == (0, "")
    assert out.endswith("right, as far as these probes see\n")


@pytest.mark.parametrize(
    ("words", "told"),
    [
        ("--algo qlerning", "did you mean 'qlearning'?"),
        ("--algo ucb", "--algo ucb: it is for bandits"),
        ("--algo qlearning -params gama:0.5", "has no hyperparameter 'gama'"),
        ("--algo my_refused:number", "number is no subclass of Stable-Baselines3's BaseAlgorithm"),
        ("--script my_refused:bare", "must take make_env, seed, gamma, steps"),
        ("--script my_refused:broken", "cannot train on a tiny world: ZeroDivisionError"),
    ],
)
def test_mistakes_end_in_one_line(type_command, tmp_path, words, told):
    name = tmp_path.name  # another one each time: modules stay imported
    (tmp_path / f"{name}.py").write_text(SCRIPT)
    code, out, err = type_command("audit", *words.replace("my_refused", name).split())
    assert (code, out) == (2, "")
    assert told in err
    assert len(err.splitlines()) == 1
