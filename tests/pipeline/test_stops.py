"""What asks a process to stop, ends its workers, fills its disk or is no number: told, recorded."""

import errno
import io
import json
import math
import multiprocessing
import os
import signal
import subprocess
import sys
import threading
import time
import zipfile
from contextlib import suppress
from pathlib import Path
from types import SimpleNamespace

import gymnasium as gym
import numpy as np
import pytest
import torch as th
from gymnasium import spaces

from rl_yardstick.pipeline import files, stopping
from rl_yardstick.pipeline.errors import UserError
from rl_yardstick.pipeline.runs import ROOM, ROOM_BYTES
from rl_yardstick.pipeline.stopping import (
    SIGNALS,
    Stopped,
    current,
    deaths_told,
    stops_noticed,
)

LONG = 30.0  # seconds: nothing here waits so long


@pytest.fixture
def by_default():
    """Handlers as the system has them, whatever the tests were started under."""
    handlers = [
        signal.default_int_handler if n == signal.SIGINT else signal.SIG_DFL for n in SIGNALS
    ]
    before = [signal.signal(*pair) for pair in zip(SIGNALS, handlers, strict=True)]
    yield
    after = [signal.signal(*pair) for pair in zip(SIGNALS, before, strict=True)]
    assert after == handlers
    assert current().number is None


def send(number=signal.SIGTERM):
    os.kill(os.getpid(), number)


def stopped(work, *args):
    """What a stop was called, and the number of seconds until it was raised."""
    started = time.monotonic()
    with pytest.raises(Stopped) as caught:
        work(*args)
    return str(caught.value), time.monotonic() - started


# --- signals -------------------------------------------------------------------------------------


@pytest.mark.usefixtures("by_default")
@pytest.mark.parametrize("number", SIGNALS)
def test_a_signal_stops_at_once(number):
    with stops_noticed() as stop:
        assert stopped(send, number)[0] == signal.Signals(number).name
        assert (stop.number, current()) == (number, stop)


def hold(stop):
    """It is told at the next safe moment."""
    with stop.held():
        with suppress(Stopped):
            send()
            held = stop.number
        assert held == signal.SIGTERM
        stop.raise_if_asked()


def wait_in_the_midst(stop):
    with stop.held(), stop.waiting(0.3):
        send()
        threading.Event().wait(LONG)


def ask_twice(stop):
    """The second signal waits for nothing but what is held."""
    with stop.waiting(LONG):
        send()
        with stop.held():
            send()
        assert stop.is_urgent
        time.sleep(LONG)


def swallow(stop):
    """As a bare except in a user's environment."""
    with stop.waiting(0.0):
        with suppress(BaseException):
            send()
        time.sleep(LONG)


WAYS = (hold, wait_in_the_midst, ask_twice, swallow)


@pytest.mark.usefixtures("by_default")
@pytest.mark.parametrize("work", WAYS)
def test_a_stop_comes_in_time_as_itself(work, monkeypatch):
    monkeypatch.setattr(stopping, "SECONDS_OF_ONE_REQUEST", 0.0)
    with stops_noticed() as stop:
        name, seconds = stopped(work, stop)
    assert name == "SIGTERM"
    assert (0.3 if work is wait_in_the_midst else 0.0) <= seconds < LONG


# --- the processes of environments ---------------------------------------------------------------
SCRIPT = """
import multiprocessing, os, signal, time
from rl_yardstick.pipeline.stopping import close_environments, shield_workers, stops_noticed

def work(pipe):
    pipe.send("there")
    time.sleep(60)

class Env:
    def close(self):
        worker.join()

if __name__ == "__main__":
    shield_workers()
    context = multiprocessing.get_context("forkserver")
    ours, theirs = context.Pipe()
    worker = context.Process(target=work, args=(theirs,), daemon=True)
    worker.start()
    assert ours.recv() == "there"
    with stops_noticed() as stop, stop.held():
        for number in (signal.SIGTERM, signal.SIGHUP, signal.SIGINT):
            os.killpg(0, number)
        time.sleep(0.2)
        print(worker.is_alive(), stop.number)
        close_environments(Env())
        print(worker.is_alive())
"""


def test_workers_outlive_a_signal_to_all_but_not_the_training(tmp_path):
    script = tmp_path / "script.py"
    script.write_text(SCRIPT)
    root = Path(stopping.__file__).parents[2]
    done = subprocess.run(
        [sys.executable, str(script)],
        env={**os.environ, "PYTHONPATH": str(root)},
        capture_output=True,
        text=True,
        check=False,
        start_new_session=True,
    )
    assert (done.stdout, done.stderr, done.returncode) == ("True 15\nFalse\n", "", 0)


def test_a_process_that_has_ended_is_named():
    """As of an environment that the system has killed for its memory."""
    context = multiprocessing.get_context("fork")
    ended = context.Process(target=os.execlp, args=("sh", "sh", "-c", "kill -9 $$"))
    ended.start()
    env = SimpleNamespace(unwrapped=SimpleNamespace(processes=[ended]))
    with pytest.raises(UserError, match=r"environment 0 has ended: SIGKILL$"), deaths_told(env):
        raise EOFError
    env.unwrapped.processes.pop()  # where none has ended
    with pytest.raises(EOFError), deaths_told(env):
        raise EOFError


