"""What a person watching reads, in terminals and elsewhere, of trainings and of what takes long."""

import io
import logging
import re
import threading
from contextlib import nullcontext
from types import SimpleNamespace

import pytest
from rich.console import Console
from stable_baselines3.common.callbacks import BaseCallback

from agents import load_algorithm
from pipeline import progress, signs_of_life
from pipeline.progress import ProgressDisplay
from pipeline.signs_of_life import COMPILING, Heartbeat, can_move, doing


def learner():
    return load_algorithm("qlearning")(env="FrozenLake-v1", seed=0, engine="interpreted")


@pytest.fixture(autouse=True, scope="module")
def compiled():
    """What the agent needs is compiled before anything is counted."""
    learner().learn(1)


@pytest.fixture
def clock(monkeypatch):
    """A clock on which a step takes 10 milliseconds, as far as the display asks for the time."""
    fake = SimpleNamespace(now=0.0)

    def monotonic():
        fake.now += 0.01
        return fake.now

    monkeypatch.setattr(progress, "time", SimpleNamespace(monotonic=monotonic))
    # What is due by the clock looks at it without letting it go on.
    monkeypatch.setattr(signs_of_life, "time", SimpleNamespace(monotonic=lambda: fake.now))
    return fake


@pytest.fixture(autouse=True)
def hearts(monkeypatch):
    """Nothing beats by itself; which hearts do is noted."""
    beating = []

    class StillHeart(Heartbeat):
        def start(self):
            beating.append(self)

        def stop(self):
            beating.clear()

    for module in (progress, signs_of_life):
        monkeypatch.setattr(module, "Heartbeat", StillHeart)
    return beating


def console_of(terminal, width=120, **options):
    file = io.StringIO()
    return file, Console(
        file=file, width=width, force_terminal=terminal, color_system=None, **options
    )


def plain(text):
    """Without the codes that move the cursor."""
    return re.sub(r"\x1b\[[0-9;?]*[a-zA-Z]", "", text)


def watched(n_steps, *, live):
    """What is written while an agent learns."""
    file, console = console_of(live)
    display = ProgressDisplay(console, live=live)
    learner().learn(n_steps, callback=display)
    return display, file.getvalue()


def compile_something():
    logging.getLogger("machine_code").info("compiling run_block")


# --- a training ----------------------------------------------------------------------------------


def test_elsewhere_ten_plain_lines(clock):
    _, text = watched(1000, live=False)
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
    # No return is shown before an episode has ended.
    assert watched(5, live=False)[1] == "100%  5 steps\n"


def test_a_second_training_counts_its_own_steps_alone(clock):
    file, console = console_of(terminal=False)
    agent = learner().learn(1000)
    agent.learn(1000, callback=ProgressDisplay(console, live=False), reset_num_timesteps=False)
    *lines, last = file.getvalue().splitlines()
    assert "2,000 steps" in last
    left = {line[:3]: re.search(r"about (\d+) s left", line) for line in lines}
    assert int(left[" 60"][1]) == pytest.approx(8, abs=1)


def test_in_a_terminal_a_bar(clock):
    display, text = watched(1000, live=True)
    shown = [int(share) for share in re.findall(r"(\d+)% ", plain(text))]
    assert shown == sorted(shown)
    assert len(set(shown)) > 20
    assert shown[-1] == 100
    # Ten seconds, by a clock of which every reading takes a hundredth: ten times a second at most.
    assert len(shown) <= 110
    assert re.search(r"100% +1,000 steps  mean return in training 0\.\d\d", plain(text))
    # The bar lets go of the terminal: the cursor is shown again, and closing twice is harmless.
    assert text.rindex("\x1b[?25h") > text.rindex("\x1b[?25l")
    assert display.bar is None
    display.close()
    # Nor does it write anything once it has let go, as after an interruption.
    display.on_training_end()
    assert display.console.file.getvalue() == text


