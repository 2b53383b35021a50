"""What a person watching sees: a picture that moves, or where none can, a line now and then."""

from __future__ import annotations

import contextlib
import time
from abc import ABC, abstractmethod
from collections.abc import Iterator
from types import TracebackType
from typing import TYPE_CHECKING, Self

from rich.console import Console, RenderableType
from rich.live import Live
from rich.text import Text

from pipeline.signs_of_life import (
    SECONDS_BETWEEN_LINES,
    SECONDS_BETWEEN_LOOKS,
    Heartbeat,
    Silence,
    can_move,
)

if TYPE_CHECKING:
    from experiments.launching import Launcher, Launchers


class LiveProgress(ABC):
    """Shows how far something is while its ``with`` statement runs.

    Args:
        console: where to.
    """

    def __init__(self, console: Console) -> None:
        self.console = console
        self.started = time.monotonic()
        self.silence = Silence(SECONDS_BETWEEN_LINES)
        self.live = Live(console=console, auto_refresh=False) if can_move(console) else None
        self.heart = Heartbeat(self.look, SECONDS_BETWEEN_LOOKS)
        self._launcher: Launcher | None = None

    def watching(self, launchers: Launchers) -> Launchers:
        """The same launchers, of which is shown what there is to say while one is open."""

        @contextlib.contextmanager
        def watched() -> Iterator[Launcher]:
            with launchers() as self._launcher:
                yield self._launcher
            self._launcher = None

        return watched

    @property
    def place_words(self) -> str:
        """What there is to say of where runs are done, to go on a line with it; mostly nothing."""
        words = self._launcher.words if self._launcher is not None else ""
        return f", {words}" if words else ""

    @abstractmethod
    def figures(self) -> str:
        """How far it is, in a line."""

    def picture(self) -> RenderableType:
        """The same where it can move."""
        return Text(self.figures())

    @property
    def is_over(self) -> bool:
        """Whether there is nothing more to wait for."""
        return False

    def __enter__(self) -> Self:
        if self.live is not None:
            self.live.start()
            self.look()
        self.heart.start()
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        self.heart.stop()
        if self.live is not None:
            self.look()
            self.live.stop()
        if isinstance(error, KeyboardInterrupt):
            self.say(f"{self.figures()}; the same command continues")

    def look(self) -> None:
        """Show how far it is, also while nothing ends."""
        if self.live is not None:
            self.live.update(self.picture(), refresh=True)
        elif self.silence.is_too_long and not self.is_over:
            self.say(self.figures())

    def say(self, line: str) -> None:
        """Print a line that stays."""
        self.silence.end()
        self.console.print(line, highlight=False, soft_wrap=True)
