"""What ``check-env`` finds: planted faults by their names, and nothing in right environments."""

import json
import re

import gymnasium as gym
import pytest

from rl_yardstick.commands import check_env
from rl_yardstick.diagnosis import environment_checks
from rl_yardstick.diagnosis.environment_checks import examine
from rl_yardstick.envs import ENVIRONMENTS
from rl_yardstick.pipeline.environment_trial import kinds
from tests.diagnosis.planted_environments import FAULTS, RIGHT, maker

OF_GYMNASIUM = ("FrozenLake-v1", "FrozenLake8x8-v1", "Taxi-v4", "CliffWalking-v1", "Blackjack-v1")
OF_GYMNASIUM += ("CartPole-v1", "MountainCar-v0", "MountainCarContinuous-v0", "Pendulum-v1")
LINE = (
    "breaks  old-api: step returns 4 values, not observation, reward, terminated, truncated, info"
)


@pytest.fixture(autouse=True)
def short_plays(monkeypatch):
    monkeypatch.setattr(environment_checks, "N_PLAYED", 300)
    monkeypatch.setattr(environment_checks, "N_LONG", 2000)


@pytest.mark.parametrize(("name", "fault", "change"), FAULTS, ids=[row[1] for row in FAULTS])
def test_a_planted_fault_is_found_under_its_name_and_nothing_else_breaks(name, fault, change):
    found = {one.name: one for one in examine(maker(change))}
    assert name in found, found
    assert [one for one in found.values() if one.level == "breaks" and one.name != name] == []


def test_every_kind_of_finding_is_planted():
    assert {name for name, *_ in FAULTS} == set(kinds())


@pytest.mark.parametrize("name", RIGHT)
def test_nothing_is_found_in_a_right_environment(name):
    assert examine(maker(RIGHT[name])) == []


@pytest.mark.parametrize("env_id", [*ENVIRONMENTS, *OF_GYMNASIUM, "Acrobot-v1"])
def test_no_false_alarm(env_id, tmp_path):
    log = tmp_path / "log.csv"
    log.write_text("segment,arm,reward,propensity\n" + "core,0,1,0.5\ncasual,1,0,0.5\n" * 500)
    kwargs = {"log": str(log)} if env_id == "ReplayBandit-v0" else {}
    found = examine(lambda **extra: gym.make(env_id, disable_env_checker=True, **kwargs, **extra))
    assert [one for one in found if one.level != "note"] == []


@pytest.fixture
def check(monkeypatch, capsys, tmp_path):
    """Type ``check-env`` on the fault of that name: the exit code, the output and the JSON."""
    faults = {fault: change for _, fault, change in FAULTS}

    def run(fault, *words):
        entry = maker(faults.get(fault, {}))
        monkeypatch.setitem(
            gym.registry, "Ferry-v0", gym.envs.registration.EnvSpec("Ferry-v0", entry)
        )
        path = tmp_path / "found.json"
        monkeypatch.setattr(
            "sys.argv", ["yardstick check-env", "Ferry-v0", "--json", str(path), *words]
        )
        code = check_env.main()
        return code, capsys.readouterr().out, json.loads(path.read_text())

    return run


@pytest.mark.parametrize("env", ["terminal", "pipe"])
def test_the_command(check, monkeypatch, env):
    code, out, told = check("none of them")
    assert (code, told["findings"]) == (0, [])
    assert out.startswith("Ferry-v0: nothing found in ")
    code, out, told = check("double precision")  # bites
    assert (code, told["findings"][0]["name"]) == (0, "observation-dtype")
    if env == "terminal":
        monkeypatch.setenv("FORCE_COLOR", "1")
        monkeypatch.setenv("COLUMNS", "80")
    code, out, told = check("four things from step")
    assert code == 1
    assert {*told["findings"][0]} == {"level", "name", "what", "where", "mend"}
    if env == "terminal":
        assert "how to mend" in out
        assert max(map(len, re.sub(r"\x1b\[[\d;?]*[a-zA-Z]", "", out).splitlines())) == 80
    else:
        assert max(map(len, out.splitlines())) <= 100
        assert " ".join(out.split()).startswith(" ".join(LINE.split()))