class Slow(BaseCallback):
    """Lets 24 seconds go by in one step, and the display look at it every second."""

    def __init__(self, display, clock):
        super().__init__()
        self.display, self.clock = display, clock

    def _on_step(self):
        if self.num_timesteps == 30:
            with self.display.doing("evaluating"):
                for _ in range(24):
                    self.clock.now += 1
                    self.display.look()
        return True


def slow_training(clock, live=False):
    # A line is one line, however narrow the console is that rich assumes in a pipe.
    file, console = console_of(live, width=120 if live else 20)
    display = ProgressDisplay(console, live=live)
    learner().learn(1000, callback=[display, Slow(display, clock)])
    return plain(file.getvalue())


def test_a_line_comes_early_and_then_every_ten_seconds_also_while_no_step_ends(clock):
    lines = slow_training(clock).splitlines()
    # Two seconds after the beginning, and then ten after each line.
    first = r"  \d%  2\d steps  mean return in training 0.00  evaluating, 2 s"
    assert re.fullmatch(first, lines[0])
    assert "left by the clock" in lines[3]
    assert [re.search(r"evaluating, (\d+) s", line)[1] for line in lines[:3]] == ["2", "12", "22"]
    # Thereafter nothing of it is left.
    assert not any("evaluating" in line for line in lines[3:])
    assert re.match(r" 10%  10\d steps", lines[3])
    assert len(lines) == 13


def test_what_goes_on_besides_training_stands_beside_the_bar(clock):
    text = slow_training(clock, live=True)
    assert "evaluating, 12 s" in text
    assert "evaluating" not in text[text.index("50%") :]


@pytest.mark.parametrize(("moment", "said"), [("start", "  0%\n"), ("end", "  learning, 2 s\n")])
def test_before_the_first_step_and_between_two_rollouts_there_is_a_line_too(clock, moment, said):
    class LooksBesides(BaseCallback):
        def _on_training_start(self):
            self.look("start")

        def _on_step(self):
            return True

        def _on_rollout_end(self):
            self.look("end")

        def look(self, now):
            for _ in range(3 * (now == moment)):
                clock.now += 1
                display.look()

    file, console = console_of(terminal=False)
    display = ProgressDisplay(console, live=False)
    agent = load_algorithm("ppo")("MlpPolicy", "CartPole-v1", n_steps=8, batch_size=8, seed=0)
    agent.learn(8, callback=[display, LooksBesides()])
    assert said in file.getvalue()


@pytest.mark.parametrize("times", [2, 0])
def test_compiling_is_said_once_and_a_variant_is_called_so(clock, times):
    class Compiling(BaseCallback):
        def _on_step(self):
            for _ in range(times):
                compile_something()
            return True

    file, console = console_of(terminal=False)
    display = ProgressDisplay(console, live=False, on_variant=True)
    learner().learn(100, callback=[Compiling(), display])
    compile_something()  # afterwards nobody listens any more
    said = "compiling the training loop (the first time, some seconds)\n" * bool(times)
    assert file.getvalue().startswith(said)
    assert file.getvalue().count("compiling") == bool(times)
    variant = r"in training \(there the environment is changed\) 0\.\d\d$"
    assert re.search(variant, file.getvalue().rstrip())


# --- anything that takes long --------------------------------------------------------------------


def test_what_takes_long_is_said_after_five_seconds_and_then_every_ten(clock):
    file, console = console_of(terminal=False)
    said = []
    with doing(console, "drawing [all]") as activity:
        for second in range(1, 40):
            clock.now += 1
            activity.look()
            if len(file.getvalue().splitlines()) > len(said):
                said.append(second)
            if second == 20:
                activity.now("writing")
                activity.at("section 2 of 3")
    assert said == [6, 17, 28, 39]
    assert file.getvalue().splitlines() == [
        "drawing [all], 6 s",
        "drawing [all], 17 s",
        "writing: section 2 of 3, 8 s",
        "writing: section 2 of 3, 19 s",
    ]


