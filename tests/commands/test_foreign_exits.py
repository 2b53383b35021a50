"""What an environment raises to end the program is its run's failure, and ends no command."""

import json
import signal

import gymnasium as gym
import pytest

from pipeline.failures import ForeignExitError, exits_as_mistakes

LEAVING = """
import gymnasium as gym

import builtins


class Leaving(gym.Env):
    observation_space = gym.spaces.Discrete(4)
    action_space = gym.spaces.Discrete(2)

    def __init__(self, where="step", kind="SystemExit", words=None, after=1, render_mode=None):
        self.where, self.after, self.words, self.calls = where, after, words, 0
        self.kind = getattr(builtins, kind)

    def leave(self, where):
        self.calls += where == self.where
        if where == self.where and self.calls > self.after:
            raise self.kind() if self.words is None else self.kind(self.words)

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        self.leave("reset")
        return 0, {}

    def step(self, action):
        self.leave("step")
        return int(self.np_random.integers(4)), 1.0, bool(self.np_random.random() < 0.2), False, {}

    def close(self):
        self.leave("close")


gym.register("Leaving-v0", Leaving, max_episode_steps=10)
"""


@pytest.fixture
def train_in(type_in_own_folder, own_folder):
    """Train on an environment that leaves; code, what is said, and the record if there is one."""
    (own_folder / "leaving.py").write_text(LEAVING)

    def train(*kwargs, algo="qlearning"):
        code, _, said = type_in_own_folder(
            *("train.py", "--env", "Leaving-v0", "--algo", algo, "-n", "300", "--verbose", "0"),
            *("--gym-packages", "leaving.py", "--eval-freq", "100", "--env-kwargs", *kwargs),
        )
        record = own_folder / "logs" / algo / "Leaving-v0_1" / "run.json"
        return code, said, json.loads(record.read_text()) if record.exists() else None

    yield train
    gym.registry.pop("Leaving-v0", None)


@pytest.mark.parametrize(
    ("kind", "words"),
    [
        ("SystemExit", ""),
        ("SystemExit", "words:0"),
        ("SystemExit", "words:1"),
        ("SystemExit", "words:'text'"),
        ("KeyboardInterrupt", ""),
    ],
)
@pytest.mark.parametrize("moment", ["where:'reset' after:20", "where:'step' after:0"])
def test_a_run_has_failed_and_says_where(train_in, kind, words, moment):
    code, said, record = train_in(*moment.split(), f"kind:'{kind}'", *filter(None, [words]))
    text = words.partition(":")[2].strip("'")
    assert code == 2
    assert f"leaving.py:18: {kind}{text and f': {text}'}, which ends no command" in said
    assert said.count("\n") == 1
    assert record["state"] == "failed"
    assert f"{kind}{text and f': {text}'}" in record["reason"]


def test_so_has_one_whose_environment_leaves_when_it_is_closed(train_in):
    code, said, record = train_in("where:'close'", "after:0", "words:0", algo="random")
    assert (code, said.count("\n")) == (2, 1)
    assert record is None or record["state"] == "failed"


def test_before_the_run_is_set_up_nothing_is_left(train_in):
    code, said, record = train_in("where:'reset'", "after:0", "words:0")
    assert (code, said.count("\n")) == (2, 1)
    assert record is None or record["state"] == "failed"


@pytest.mark.parametrize(
    ("handler", "error", "raised"),
    [
        (signal.default_int_handler, KeyboardInterrupt, KeyboardInterrupt),
        (signal.SIG_IGN, KeyboardInterrupt, ForeignExitError),
        (signal.default_int_handler, SystemExit, ForeignExitError),
    ],
)
def test_what_may_be_ctrl_c_stays_what_it_is(handler, error, raised):
    before = signal.signal(signal.SIGINT, handler)
    try:
        with pytest.raises(raised), exits_as_mistakes():
            raise error
    finally:
        signal.signal(signal.SIGINT, before)
