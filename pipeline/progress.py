"""What a person watching sees: what is being done now, and how far a training is."""

from __future__ import annotations

import _thread
import contextlib
import logging
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager

import numpy as np
from rich.console import Console
from rich.markup import escape
from rich.progress import (
    BarColumn,
    Progress,
    SpinnerColumn,
    TaskProgressColumn,
    TextColumn,
    TimeElapsedColumn,
)

from agents.common.callbacks import BlockCallback

# What is being done now: shown at once on a terminal, and elsewhere said where it takes long.

# What is shorter than that goes without a word where lines stay.
SECONDS_BEFORE_A_LINE = 5.0
SECONDS_BETWEEN_LINES = 10.0

SECONDS_BETWEEN_LOOKS = 1.0
SECONDS_BETWEEN_FRAMES = 0.25
SPINNER = "line"  # plain letters, which every terminal has

# Told how far something is, in a few words.
Tell = Callable[[str], object]

COMPILING = "compiling (the first time, some seconds)"


def can_move(console: Console) -> bool:
    """Whether what is shown on a console can be replaced: on no plain teletype, nor in a file."""
    return console.is_terminal and not console.is_dumb_terminal


def tell_nobody(detail: str) -> None:
    """A `Tell` where nobody watches."""


def duration(seconds: float) -> str:
    """A time in hours, minutes and seconds, as far as they matter."""
    minutes, rest = divmod(round(seconds), 60)
    hours, minutes = divmod(minutes, 60)
    if hours:
        return f"{hours} h {minutes} min"
    return f"{minutes} min {rest} s" if minutes else f"{rest} s"


class Silence:
    """How long nothing has been said, by a clock of its own.

    Args:
        allowed: seconds until the first line is due; for each after that, `SECONDS_BETWEEN_LINES`.
    """

    def __init__(self, allowed: float = SECONDS_BEFORE_A_LINE) -> None:
        self._ends = time.monotonic() + allowed

    @property
    def is_too_long(self) -> bool:
        """Whether a line is due."""
        return time.monotonic() > self._ends

    def end(self) -> None:
        """Note that something is being said now."""
        self._ends = time.monotonic() + SECONDS_BETWEEN_LINES


class Heartbeat:
    """Calls a function every so often, whatever else goes on; it begins and ends as often as asked.

    Args:
        function: called in a thread of its own.
        seconds: between two calls.
    """

    def __init__(self, function: Callable[[], object], seconds: float) -> None:
        self._function = function
        self._seconds = seconds
        self._calling = threading.RLock()
        self._stopping = threading.Event()

    def start(self) -> None:
        """Begin to call the function."""
        self.stop()
        self._stopping = threading.Event()
        # Where the machine has no thread left, the work goes on without these signs. `Thread` would
        # wait until the thread runs, and again until it is gone: longer than a short work takes.
        with contextlib.suppress(RuntimeError):
            _thread.start_new_thread(self._beat, (self._stopping,))

    def stop(self) -> None:
        """Call it no more, from when this returns; harmless when called again."""
        with self._calling:
            self._stopping.set()

    def _beat(self, stopping: threading.Event) -> None:
        # Where nothing can be written any more, the main thread learns of it by itself.
        with contextlib.suppress(OSError):
            while not stopping.wait(self._seconds):
                with self._calling:
                    if not stopping.is_set():
                        self._function()


class CompilationNotice(logging.Handler):
    """Says once that something is being compiled.

    Args:
        say: called when that begins.
    """

    def __init__(self, say: Callable[[], object]) -> None:
        super().__init__(logging.INFO)
        self._say = say
        self.log = logging.getLogger("machine_code")
        self.level_before = self.log.level

    def listen(self) -> None:
        """Begin to wait for something to be compiled."""
        self.log.addHandler(self)
        self.log.setLevel(logging.INFO)

    def stop(self) -> None:
        """Say no more; harmless when called again."""
        self.log.removeHandler(self)
        self.log.setLevel(self.level_before)

    def emit(self, record: logging.LogRecord) -> None:
        if record.levelno == logging.INFO:
            self.stop()
            self._say()