def test_a_line_that_is_printed_meanwhile_breaks_the_silence(clock):
    file, console = console_of(terminal=False)
    with doing(console, "playing") as activity:
        for _ in range(9):
            clock.now += 4
            activity.say("episode [1]")
            activity.look()
    assert file.getvalue() == "episode [1]\n" * 9


def test_compiling_is_said_at_once_and_once(clock):
    file, console = console_of(terminal=False)
    with doing(console, "loading") as activity:
        compile_something()
        compile_something()
        clock.now += 9
        activity.look()
    compile_something()
    assert file.getvalue() == f"loading: {COMPILING}\n"


def test_a_quiet_console_gets_no_line_and_no_thread(clock, hearts):
    file, console = console_of(terminal=True, quiet=True)
    with doing(console, "loading") as activity:
        assert not hearts
        clock.now += 100
        activity.look()
        compile_something()
    assert file.getvalue() == ""


@pytest.mark.parametrize("error", [None, KeyboardInterrupt, ValueError])
def test_on_a_terminal_one_line_moves_and_is_gone_in_the_end(clock, hearts, error):
    file, console = console_of(terminal=True)

    def work():
        with doing(console, "loading [x]") as activity:
            assert hearts
            # It is there at once, and does not wait for its heart.
            assert "loading [x]" in plain(file.getvalue())
            activity.at("2 of 3")
            activity.look()
            assert "loading [x]: 2 of 3" in plain(file.getvalue())
            compile_something()
            activity.look()
            assert f"loading [x]: {COMPILING}" in plain(file.getvalue())
            activity.say("a line")
            if error:
                raise error

    with pytest.raises(error) if error else nullcontext():
        work()
    text = file.getvalue()
    assert "\na line" in plain(text).replace("\r", "\n")
    # The line was erased after it had been drawn for the last time, and the cursor is back.
    assert text.rindex("\x1b[2K") > text.rindex("loading")
    assert text.rindex("\x1b[?25h") > text.rindex("\x1b[?25l")
    assert not hearts
    compile_something()
    assert file.getvalue() == text


@pytest.mark.parametrize(
    ("terminal", "term", "moves"),
    [(True, "xterm", True), (True, "dumb", False), (False, "", False)],
)
def test_a_line_moves_on_a_terminal_that_can(monkeypatch, terminal, term, moves):
    monkeypatch.setenv("TERM", term)
    assert can_move(Console(file=io.StringIO(), force_terminal=terminal)) is moves


# --- the heart -----------------------------------------------------------------------------------


def test_a_heart_beats_until_it_is_stopped_and_may_begin_again():
    beats = threading.Semaphore(0)
    heart = Heartbeat(beats.release, 0.001)
    for _ in range(2):
        heart.start()
        for _ in range(3):
            assert beats.acquire(timeout=30)
        heart.stop()
        heart.stop()
        while beats.acquire(blocking=False):
            pass
        assert not beats.acquire(timeout=0.02)


def test_a_heart_that_is_stopped_has_ended_its_last_call_and_may_stop_itself():
    begun, may_end, calls = threading.Event(), threading.Event(), []

    def call():
        begun.set()
        may_end.wait(30)
        calls.append(1)

    heart = Heartbeat(call, 0.001)
    heart.start()
    assert begun.wait(30)
    threading.Timer(0.05, may_end.set).start()
    heart.stop()
    assert calls == [1]
    stopped = threading.Event()
    suicidal = Heartbeat(lambda: (suicidal.stop(), stopped.set()), 0.001)
    suicidal.start()
    assert stopped.wait(30)


def test_a_heart_that_cannot_write_stands_still_without_a_word(capfd):
    tried = threading.Semaphore(0)

    def fail():
        tried.release()
        raise OSError(28, "No space left on device")

    heart = Heartbeat(fail, 0.001)
    heart.start()
    assert tried.acquire(timeout=30)
    heart.stop()
    assert not tried.acquire(blocking=False)
    assert capfd.readouterr() == ("", "")
