"""Output shared by the commands: consoles, progress, evaluations and engines in words."""

from __future__ import annotations

import contextlib
import math
import time
from abc import ABC, abstractmethod
from collections.abc import Iterable, Iterator, Sequence
from io import StringIO
from shutil import get_terminal_size
from types import TracebackType
from typing import TYPE_CHECKING, Any, Self

from rich.console import Console, ConsoleOptions, RenderableType
from rich.segment import Segment
from rich.text import Text

from rl_yardstick.pipeline.errors import visible
from rl_yardstick.pipeline.evaluation.yardstick import ROUNDING, rounding
from rl_yardstick.pipeline.signs_of_life import (
    SECONDS_BETWEEN_LINES,
    SECONDS_BETWEEN_LOOKS,
    Heartbeat,
    Silence,
    can_move,
)

if TYPE_CHECKING:
    from rich.table import Table
    from stable_baselines3.common.base_class import BaseAlgorithm
    from stable_baselines3.common.callbacks import BaseCallback

    from rl_yardstick.agents.networks.engine_setting import EnginePlan
    from rl_yardstick.experiments.launching import Launcher, Launchers
    from rl_yardstick.pipeline.evaluation.sampled import Evaluation, OtherReturns
    from rl_yardstick.pipeline.evaluation.yardstick import Yardstick
    from rl_yardstick.pipeline.preparation import EngineOutlook

UNBOUNDED = 10_000  # columns
APART = "   "  # between the figures of a result


class TextConsole(Console):
    """A console that shows control characters in a text instead of obeying them.

    Labels, titles and names come from files, so Rich's markup in them is plain text, too: it could
    crash, or make links. Cursor movements and colours come only from Rich itself: see ``style``.
    """

    def __init__(self, **options: Any) -> None:
        super().__init__(markup=False, emoji=False, **options)

    def print(self, *objects: Any, **options: Any) -> None:
        """Print as Rich does, but break no line in a file or a pipe, so that `grep` finds it."""
        if not self.is_terminal and all(isinstance(item, str) for item in objects):
            options.setdefault("soft_wrap", True)
        super().print(*objects, **options)

    def on_broken_pipe(self) -> None:
        """Leave a closed pipe to `commands.cli.Output`; Rich would be silent from then on.

        If the thread that prints progress found the closed pipe, the main thread would not know.
        """
        raise BrokenPipeError

    def render_str(self, text: str, **options: Any) -> Text:
        """As Rich does, with control characters made visible, so that the width is right."""
        return super().render_str(visible(text), **options)

    def render(
        self, renderable: RenderableType, options: ConsoleOptions | None = None
    ) -> Iterable[Segment]:
        """As Rich does, with control characters made visible in every segment."""
        for segment in super().render(renderable, options):
            text, style, control = segment
            yield segment if control else Segment(visible(text), style)


def table_console(*, highlight: bool = True) -> Console:
    """A console as wide as the terminal; in a file or a pipe, of `COLUMNS` or 80 columns."""
    console = TextConsole(highlight=highlight)
    if console.is_terminal:
        return console
    return TextConsole(highlight=highlight, width=get_terminal_size().columns)


def print_rows(console: Console, table: Table) -> None:
    """Print a table without borders; in a file or a pipe each row is one line, however long."""
    if console.is_terminal:
        console.print(table, highlight=False)
        return
    wide = TextConsole(file=StringIO(), width=UNBOUNDED)
    wide.print(table, highlight=False)
    for line in wide.file.getvalue().splitlines():  # type: ignore[attr-defined]  # it is ours
        console.print(line.rstrip(), highlight=False, soft_wrap=True)


def say(console: Console, line: str, style: str | None = None) -> None:
    """Print a line without breaking it, however long."""
    console.print(line, style=style, highlight=False, soft_wrap=True)


def print_refusal(console: Console, refusal: str | None) -> None:
    """Say why the environment's own model is refused, if it is."""
    if refusal is not None:
        say(console, f"{refusal}; figures are sampled")


