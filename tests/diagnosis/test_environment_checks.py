"""What ``check-env`` finds: planted faults by their names, and nothing in right environments."""

import json
import re
import signal
from pathlib import Path

import gymnasium as gym
import pytest

from rl_yardstick.commands import check_env
from rl_yardstick.diagnosis import environment_checks
from rl_yardstick.diagnosis.environment_checks import examine
from rl_yardstick.envs import ENVIRONMENTS
from rl_yardstick.pipeline.environment_trial import KINDS
from rl_yardstick.pipeline.settings import read_yaml
from tests.diagnosis.planted_environments import PLANTED, RIGHT

OF_GYMNASIUM = ("FrozenLake-v1", "FrozenLake8x8-v1", "Taxi-v4", "CliffWalking-v1", "Blackjack-v1")
OF_GYMNASIUM += ("CartPole-v1", "MountainCar-v0", "MountainCarContinuous-v0", "Pendulum-v1")


@pytest.fixture(autouse=True)
def short_plays(monkeypatch):
    shorter = {"N_PLAYED": 200, "N_LONG": 1000, "N_SEEDED": 60}
    for name, n_steps in shorter.items():
        monkeypatch.setattr(environment_checks, name, n_steps)


@pytest.mark.parametrize("fault", PLANTED)
def test_a_planted_fault_is_found_under_its_name_and_nothing_else_breaks(fault):
    name, make = PLANTED[fault]
    found = {one.name: one for one in examine(make)}
    assert name in found, found
    assert [one for one in found.values() if one.level == "breaks" and one.name != name] == []


def test_every_kind_of_finding_is_planted_and_the_worst_come_first():
    levels = [level for level, _ in KINDS.values()]
    assert levels == sorted(levels, key=["breaks", "bites", "note"].index)
    assert {name for name, _ in PLANTED.values()} == set(KINDS) - {"hangs"}  # takes seconds


@pytest.mark.parametrize("name", RIGHT)
def test_nothing_is_found_in_a_right_environment(name):
    assert examine(RIGHT[name]) == []


@pytest.mark.parametrize("env_id", [*ENVIRONMENTS, *OF_GYMNASIUM, "Acrobot-v1"])
def test_no_false_alarm(env_id, tmp_path):
    log = tmp_path / "log.csv"
    log.write_text("segment,arm,reward,propensity\n" + "core,0,1,0.5\ncasual,1,0,0.5\n" * 500)
    kwargs = {"log": str(log)} if env_id == "ReplayBandit-v0" else {}
    found = examine(lambda: gym.make(env_id, disable_env_checker=True, **kwargs))
    assert [one for one in found if one.level != "note"] == []


@pytest.mark.parametrize("is_terminal", [False, True])
def test_the_command(monkeypatch, capsys, tmp_path, is_terminal):
    monkeypatch.setattr("sys.argv", ["yardstick check-env", "Ferry-v0", "--json", "found.json"])
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("COLUMNS", "80")
    if is_terminal:
        monkeypatch.setenv("FORCE_COLOR", "1")
    wanted = {None: (0, None), "double precision": (0, "bites"), "no info": (1, "breaks")}
    for fault, (code, level) in wanted.items():
        make = PLANTED[fault][1] if fault else RIGHT["ferry"]
        spec = gym.envs.registration.EnvSpec("Ferry-v0", make)
        monkeypatch.setitem(gym.registry, "Ferry-v0", spec)
        assert check_env.main() == code
        lines = re.sub(r"\x1b\[[\d;?]*[a-zA-Z]", "", capsys.readouterr().out).splitlines()
        findings = json.loads((tmp_path / "found.json").read_text())["findings"]
        if level is None:
            assert findings == []
            assert lines[-1].startswith("Ferry-v0: nothing found in ")
            continue
        assert findings[0]["level"] == level
        assert {*findings[0]} == {"level", "name", "what", "where", "mend"}
        assert any(line.startswith(f"{level} ") for line in lines)
        assert max(map(len, lines)) <= 80 + 20 * (not is_terminal), lines
        assert lines[-1].startswith("Ferry-v0: 1 found in ")


ODD = """
import time
from gymnasium.envs.toy_text import FrozenLakeEnv

class Lake(FrozenLakeEnv):
    pass

class Raising(FrozenLakeEnv):
    def __init__(self):
        raise RuntimeError("no licence")

class Leaving(FrozenLakeEnv):
    def __init__(self):
        raise SystemExit(0)

class Agents(FrozenLakeEnv):
    def __init__(self):
        self.observation_space = lambda agent: None

class Sized(FrozenLakeEnv):
    def __init__(self, size):
        super().__init__()

class Endless(FrozenLakeEnv):
    def step(self, action):
        time.sleep(60)

class Plain:
    metadata = {"render_modes": []}
"""


@pytest.mark.parametrize(
    ("words", "code", "line"), read_yaml(Path(__file__).with_name("check_env.yml"))
)
def test_what_is_typed(typed, own_folder, monkeypatch, words, code, line):
    (own_folder / "odd.py").write_text(ODD)
    alarm = signal.alarm
    monkeypatch.setattr(signal, "alarm", lambda seconds: alarm(min(seconds, 5)))
    found, out, err = typed("yardstick", "check-env", *words)
    assert (found, "Traceback" in err) == (code, False)
    assert line in " ".join((out + err).split())