# --- a full disk ---------------------------------------------------------------------------------


def test_on_a_full_disk_the_file_and_what_is_kept_are_named_and_the_run_has_failed(
    type_in_own_folder, own_folder, monkeypatch
):
    """Nothing can be written from that file on, until the room is made that was set aside."""
    folder, name = own_folder / "logs" / "qlearning" / "FrozenLake-v1_1", "value_map.png"
    put_in_place, full = files.put_in_place, []

    def put(draft, path, *opened):
        if path.name == name:
            assert (folder / ROOM).stat().st_size == ROOM_BYTES
            full.append(path)
        if full and (folder / ROOM).exists():
            raise OSError(errno.ENOSPC, "No space left on device")
        put_in_place(draft, path, *opened)

    monkeypatch.setattr(files, "put_in_place", put)  # the disk
    code, _, said = type_in_own_folder(
        *("train.py", "--env", "FrozenLake-v1", "--algo", "qlearning", "-n", "200"),
        *("--seed", "0", "--save-freq", "100", "--verbose", "0"),
    )
    assert (code, said.count("\n")) == (2, 1)
    assert f"{name}: No space left on device: the run has failed at step 200; " in said
    assert said.endswith("keeps best_model.zip and 2 checkpoints\n")
    record = json.loads((folder / "run.json").read_text(encoding="utf-8"))
    assert (record["state"], name in record["reason"]) == ("failed", True)
    assert not [*folder.glob(".*")]


# --- what is no number ---------------------------------------------------------------------------


class Broken(gym.Env):
    """Episodes of ten steps; at one step ``what`` is no number."""

    action_space = spaces.Discrete(2)

    def __init__(self, what="", at=25, kind="box"):
        self.what, self.at, self.kind, self.steps = what, at, kind, 0
        box = spaces.Box(-np.inf, np.inf, (2,), np.float32)
        self.observation_space = spaces.Discrete(3) if kind == "discrete" else box

    def _observation(self, broken):
        if self.kind == "discrete":
            return self.steps % 3
        return np.array([0.5, math.nan if broken else 1.0], dtype=np.float32)

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        return self._observation(False), {}

    def step(self, action):
        self.steps += 1
        due = self.steps == self.at
        reward = math.nan if due and self.what == "reward" else 1.0
        obs = self._observation(due and self.what == "obs")
        return obs, reward, self.steps % 10 == 0, False, {}


@pytest.fixture(scope="module", autouse=True)
def _registered():
    gym.register("Broken-v0", entry_point=Broken, max_episode_steps=20)
    yield
    del gym.registry["Broken-v0"]


PPO = ("-params", "n_steps:8", "batch_size:8", "n_epochs:1")
TOO_FAR = ("--save-freq", "10", "-params", "learning_rate:1e36", "max_grad_norm:1e30")
# Agent, environment, further flags, and the line.
CASES = {
    "a table": (
        *("qlearning", {"what": "reward", "kind": "discrete"}, ()),
        "reward of environment 0 at step 25 is nan",
    ),
    "a network": (
        *("ppo", {"what": "obs"}, (*PPO, "n_envs:2", "normalize:true")),
        "observation of environment 0 at step 50 is nan",
    ),
    "evaluation sees": (
        *("dqn", {}, ("--eval-env-kwargs", "what:obs", "at:15")),
        "observation of environment 0 in the evaluation at step 40 is nan",
    ),
    "a loss": ("a2c", {}, TOO_FAR, "train/"),
    "what no library takes": (
        *("ppo", {}, (*PPO, "clip_range:1e308")),
        "ppo at step 8: value cannot be converted to type float without overflow (",
    ),
}


@pytest.mark.filterwarnings("ignore:.*(NaN|overflow|invalid value|not within)")
@pytest.mark.parametrize(("algo", "kwargs", "flags", "line"), CASES.values(), ids=CASES)
def test_a_run_fails_at_the_first_number_that_is_none_and_saves_none(
    type_in_own_folder, own_folder, algo, kwargs, flags, line
):
    code, _, said = type_in_own_folder(
        *("train.py", "--env", "Broken-v0", "--algo", algo, "-n", "60", "--seed", "0"),
        *("--eval-freq", "20", "--eval-episodes", "1", "--verbose", "0", "--env-kwargs"),
        *(f"{key}:{value}" for key, value in {"what": "nothing", **kwargs}.items()),
        *flags,
    )
    folder = own_folder / "logs" / algo / "Broken-v0_1"
    info = json.loads((folder / "run.json").read_text(encoding="utf-8"))
    assert (code, said.count("\n"), info["state"]) == (2, 1, "failed")
    assert line in said
    assert line in info["reason"]
    assert not (folder / "Broken-v0.zip").exists()
    assert ("keeps best_model.zip" in said) == (folder / "best_model.zip").exists()
    for path in folder.glob("*.zip"):
        with zipfile.ZipFile(path) as archive:
            weights = th.load(io.BytesIO(archive.read("policy.pth")), weights_only=True)
        assert all(th.isfinite(tensor).all() for tensor in weights.values())