class LiveProgress(ABC):
    """Shows progress while its ``with`` statement runs."""

    def __init__(self, console: Console) -> None:
        from rich.live import Live

        self.console = console
        self.started = time.monotonic()
        self.silence = Silence(SECONDS_BETWEEN_LINES)
        self.live = Live(console=console, auto_refresh=False) if can_move(console) else None
        self.heart = Heartbeat(self.look, SECONDS_BETWEEN_LOOKS)
        self._launcher: Launcher | None = None

    def watching(self, launchers: Launchers) -> Launchers:
        """The same launchers, with the words of the open one shown in the progress."""

        @contextlib.contextmanager
        def watched() -> Iterator[Launcher]:
            with launchers() as self._launcher:
                yield self._launcher
            self._launcher = None

        return watched

    @property
    def place_words(self) -> str:
        """The launcher's words, to append to a line; mostly empty."""
        words = self._launcher.words if self._launcher is not None else ""
        return f", {words}" if words else ""

    @abstractmethod
    def figures(self) -> str:
        """The progress in a line."""

    def picture(self) -> RenderableType:
        """The progress for a live display."""
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
        """Show the progress; called at intervals, too."""
        if self.live is not None:
            self.live.update(self.picture(), refresh=True)
        elif self.silence.is_too_long and not self.is_over:
            self.say(self.figures())

    def say(self, line: str) -> None:
        """Print a line that stays."""
        self.silence.end()
        say(self.console, line)


# --- evaluations in words -------------------------------------------------------------------------


def result_lines(evaluation: Evaluation, *more: str) -> list[str]:
    """Score, return and success in a line, with ``more`` behind them; then lines on the scale."""
    yardstick = evaluation.yardstick
    n_episodes = 0 if evaluation.is_exact else len(evaluation.returns)
    told = judged(evaluation.mean_return, yardstick, n_episodes)
    if evaluation.success_rate is not None:
        told.append(f"success {percent(evaluation.success_rate)}")
    lines = [APART.join([*told, *more]), *([] if yardstick is None else _scale_lines(yardstick))]
    if evaluation.beats_optimum:
        why = "the bracket belongs to another environment, or is wrong"
        lines.append(f"THIS IS MORE THAN ANY POLICY CAN REACH: {why}")
    return lines


def judged(value: float, yardstick: Yardstick | None, n_episodes: int = 0) -> list[str]:
    """The score of a return and the return; with 0 episodes it is exact."""
    notes = [f"sampled, {episodes(n_episodes)}"] if n_episodes else []
    if yardstick is None:
        return [_returned(value, None, notes)]
    if not yardstick.is_proven:
        notes = ["not proven", *notes]
    is_bracket = yardstick.at_least is not None
    returned = _returned(value, yardstick.optimum, notes, is_bracket=is_bracket)
    scores = {_score(yardstick, value), _score(yardstick.lower_end, value)}
    told = [f"score {' to '.join(sorted(scores, key=float))}"] if yardstick.has_scale else []
    return [*told, returned]


def describe_others(others: OtherReturns) -> list[str]:
    """The exact returns beside that of the greedy policy, a line for each."""
    told = []
    if others.stochastic_return is not None and others.acts_by != "the same policy":
        returned = _returned(others.stochastic_return, None)
        told.append(f"{returned} with {others.acts_by}, as in training")
    if others.discounted_return is not None and others.discount != 1:
        returned = _returned(others.discounted_return, others.discounted_optimum)
        told.append(f"{returned}, discounted by {others.discount:g}")
    return told


def _returned(
    value: float, optimum: float | None, notes: Sequence[str] = (), *, is_bracket: bool = False
) -> str:
    """A return, beside the optimum with the gap between them, or beside its upper bound."""
    mine, *best = figures(value, *([] if optimum is None else [optimum]))
    if optimum is not None and not is_bracket and optimum - value > rounding(optimum):
        decimals = max(len(text.partition(".")[2]) for text in (mine, *best))
        gap = f"{optimum - value:.{decimals}f}"
        notes = [f"gap {gap if float(gap) else f'{optimum - value:.2g}'}", *notes]
    beside = " of ".join([mine, *best]) + " at most" * is_bracket
    return f"return {beside}" + (f" ({'; '.join(notes)})" if notes else "")


