"""What a person watching a training run reads, in a terminal and elsewhere."""

import io
import logging
import re
from types import SimpleNamespace

import pytest
from rich.console import Console
from stable_baselines3.common.callbacks import BaseCallback

import pipeline.progress as module
from agents import load_algorithm
from pipeline.progress import ProgressDisplay


@pytest.fixture(autouse=True, scope="module")
def compiled():
    """What the agent needs is compiled before anything is counted."""
    load_algorithm("qlearning")(env="FrozenLake-v1", engine="interpreted").learn(1)


@pytest.fixture
def clock(monkeypatch):
    """A clock on which a step takes 10 milliseconds, as far as the display asks for the time."""
    fake = SimpleNamespace(now=0.0)

    def monotonic():
        fake.now += 0.01
        return fake.now

    monkeypatch.setattr(module, "time", SimpleNamespace(monotonic=monotonic))
    return fake


def watched(n_steps, *, live, terminal, **arguments):
    """What is written while an agent learns."""
    file = io.StringIO()
    console = Console(file=file, width=120, force_terminal=terminal, color_system=None)
    arguments = {"engine": "interpreted", **arguments}
    agent = load_algorithm("qlearning")(env="FrozenLake-v1", seed=0, **arguments)
    display = ProgressDisplay(console, live=live)
    agent.learn(n_steps, callback=display)
    return display, file.getvalue()


def test_elsewhere_ten_plain_lines(clock):
    _, text = watched(1000, live=False, terminal=False)
    lines = text.splitlines()
    assert len(lines) == 10
    shares = [int(re.match(r" *(\d+)%  ", line)[1]) for line in lines]
    # It looks at the clock ten steps apart, and so is late by that much at most.
    assert [share // 10 for share in shares] == list(range(1, 11))
    assert max(share % 10 for share in shares) <= 1
    for line, share in zip(lines[1:], shares[1:], strict=True):
        steps, speed = re.match(
            r" *\d+%  ([\d,]+) steps  ([\d,]+) steps/s  mean return", line
        ).groups()
        assert int(steps.replace(",", "")) == pytest.approx(10 * share, abs=6)
        # A hundred readings of the clock a second, one for each step and one more for each line.
        assert int(speed.replace(",", "")) == pytest.approx(100, rel=0.15)
    assert lines[-1].startswith("100%  1,000 steps")
    assert "\x1b" not in text
    assert re.search(r"mean return 0\.\d\d$", lines[-1])


def test_no_return_is_shown_before_an_episode_has_ended(clock):
    _, text = watched(5, live=False, terminal=False)
    assert re.fullmatch(r"100%  5 steps  \d+ steps/s\n", text)


def test_a_second_training_counts_its_own_speed(clock):
    console = Console(file=io.StringIO(), force_terminal=False)
    agent = load_algorithm("qlearning")(env="FrozenLake-v1", seed=0, engine="interpreted")
    agent.learn(5000)
    agent.learn(100, callback=ProgressDisplay(console, live=False), reset_num_timesteps=False)
    last = console.file.getvalue().splitlines()[-1]
    steps, speed = re.search(r"([\d,]+) steps  ([\d,]+) steps/s", last).groups()
    assert steps == "5,100"
    assert int(speed) <= 110


def test_in_a_terminal_a_bar(clock):
    display, text = watched(1000, live=True, terminal=True)
    plain = re.sub(r"\x1b\[[0-9;?]*[a-zA-Z]", "", text)
    shown = [int(share) for share in re.findall(r"(\d+)% ", plain)]
    assert shown == sorted(shown)
    assert len(set(shown)) > 20
    assert shown[-1] == 100
    assert re.search(r"100% +1,000 steps  [\d,]+ steps/s  mean return 0\.\d\d", plain)
    # The bar lets go of the terminal: the cursor is shown again, and closing twice is harmless.
    assert text.rindex("\x1b[?25h") > text.rindex("\x1b[?25l")
    assert display.bar is None
    display.close()
    # Nor does it write anything once it has let go, as after an interruption.
    display.on_training_end()
    assert display.console.file.getvalue() == text


def test_a_bar_moves_ten_times_a_second_at_most(clock):
    _, text = watched(1000, live=True, terminal=True)
    plain = re.sub(r"\x1b\[[0-9;?]*[a-zA-Z]", "", text)
    # Ten seconds, by a clock of which every reading takes a hundredth.
    assert len(re.findall(r"\d+% ", plain)) <= 110


def test_a_bar_may_be_asked_for_without_a_terminal(clock):
    _, text = watched(200, live=True, terminal=False)
    assert len(text.splitlines()) == 1
    assert "100%" in text
    assert "200 steps" in text


class Compiling(BaseCallback):
    """Stands for a loop that has to be compiled, or for more than one."""

    def __init__(self, times):
        super().__init__()
        self.times = times

    def _on_step(self):
        for _ in range(self.times):
            logging.getLogger("mdp.machine_code").info("compiling run_block")
        return True


@pytest.mark.parametrize(
    ("times", "said"),
    [(2, "compiling the training loop (the first time, some seconds)\n"), (0, "")],
)
def test_compiling_is_said_once(clock, times, said):
    console = Console(file=io.StringIO(), width=120, force_terminal=False)
    agent = load_algorithm("qlearning")(env="FrozenLake-v1", seed=0, engine="interpreted")
    agent.learn(3, callback=[Compiling(times), ProgressDisplay(console, live=False)])
    assert console.file.getvalue().partition("100%")[0] == said
    # Afterwards nobody listens any more.
    logging.getLogger("mdp.machine_code").info("compiling run_block")
    assert console.file.getvalue().count("compiling") == bool(times)
