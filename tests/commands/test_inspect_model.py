"""yardstick inspect: what a zip holds and what is suspicious, by exit code too."""

import base64
import json
import os
import pickle
import subprocess
import sys
import zipfile
from pathlib import Path

import pytest
from stable_baselines3 import PPO

import train
from agents import load_algorithm
from commands import main


@pytest.fixture
def inspect(monkeypatch, capsys, tmp_path):
    monkeypatch.chdir(tmp_path)

    def run(*words):
        monkeypatch.setattr(sys, "argv", ["yardstick", "inspect", *map(str, words)])
        with pytest.raises(SystemExit) as stop:
            main()
        captured = capsys.readouterr()
        return stop.value.code, captured.out, captured.err

    return run


class Payload:
    def __reduce__(self):
        return os.mkdir, ("mark",)


def test_genuine_zips(inspect, tmp_path):
    PPO("MlpPolicy", "CartPole-v1", policy_kwargs={"net_arch": [4]}).save("ppo.zip")
    code, out, err = inspect("ppo.zip")
    assert (code, err) == (0, "")
    assert "policy.action_net.weight" in out
    assert "(2, 4)" in out
    assert "a pickle of stable_baselines3.common.policies.ActorCriticPolicy" in out
    assert out.endswith("nothing in it is suspicious\n")
    load_algorithm("qlearning")(env="FrozenLake-v1").save("table.zip")
    code, out, _ = inspect("table.zip")
    assert (code, "policy.q_tables" in out) == (0, True)


def test_a_zip_with_a_payload(inspect, tmp_path):
    PPO("MlpPolicy", "CartPole-v1").save("ppo.zip")
    with zipfile.ZipFile("ppo.zip") as archive:
        members = {name: archive.read(name) for name in archive.namelist()}
    text = base64.b64encode(pickle.dumps(Payload())).decode()
    odd = {"a\x1b[2Jb": {":serialized:": text}, "[bold]": 1}
    members["data"] = json.dumps({**json.loads(members["data"]), **odd})
    with zipfile.ZipFile("evil.zip", "w") as archive:
        for name, content in members.items():
            archive.writestr(name, content)
    code, out, err = inspect("evil.zip")
    assert (code, err) == (1, "")
    assert f"{os.mkdir.__module__}.mkdir" in out.partition("suspicious\n")[2]
    assert "[bold]" in out
    assert "\x1b" not in out
    assert not Path("mark").exists()


def test_what_is_no_model(inspect, tmp_path):
    Path("text.zip").write_text("no zip")
    with zipfile.ZipFile("other.zip", "w") as archive:
        archive.writestr("readme.txt", "hello")
    os.mkfifo("pipe")
    for name in ("text.zip", "other.zip", "pipe", "nowhere.zip", "."):
        code, out, err = inspect(name)
        assert (code, out, err.count("\n")) == (2, "", 1)


def test_from_a_checkout(tmp_path):
    done = subprocess.run(
        [sys.executable, "-m", "commands.share", "inspect", "nowhere.zip"],
        cwd=Path(train.__file__).parent,
        capture_output=True,
        text=True,
        check=False,
    )
    assert done.returncode == 2
    assert done.stderr == "yardstick inspect: error: no such model file: nowhere.zip\n"