class Activity:
    """What is being done now; `doing` shows it.

    Args:
        console: where to.
        text: what it is.
    """

    def __init__(self, console: Console, text: str) -> None:
        self.console = console
        self._silence = Silence()
        self._bar: Progress | None = None
        self.now(text)

    def now(self, text: str) -> None:
        """Go on to something else."""
        self._text = text
        self._detail = ""
        self._since = time.monotonic()

    def at(self, detail: str) -> None:
        """Tell how far it is; cheap enough for every step of a loop."""
        self._detail = detail

    def say(self, line: str) -> None:
        """Print a line that stays."""
        self._silence.end()
        self.console.print(line, markup=False, highlight=False, soft_wrap=True)

    def look(self) -> None:
        """Show how far things are, or say it where only lines can be had and one is due."""
        if self._bar is not None:
            self._bar.update(self._bar.task_ids[0], description=escape(self._words), refresh=True)
        elif self._silence.is_too_long:
            self.say(f"{self._words}, {time.monotonic() - self._since:.0f} s")

    @property
    def _words(self) -> str:
        return f"{self._text}: {self._detail}" if self._detail else self._text

    @contextmanager
    def shown(self) -> Iterator[None]:
        """Show it while the ``with`` statement runs, and leave nothing of it on a terminal."""
        with ExitStack() as stack:
            if can_move(self.console):
                columns = (
                    SpinnerColumn(SPINNER),
                    TextColumn("{task.description}"),
                    TimeElapsedColumn(),
                )
                self._bar = Progress(
                    *columns, console=self.console, transient=True, auto_refresh=False
                )
                stack.enter_context(self._bar)
                self._bar.add_task(escape(self._words), total=None)
                self._bar.refresh()
            seconds = SECONDS_BETWEEN_LOOKS if self._bar is None else SECONDS_BETWEEN_FRAMES
            heart = Heartbeat(self.look, seconds)
            stack.callback(heart.stop)
            heart.start()
            notice = CompilationNotice(self._on_compiling)
            stack.callback(notice.stop)
            notice.listen()
            yield

    def _on_compiling(self) -> None:
        if self._bar is None:  # a line that stays says what it was for
            self.say(f"{self._text}: {COMPILING}")
        else:
            self.at(COMPILING)


@contextmanager
def doing(console: Console, text: str) -> Iterator[Activity]:
    """Show what is being done while the ``with`` statement runs.

    On a terminal that is a line that moves and is gone at the end. Elsewhere lines stay, so there
    is none for what is over in five seconds, and then one every ten.

    Args:
        console: where to; nothing is shown on a quiet one.
        text: what is being done.

    Yields:
        What tells of further activities and prints lines between.
    """
    activity = Activity(console, text)
    if console.quiet:
        yield activity
        return
    with activity.shown():
        yield activity


# What a person watching a training run sees.

SECONDS_BETWEEN_UPDATES = 0.1
SECONDS_BEFORE_THE_FIRST_LINE = 2.0
LINES_WITHOUT_TERMINAL = 10

LEARNING = "learning"
_COMPILING = "compiling the training loop"