def _scale_lines(yardstick: Yardstick) -> list[str]:
    """What a score of 0 is; and the optimum, if it is bracketed or there are several."""
    baseline = f"return {figures(yardstick.baseline)[0]}{APART}best random or constant policy"
    lines = [f"{'score 0' if yardstick.has_scale else 'no score'}{APART}{baseline}"]
    hidden, most = yardstick.hidden, yardstick.optimum
    if hidden is None and yardstick.at_least is None:
        return lines
    optima = [_between(most if yardstick.at_least is None else yardstick.at_least, most)]
    optima[0] += "" if yardstick.is_proven else " (the upper end is not proven)"
    if hidden is not None:
        optima[0] += " with memory" if hidden.with_memory else " without memory"
        memory = [] if hidden.with_memory else [f"{_between(*hidden.memory_optimum)} with memory"]
        optima += [*memory, f"{figures(hidden.full_optimum)[0]} by the state"]
    return [*lines, f"optimum{APART}{', '.join(optima)}"]


def _between(lower: float, upper: float) -> str:
    return " to ".join(dict.fromkeys(figures(lower, upper)))


def _score(yardstick: Yardstick, value: float) -> str:
    """The score, rounded down: only the optimum is 1."""
    hundredths = math.floor(100 * yardstick.score(value) + 1e-6)
    if yardstick.gap(value) > rounding(yardstick.optimum):
        hundredths = min(hundredths, 99)
    return "1" if hundredths == 100 else f"{hundredths / 100:.2f}"


def figures(*values: float) -> list[str]:
    """Whole numbers without decimals; of the others, the smallest has four digits or decimals."""
    whole = [math.isclose(value, round(value), rel_tol=1e-9, abs_tol=1e-9) for value in values]
    broken = [abs(value) for value, is_whole in zip(values, whole, strict=True) if not is_whole]
    smallest = min(broken, default=0.0)
    decimals = 4 if smallest < 1 else max(4 - len(str(int(smallest))), 0)
    places = [0 if is_whole else decimals for is_whole in whole]
    return [f"{value:z.{n}f}" for value, n in zip(values, places, strict=True)]


def percent(share: float) -> str:
    """A share in percent, of which only all is 100 %."""
    most = 100.0 if share > 1 - ROUNDING else 99.9
    return f"{min(round(100 * share, 1), most):g} %"


def episodes(n: int) -> str:
    """A number of episodes in words."""
    return f"{n:,} episode{'s' if n != 1 else ''}"


# --- engines in words -----------------------------------------------------------------------------


LIBRARY = "library (Stable-Baselines3's own loop)"

HOW_NOT_TO_BE_ASKED = (
    "made a BlockCallback, it would be asked only when it acts (docs/training.md#from-python)"
)


def about(seconds: float) -> str:
    """A time that is known up to a factor of two."""
    if seconds < 1:
        return "less than 1 s"
    if seconds < 120:
        return f"about {seconds:.0f} s"
    if seconds < 7200:
        return f"about {seconds / 60:.0f} min"
    return f"about {seconds / 3600:.0f} h"


def training_line(
    outlook: EngineOutlook | None, model: BaseAlgorithm, callback: BaseCallback
) -> str:
    """The line on the engine of one training; empty if there is nothing to say."""
    from stable_baselines3.common.callbacks import CallbackList

    from rl_yardstick.agents.common.callbacks import members, unknown_callbacks
    from rl_yardstick.agents.networks.engine_setting import machine_pace

    # The user's own callbacks that must be called after each step.
    told = [each for each in members(callback) if not isinstance(each, CallbackList)]
    theirs = [each for each in told if not type(each).__module__.startswith("pipeline.")]
    asked = [name for each in theirs for name in unknown_callbacks(each)]
    if outlook is None:
        if not asked or getattr(model, "engine", "compiled") != "auto":
            return ""
        return (
            f"interpreted, about a hundred times slower or more: {', '.join(asked)} must be asked "
            f"after each step; {HOW_NOT_TO_BE_ASKED}"
        )
    pace = machine_pace()
    advice = ""
    if asked and outlook.auto.is_compiled:
        advice = f"; {HOW_NOT_TO_BE_ASKED}"
        if outlook.work is not None:
            advice += f", and training take {about(outlook.work.compiled_seconds * pace)}"
    line = _words(outlook.plan, outlook, pace, "of processor time")
    if outlook.plan.is_compiled:
        if outlook.work is not None:
            taken = about(outlook.work.library_seconds * pace)
            line += f" (Stable-Baselines3's own loop: {taken})"
    elif outlook.auto.is_compiled:
        why = f" but for the environment ({outlook.auto.in_python})" * bool(outlook.auto.in_python)
        taken = _takes(outlook.auto, outlook, pace, "")
        line += f"; --engine auto: the same networks and updates compiled{why}{taken}"
    return f"{line}{advice}"


