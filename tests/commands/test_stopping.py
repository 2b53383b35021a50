"""What ends a command from outside: signals, and environments that exit."""

import json
import os
import signal
import sys
from pathlib import Path

import pytest
from rl_yardstick.pipeline.runs import Run
from rl_yardstick.pipeline.state_saver import StateSaver

import train
from rl_yardstick.commands.cli import run_command
from rl_yardstick.pipeline import files, preparation, stopping, training

# --- signals at named moments of a training: what is left, and how the process ends ---------------

WORDS = ["--algo", "qlearning", "--env", "FrozenLake-v1", "-n", "600", "--seed", "0"]


def moments():
    """What is called at each moment: its owner, its name, and on which of the calls."""
    steps = iter(range(10**9))
    return {
        "set-up": (preparation, "make_evaluation_env", always),
        "training": (StateSaver, "_on_step", lambda *_: next(steps) == 3),
        "saving": (files, "put_in_place", lambda draft, path, *_: path.name == "FrozenLake-v1.zip"),
        "drawing": (training, "draw_learning_curve", always),
        "recording": (Run, "end", always),
    }


def always(*_):
    return True


def signalling(owner, name, condition, signals):
    """Let the function send the signals before it begins, the first time that it is its turn."""
    function = getattr(owner, name)

    def send(*args, **kwargs):
        if signals and condition(*args):
            while signals:
                signal.raise_signal(signal.Signals[signals.pop(0)])
        return function(*args, **kwargs)

    setattr(owner, name, send)


def train_in_child(words, plan, ignored):
    """Train, and send signals by moment; what a forked process does, which has all its modules."""
    stopping.SECONDS_OF_ONE_REQUEST = 0.0  # here they are meant one by one
    for number in stopping.SIGNALS:  # whatever the tests were started under
        default = signal.default_int_handler if number == signal.SIGINT else signal.SIG_DFL
        signal.signal(number, signal.SIG_IGN if number.name in ignored else default)
    for moment, place in moments().items():
        if moment in plan:
            signalling(*place, plan[moment].split())
    sys.argv = ["train.py", *words]
    code = 99
    with Path("out").open("w") as sys.stdout, Path("err").open("w") as sys.stderr:
        try:
            run_command(train.main)
        except SystemExit as stop:
            code = stop.code
    os._exit(code)


@pytest.fixture
def train_stopped(tmp_path, monkeypatch):
    """Train, with signals by moment; exit code, the run's record or None, and the run folder."""
    monkeypatch.chdir(tmp_path)

    def run(*words, ignored=(), **plan):
        words = [*WORDS, *words, "-params", "engine:interpreted"]
        if not (child := os.fork()):
            try:
                train_in_child(words, plan, ignored)
            finally:
                os._exit(98)
        code = os.waitstatus_to_exitcode(os.waitpid(child, 0)[1])
        folder = tmp_path / "logs" / "qlearning" / "FrozenLake-v1_1"
        record = json.loads((folder / "run.json").read_text()) if folder.exists() else None
        return code, record, folder

    return run


def holds(folder):
    return sorted(p.name for p in folder.iterdir() if p.suffix in (".zip", ".png", ".tmp"))


# Signals by moment; how the process ends, and the state of the run, if one has begun.
MOMENTS = [
    ({"set-up": "SIGTERM"}, 143, None),
    ({"training": "SIGINT"}, 130, "interrupted"),
    ({"recording": "SIGTERM"}, 0, "finished"),
    # The second leaves out what can be, and the third ends it at once.
    ({"training": "SIGINT", "drawing": "SIGTERM"}, 130, "interrupted"),
    ({"saving": "SIGINT SIGINT SIGTERM"}, -signal.SIGTERM, "running"),
]


@pytest.mark.parametrize(
    ("plan", "code", "state"),
    MOMENTS,
    ids=[", ".join(f"{moment}: {names}" for moment, names in plan.items()) for plan, *_ in MOMENTS],
)
@pytest.mark.usefixtures("pictures")
def test_how_a_training_ends_by_signals(train_stopped, tmp_path, plan, code, state):
    found, record, folder = train_stopped(**plan)
    assert (found, record and record["state"]) == (code, state)
    if state is None:
        assert not (tmp_path / "logs").exists()
        assert (tmp_path / "err").read_text() == "train.py: ended by SIGTERM\n"
    elif state == "running":
        (draft,) = [name for name in holds(folder) if name.endswith(".tmp")]
        assert draft.startswith(".FrozenLake-v1.zip.")
        # The next command clears up.
        (folder / "notes.tmp").touch()
        assert train_stopped("--eval-freq", "-1", drawing="SIGINT")[0] == 130
        assert holds(folder) == ["best_model.zip", "notes.tmp"]
    elif state == "interrupted":
        # What was learnt is saved.
        assert (record["stopped_by"], "process" in record) == ("SIGINT", False)
        assert (record["n_timesteps"] < 600, record["final"]) == (True, None)
        assert "FrozenLake-v1.zip" in record["files"]
        assert ".tmp" not in {path.suffix for path in folder.iterdir()}


def test_what_is_ignored_from_outside_stays_ignored(train_stopped):
    """As under ``nohup``."""
    code, record, _ = train_stopped(ignored=["SIGHUP", "SIGINT"], training="SIGHUP SIGINT SIGHUP")
    assert (code, record["state"]) == (0, "finished")


# --- what an environment raises to end the program is its run's failure ------------------------

LEAVING = """
import gymnasium as gym


class Leaving(gym.Env):
    observation_space = gym.spaces.Discrete(4)
    action_space = gym.spaces.Discrete(2)
    resets = 0

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        self.resets += 1
        if self.resets == 20:
            raise SystemExit("bye")
        return 0, {}

    def step(self, action):
        return 0, 1.0, bool(self.np_random.random() < 0.2), False, {}


gym.register("Leaving-v0", Leaving, max_episode_steps=10)
"""


def test_a_run_has_failed_and_says_where(type_in_own_folder, own_folder):
    (own_folder / "leaving.py").write_text(LEAVING)
    code, _, said = type_in_own_folder(
        *("train.py", "--env", "Leaving-v0", "--algo", "qlearning", "-n", "300", "--verbose", "0"),
        *("--gym-packages", "leaving.py", "--eval-freq", "100"),
    )
    assert (code, said.count("\n")) == (2, 1)
    assert "leaving.py:14: SystemExit: bye, which ends no command" in said
    record = json.loads((own_folder / "logs/qlearning/Leaving-v0_1/run.json").read_text())
    assert record["state"] == "failed"
    assert "SystemExit: bye" in record["reason"]
