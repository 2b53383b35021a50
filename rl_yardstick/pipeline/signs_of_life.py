"""Shows the current activity: at once on a terminal, elsewhere as lines if it takes long."""

from __future__ import annotations

import _thread
import contextlib
import logging
import textwrap
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager

from rich.console import Console
from rich.markup import escape
from rich.progress import Progress, SpinnerColumn, TextColumn, TimeElapsedColumn

# Without a terminal, shorter activities are not reported.
SECONDS_BEFORE_A_LINE = 5.0
SECONDS_BETWEEN_LINES = 10.0

SECONDS_BETWEEN_LOOKS = 1.0
SECONDS_BETWEEN_FRAMES = 0.25
SPINNER = "line"  # ASCII, which every terminal can show

# A function that receives the progress in a few words.
Tell = Callable[[str], object]

MOST_COLUMNS = 100  # of a line of text

COMPILING = "compiling (the first time, some seconds)"


def can_move(console: Console) -> bool:
    """Whether a console can replace its output; plain terminals and files cannot."""
    return console.is_terminal and not console.is_dumb_terminal


def in_lines(console: Console, text: str) -> str:
    """The text in lines of at most 100 columns, broken between words."""
    width = min(console.width, MOST_COLUMNS)
    return textwrap.fill(
        text, width, subsequent_indent="  ", break_long_words=False, break_on_hyphens=False
    )


def tell_nobody(detail: str) -> None:
    """A `Tell` that does nothing."""


def duration(seconds: float) -> str:
    """Format a time in hours, minutes and seconds, without irrelevant units."""
    minutes, rest = divmod(round(seconds), 60)
    hours, minutes = divmod(minutes, 60)
    if hours:
        return f"{hours} h {minutes} min"
    return f"{minutes} min {rest} s" if minutes else f"{rest} s"


class Silence:
    """Decides when the next line is due; the first one after a given number of seconds."""

    def __init__(self, allowed: float = SECONDS_BEFORE_A_LINE) -> None:
        self._ends = time.monotonic() + allowed

    @property
    def is_too_long(self) -> bool:
        """Whether a line is due."""
        return time.monotonic() > self._ends

    def end(self) -> None:
        """Record that a line is printed now."""
        self._ends = time.monotonic() + SECONDS_BETWEEN_LINES


class Heartbeat:
    """Calls a function in a separate thread, with a fixed pause between two calls."""

    def __init__(self, function: Callable[[], object], seconds: float) -> None:
        self._function = function
        self._seconds = seconds
        self._calling = threading.RLock()
        self._stopping = threading.Event()

    def start(self) -> None:
        """Start calling the function."""
        self.stop()
        self._stopping = threading.Event()
        # If the machine cannot start a thread, work continues without heartbeats. `Thread` would
        # wait for the thread's start and end, which takes longer than a short task.
        with contextlib.suppress(RuntimeError):
            _thread.start_new_thread(self._beat, (self._stopping,))

    def stop(self) -> None:
        """Stop; the function is not called after this returns."""
        with self._calling:
            self._stopping.set()

    def _beat(self, stopping: threading.Event) -> None:
        # If writing fails, the main thread finds out by itself.
        with contextlib.suppress(OSError):
            while not stopping.wait(self._seconds):
                with self._calling:
                    if not stopping.is_set():
                        self._function()


class CompilationNotice(logging.Handler):
    """Reports the first compilation."""

    def __init__(self, say: Callable[[], object]) -> None:
        super().__init__(logging.INFO)
        self._say = say
        self.log = logging.getLogger("rl_yardstick.machine_code.cache")
        self.level_before = self.log.level

    def listen(self) -> None:
        """Start listening for compilations."""
        self.log.addHandler(self)
        self.log.setLevel(logging.INFO)

    def stop(self) -> None:
        """Stop listening."""
        self.log.removeHandler(self)
        self.log.setLevel(self.level_before)

    def emit(self, record: logging.LogRecord) -> None:
        if record.levelno == logging.INFO:
            self.stop()
            self._say()


class Activity:
    """The current activity; `doing` shows it."""

    def __init__(self, console: Console, text: str) -> None:
        self.console = console
        self._silence = Silence()
        self._bar: Progress | None = None
        self.now(text)

    def now(self, text: str) -> None:
        """Switch to another activity."""
        self._text = text
        self._detail = ""
        self._since = time.monotonic()

    def at(self, detail: str) -> None:
        """Set the progress; cheap enough for every step of a loop."""
        self._detail = detail

    def say(self, line: str) -> None:
        """Print a permanent line."""
        self._silence.end()
        self.console.print(line, markup=False, highlight=False, soft_wrap=True)

    def look(self) -> None:
        """Show the progress; on a console with lines only, print one if it is due."""
        if self._bar is not None:
            self._bar.update(self._bar.task_ids[0], description=escape(self._words), refresh=True)
        elif self._silence.is_too_long:
            self.say(f"{self._words}, {time.monotonic() - self._since:.0f} s")

    @property
    def _words(self) -> str:
        return f"{self._text}: {self._detail}" if self._detail else self._text

    @contextmanager
    def shown(self) -> Iterator[None]:
        """Show the activity while the ``with`` statement runs; a terminal is cleared afterwards."""
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
        if self._bar is None:  # a permanent line names its activity
            self.say(f"{self._text}: {COMPILING}")
        else:
            self.at(COMPILING)


@contextmanager
def doing(console: Console, text: str) -> Iterator[Activity]:
    """Show an activity while the ``with`` statement runs.

    On a terminal, this is an animated line that disappears at the end. Elsewhere, it prints a line
    after five seconds and then every ten seconds. A quiet console shows nothing.
    """
    activity = Activity(console, text)
    if console.quiet:
        yield activity
        return
    with activity.shown():
        yield activity