def _words(plan: EnginePlan, outlook: EngineOutlook, pace: float, unit: str) -> str:
    """An engine, its expected time, and the reason why it is not another."""
    name = str(plan).partition(":")[0] if plan.is_compiled else LIBRARY
    reason = plan.in_python or plan.reason
    return f"{name}{_takes(plan, outlook, pace, unit)}{': ' if reason else ''}{reason}"


def _takes(plan: EnginePlan, outlook: EngineOutlook, pace: float, unit: str) -> str:
    work = outlook.work
    if work is None:
        return ""
    from rl_yardstick.agents.networks.engine_setting import compiling_seconds

    text = f", {about(seconds_of(plan, outlook) * pace)} {unit}".rstrip()
    compiling = compiling_seconds(work) * pace if plan.is_compiled else 0.0
    return f"{text} and once {about(compiling)} of compiling" if compiling else text


def seconds_of(plan: EnginePlan, outlook: EngineOutlook) -> float:
    """Seconds of a training on the machine of the measured constants; 0 if unknown."""
    if outlook.work is None:
        return 0.0
    if not plan.is_compiled:
        return outlook.work.library_seconds
    return outlook.work.bridged_seconds if plan.in_python else outlook.work.compiled_seconds


def study_line(planned: Sequence[tuple[str, EngineOutlook, int]]) -> str:
    """The line on the engines of many trainings; empty if none has networks.

    ``planned`` has labels of agents, the outlooks of their runs, and the numbers of their runs.
    """
    from rl_yardstick.agents.networks.engine_setting import machine_pace

    pace, parts = machine_pace() if planned else 1.0, []
    for is_compiled in (False, True):
        group = [each for each in planned if each[1].plan.is_compiled is is_compiled]
        if not group:
            continue
        names = ", ".join(dict.fromkeys(label for label, _, _ in group))
        n_runs = sum(count for _, _, count in group)
        runs = "1 run" if n_runs == 1 else f"{n_runs} runs"
        taken = _together([(outlook, outlook.plan, n) for _, outlook, n in group], pace)
        parts.append(
            f"{names}: {'compiled' if is_compiled else LIBRARY}{taken}"
            f"{' of processor time' if taken else ''} in {runs}"
        )
        if not is_compiled and any(outlook.auto.is_compiled for _, outlook, _ in group):
            taken = _together([(outlook, outlook.auto, n) for _, outlook, n in group], pace)
            parts.append(f"with --engine auto compiled{taken}")
    return "; ".join(parts)


def _together(trainings: Sequence[tuple[EngineOutlook, EnginePlan, int]], pace: float) -> str:
    """The expected time of all trainings together; empty if that of one is unknown."""
    if any(outlook.work is None for outlook, _, _ in trainings):
        return ""
    seconds = sum(seconds_of(plan, outlook) * n for outlook, plan, n in trainings)
    return f", {about(seconds * pace)}"


def search_line(algo: str, search: EngineOutlook | None, retest: EngineOutlook | None) -> str:
    """The line on the engines of a search and its re-test, for one run; empty without outlooks."""
    if search is None or retest is None:
        return ""
    from rl_yardstick.agents.networks.engine_setting import machine_pace

    pace = machine_pace()
    searched = _words(search.plan, search, pace, "of processor time a run")
    if search.plan.is_compiled == retest.plan.is_compiled:
        return f"search and re-test: {searched}"
    again = _words(retest.plan, retest, pace, "a run")
    return (
        f"search: {searched}; re-test: {again}, in which train runs {algo}; "
        "--engine auto re-tests compiled, if you train with it"
    )
