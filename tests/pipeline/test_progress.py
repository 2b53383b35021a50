"""What a person watching a training run reads, in a terminal and elsewhere."""

import io
import logging
import re
from contextlib import nullcontext
from types import SimpleNamespace

import pytest
from rich.console import Console
from stable_baselines3.common.callbacks import BaseCallback

import pipeline.progress as module
from agents import load_algorithm
from pipeline import signs_of_life
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
    # What is due by the clock looks at it without letting it go on, and not by itself.
    monkeypatch.setattr(signs_of_life, "time", SimpleNamespace(monotonic=lambda: fake.now))
    monkeypatch.setattr(module, "Heartbeat", lambda *_: SimpleNamespace(start=skip, stop=skip))
    return fake


def skip():
    pass


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
        steps, left = re.match(
            r" *\d+%  ([\d,]+) steps  mean return in training 0\.\d\d"
            r"(?:  about (\d+) s left by the clock)?$",
            line,
        ).groups()
        assert int(steps.replace(",", "")) == pytest.approx(10 * share, abs=6)
        # A hundred readings of the clock a second, one for each step and more for each line.
        assert int(left or 0) == pytest.approx((100 - share) / 10, abs=1.5)
    assert lines[-1].startswith("100%  1,000 steps")
    assert "\x1b" not in text
    assert re.search(r"mean return in training 0\.\d\d$", lines[-1])


def test_no_return_is_shown_before_an_episode_has_ended(clock):
    _, text = watched(5, live=False, terminal=False)
    assert re.fullmatch(r"100%  5 steps\n", text)


def test_a_second_training_counts_its_own_steps_alone(clock):
    console = Console(file=io.StringIO(), force_terminal=False)
    agent = load_algorithm("qlearning")(env="FrozenLake-v1", seed=0, engine="interpreted")
    agent.learn(1000)
    agent.learn(1000, callback=ProgressDisplay(console, live=False), reset_num_timesteps=False)
    *lines, last = console.file.getvalue().splitlines()
    assert "2,000 steps" in last
    left = {line[:3]: re.search(r"about (\d+) s left", line) for line in lines}
    assert int(left[" 60"][1]) == pytest.approx(8, abs=1)


def test_in_a_terminal_a_bar(clock):
    display, text = watched(1000, live=True, terminal=True)
    plain = re.sub(r"\x1b\[[0-9;?]*[a-zA-Z]", "", text)
    shown = [int(share) for share in re.findall(r"(\d+)% ", plain)]
    assert shown == sorted(shown)
    assert len(set(shown)) > 20
    assert shown[-1] == 100
    assert re.search(r"100% +1,000 steps  mean return in training 0\.\d\d", plain)
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


class Slow(BaseCallback):
    """Lets time go by in one step, and the display look at it every second."""

    def __init__(self, display, clock, at, seconds, activity=None):
        super().__init__()
        self.display, self.clock, self.at, self.seconds = display, clock, at, seconds
        self.activity = activity

    def _on_step(self):
        if self.num_timesteps == self.at:
            with self.display.doing(self.activity) if self.activity else nullcontext():
                for _ in range(self.seconds):
                    self.clock.now += 1
                    self.display.look()
        return True


def slow_training(clock, live=False, **options):
    """What is written of five steps, of which one takes 24 seconds."""
    file = io.StringIO()
    # A line is one line, however narrow the console is that rich assumes in a pipe.
    width = 120 if live else 20
    console = Console(file=file, width=width, force_terminal=live, color_system=None)
    agent = load_algorithm("qlearning")(env="FrozenLake-v1", seed=0, engine="interpreted")
    display = ProgressDisplay(console, live=live)
    agent.learn(1000, callback=[display, Slow(display, clock, seconds=24, **options)])
    return re.sub(r"\x1b\[[0-9;?]*[a-zA-Z]", "", file.getvalue())


def test_a_line_comes_early_and_then_every_ten_seconds_also_while_no_step_ends(clock):
    lines = slow_training(clock, at=30, activity="evaluating").splitlines()
    # Two seconds after the beginning, and then ten after each line.
    assert re.fullmatch(
        r"  \d%  2\d steps  mean return in training 0.00  evaluating, 2 s", lines[0]
    )
    assert "left by the clock" in lines[3]
    assert [re.search(r"evaluating, (\d+) s", line)[1] for line in lines[:3]] == ["2", "12", "22"]
    # Thereafter nothing of it is left.
    assert not any("evaluating" in line for line in lines[3:])
    assert re.match(r" 10%  10\d steps", lines[3])
    assert len(lines) == 13


def test_before_the_first_step_there_is_a_line_too(clock):
    file = io.StringIO()
    display = ProgressDisplay(Console(file=file, force_terminal=False), live=False)
    agent = load_algorithm("qlearning")(env="FrozenLake-v1", seed=0, engine="interpreted")
    agent._setup_learn(10, display)
    display.init_callback(agent)
    display.on_training_start({}, {})
    clock.now += 3
    display.look()
    display.close()
    assert file.getvalue() == "  0%\n"


def test_what_goes_on_besides_training_stands_beside_the_bar(clock):
    text = slow_training(clock, live=True, at=30, activity="evaluating")
    assert "evaluating, 12 s" in text
    assert "evaluating" not in text[text.index("50%") :]


def test_learning_between_two_rollouts_is_said(clock):
    console = Console(file=io.StringIO(), width=120, force_terminal=False)
    display = ProgressDisplay(console, live=False)

    class LooksWhileItLearns(BaseCallback):
        def _on_step(self):
            return True

        def _on_rollout_end(self):
            for _ in range(3):
                clock.now += 1
                display.look()

    agent = load_algorithm("ppo")("MlpPolicy", "CartPole-v1", n_steps=8, batch_size=8, seed=0)
    agent.learn(8, callback=[display, LooksWhileItLearns()])
    assert "  learning, 2 s\n" in console.file.getvalue()


def test_returns_of_a_variant_are_called_so(clock):
    file = io.StringIO()
    agent = load_algorithm("qlearning")(env="FrozenLake-v1", seed=0, engine="interpreted")
    display = ProgressDisplay(Console(file=file, width=120), live=False, on_variant=True)
    agent.learn(100, callback=display)
    assert re.search(
        r"in training \(there the environment is changed\) 0\.\d\d$", file.getvalue().rstrip()
    )


class Compiling(BaseCallback):
    """Stands for a loop that has to be compiled, or for more than one."""

    def __init__(self, times):
        super().__init__()
        self.times = times

    def _on_step(self):
        for _ in range(self.times):
            logging.getLogger("machine_code").info("compiling run_block")
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
    logging.getLogger("machine_code").info("compiling run_block")
    assert console.file.getvalue().count("compiling") == bool(times)