class ProgressDisplay(BlockCallback):
    """A live bar in a terminal, a few plain lines elsewhere: steps, mean return, time left.

    A line is printed for every tenth of the training, two seconds after its beginning, and where
    ten seconds have gone by since the last.

    Args:
        console: where to.
        live: whether to draw a bar that moves.
        on_variant: whether returns of training are not to be held against those of evaluation.
    """

    takes_blocks = True

    def __init__(self, console: Console, live: bool, on_variant: bool = False) -> None:
        super().__init__()
        self.console = console
        self.bar: Progress | None = None
        self.live = live
        self.on_variant = on_variant
        self.has_begun = False
        self.updated = 0.0
        self.tenths_shown = 0
        # Moments and the share that was done by then, a thousandth or more apart.
        self.marks: list[tuple[float, float]] = []
        self.figures = ""
        self.activity = ""
        self.silence = Silence(SECONDS_BEFORE_THE_FIRST_LINE)
        self.notice = CompilationNotice(self._on_compiling)
        self.heart = Heartbeat(self.look, SECONDS_BETWEEN_FRAMES if live else SECONDS_BETWEEN_LOOKS)

    def _on_training_start(self) -> None:
        self.updated = time.monotonic()
        self.silence = Silence(SECONDS_BEFORE_THE_FIRST_LINE)
        self.notice.listen()
        self.has_begun, self.marks = False, [(self.updated, self.share_done)]
        if self.live:
            self.bar = Progress(
                SpinnerColumn(SPINNER),
                BarColumn(),
                TaskProgressColumn(),
                TextColumn("{task.fields[figures]}"),
                console=self.console,
                auto_refresh=False,
            )
            self.bar.start()
            self.task = self.bar.add_task("training", total=1.0, figures="")
        self.heart.start()

    def _on_rollout_start(self) -> None:
        self.activity = ""
        if not self.has_begun:  # a run that goes on is where it was by now
            share = min(self.model.num_timesteps / max(self.model._total_timesteps, 1), 1.0)
            self.has_begun, self.marks = True, [(time.monotonic(), share)]

    def _on_rollout_end(self) -> None:
        self.activity = LEARNING

    def _on_step(self) -> bool:
        now = time.monotonic()
        if now - self.updated > SECONDS_BETWEEN_UPDATES:
            self.updated = now
            self._show()
        return True

    def _on_training_end(self) -> None:
        self.activity = ""
        self._show()
        self.close()

    def close(self) -> None:
        """Give the terminal back; may be called again."""
        self.notice.stop()
        self.heart.stop()
        if self.bar is not None:
            self.bar.stop()
            self.bar = None

    @contextmanager
    def doing(self, activity: str) -> Iterator[None]:
        """Say so where it takes long what goes on besides training."""
        before, self.activity = self.activity, activity
        try:
            yield
        finally:
            self.activity = before

    @property
    def share_done(self) -> float:
        """How much of the training is behind."""
        return min(self.num_timesteps / max(self.model._total_timesteps, 1), 1.0)

    def look(self) -> None:
        """Show that the training is alive, also while it does not say how far it is."""
        if self.bar is not None:
            self._draw()
        elif not self.live and self.silence.is_too_long:
            self._print_line()

    def _show(self) -> None:
        self.figures = self._figures()
        if self.bar is not None:
            self._draw()
        elif not self.live:
            tenths = int(self.share_done * LINES_WITHOUT_TERMINAL)
            if tenths > self.tenths_shown:
                self.tenths_shown = tenths
                self._print_line()

    def _draw(self) -> None:
        if self.bar is not None:
            words = "  ".join(self._words())
            self.bar.update(self.task, completed=self.share_done, figures=words, refresh=True)

    def _print_line(self) -> None:
        self.silence.end()
        line = "  ".join([f"{self.share_done:4.0%}", *self._words()])
        self.console.print(line, highlight=False, soft_wrap=True)

    def _words(self) -> list[str]:
        """The figures and, where the training itself stands still, what goes on and how long."""
        words = [self.figures] if self.figures else []
        if self.activity and (seconds := time.monotonic() - self.updated) >= 1:
            words.append(f"{self.activity}, {seconds:.0f} s")
        return words

    def _on_compiling(self) -> None:
        self.activity = _COMPILING
        if self.bar is None:
            self.silence.end()
            self.console.print(f"{_COMPILING} (the first time, some seconds)", highlight=False)

    def _figures(self) -> str:
        figures = f"{self.num_timesteps:,} steps"
        episodes = self.model.ep_info_buffer
        if episodes:
            mean_return = np.mean([episode["r"] for episode in episodes])
            where = " (there the environment is changed)" if self.on_variant else ""
            figures += f"  mean return in training{where} {mean_return:.2f}"
        left = self._seconds_left()
        return figures if left is None else f"{figures}  about {duration(left)} left by the clock"

    def _seconds_left(self) -> float | None:
        """By the clock, at the speed of the last half of what is done; None where nobody knows.

        Off-policy agents are faster before they begin to learn. What comes before the first steps
        are done, such as compiling, does not count.
        """
        now, share = time.monotonic(), self.share_done
        if share >= self.marks[-1][1] + 0.001:
            self.marks.append((now, share))
        marks = self.marks[1:]
        if not marks or share < marks[0][1] + 0.02:
            return None
        half = (marks[0][1] + share) / 2
        began, before = next(mark for mark in reversed(marks) if mark[1] <= half)
        left = (now - began) * (1 - share) / (share - before)
        return left if share < 1 and left >= 1 else None
