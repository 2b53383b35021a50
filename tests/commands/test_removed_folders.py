"""Somebody removes the folder that a command works on: a line says so, and nothing is made anew."""

import contextlib
import os
import subprocess
import sys
import time
from pathlib import Path

import pytest

import compare

ROOT = Path(compare.__file__).parent
REMOVING = """
import pathlib
import shutil

import gymnasium as gym


class Removing(gym.Env):
    observation_space = gym.spaces.Discrete(4)
    action_space = gym.spaces.Discrete(2)

    def __init__(self, folder, by="removing", render_mode=None):
        self.folder, self.by, self.steps = pathlib.Path(folder), by, 0

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        return 0, {}

    def step(self, action):
        self.steps += 1
        if self.steps == 500 and self.folder.exists():
            self.folder.rename(f"{self.folder}-elsewhere")
            if self.by == "removing":
                shutil.rmtree(f"{self.folder}-elsewhere")
        return int(self.np_random.integers(4)), 1.0, bool(self.np_random.random() < 0.2), False, {}


gym.register("Removing-v0", Removing, max_episode_steps=10)
"""
STUDY = """
environments:
  one: {{id: Removing-v0, n_timesteps: 100000000, env_kwargs: {{folder: {folder}, by: {by}}}}}
agents:
  one: {{algo: ppo}}
seeds: 3
"""
TRAIN = ["train.py", "--algo", "ppo", "-n", "100000000", "-f", "logs"]
TUNE = ["tune.py", "--algo", "ppo", "-n", "100000000", "--trials", "2", "-j", "2", "-f", "logs"]
COMPARE = ["compare.py", "study.yml", "--no-report", "-j", "2", "-f", "logs"]
COMMANDS = {
    "a run": (TRAIN, "logs/ppo/Removing-v0_1", "removing"),
    "all runs": (TRAIN, "logs", "renaming"),
    "a search": (TUNE, "logs/Removing-v0_ppo", "removing"),
    "a study": (COMPARE, "logs/study", "renaming"),
    "all studies": (COMPARE, "logs", "removing"),
}
GONE = "this folder is gone: somebody has removed or renamed it"


def words_for(own_folder, words, folder, by):
    """The words of a command, in which an environment removes a folder."""
    there = own_folder / folder
    (own_folder / "removing.py").write_text(REMOVING)
    (own_folder / "study.yml").write_text(STUDY.format(folder=there, by=by))
    settings = ["--env", "Removing-v0", "--env-kwargs", f"folder:'{there}'", f"by:'{by}'"]
    return [*words, "--gym-packages", "removing", *([] if "study.yml" in words else settings)]


@pytest.mark.parametrize("what", COMMANDS)
def test_a_folder_that_is_gone_ends_the_command(type_in_own_folder, own_folder, what):
    words, folder, by = COMMANDS[what]
    code, out, err = type_in_own_folder(*words_for(own_folder, words, folder, by))
    assert (code, err.count("\n")) == (2, 1), err
    assert err.startswith(f"{words[0]}: error: logs/")
    assert err.endswith(f": {GONE}\n")
    assert "another" not in out
    assert not (own_folder / folder).exists()


@pytest.mark.skipif(sys.platform != "linux", reason="it looks into /proc")
def test_no_process_is_left_of_a_study_whose_folder_is_gone(own_folder):
    words = words_for(own_folder, COMPARE, "logs/study", "removing")
    command = [sys.executable, ROOT / words[0], *words[1:]]
    done = subprocess.run(command, check=False, timeout=120, capture_output=True, text=True)
    assert (done.returncode, done.stderr) == (2, f"compare.py: error: logs/study: {GONE}\n")
    deadline = time.monotonic() + 20
    while (left := processes_in(own_folder)) and time.monotonic() < deadline:
        time.sleep(0.1)
    assert not left
    assert not (own_folder / "logs" / "study").exists()


def processes_in(folder):
    """The other processes whose working folder it is."""
    found = []
    for process in Path("/proc").glob("[0-9]*"):
        with contextlib.suppress(OSError):
            found += [int(process.name)] if (process / "cwd").samefile(folder) else []
    return set(found) - {os.getpid()}
