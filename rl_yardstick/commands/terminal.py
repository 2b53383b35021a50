"""Output shared by the commands: the console, and evaluations in words."""

from __future__ import annotations

import math
import re
import textwrap
from collections.abc import Sequence
from shutil import get_terminal_size
from typing import TYPE_CHECKING, Any

from rich.console import Console
from rich.text import Text

from rl_yardstick.pipeline.errors import visible
from rl_yardstick.pipeline.evaluation.yardstick import ROUNDING, rounding

if TYPE_CHECKING:
    from rl_yardstick.pipeline.evaluation.yardstick import Evaluation, OtherReturns, Yardstick

APART = "   "  # between the figures of a result
LINE = 100  # columns of text in a file or a pipe
LONGEST_LABEL = 12  # columns of a first word, with the spaces behind it, that a line hangs from


class TextConsole(Console):
    """A console that shows control characters in a text instead of obeying them.

    Labels, titles and names come from files, so Rich's markup in them is plain text, too.
    """

    def __init__(self, **options: Any) -> None:
        super().__init__(markup=False, emoji=False, highlight=False, **options)

    def print(self, *objects: Any, **options: Any) -> None:
        """Print as Rich does, but in a file or a pipe as `wrapped`."""
        if not self.is_terminal and all(isinstance(item, str) for item in objects):
            options["soft_wrap"] = True
            objects = tuple(map(wrapped, objects))
        super().print(*objects, **options)

    def on_broken_pipe(self) -> None:
        """Go on in silence: a training is worth more than its output."""
        self.quiet = True

    def render_str(self, text: str, **options: Any) -> Text:
        """As Rich does, with control characters made visible, so that the width is right."""
        return super().render_str(visible(text), **options)


def table_console() -> Console:
    """A console as wide as the terminal; in a file or a pipe, of `COLUMNS` or 80 columns."""
    console = TextConsole()
    return console if console.is_terminal else TextConsole(width=get_terminal_size().columns)


def wrapped(text: str, width: int = LINE) -> str:
    """A text with long lines broken between words, and hung behind a label; a path stays whole."""
    lines = text.split("\n")
    for place, line in enumerate(lines):
        if len(line) > width:
            label = re.match(r" *\S+ {2,}", line)
            hang = len(line) - len(line.lstrip()) + 2
            hang = label.end() if label and label.end() <= LONGEST_LABEL else hang
            whole: Any = {"break_long_words": False, "break_on_hyphens": False}
            lines[place] = textwrap.fill(line, width, subsequent_indent=" " * hang, **whole)
    return "\n".join(lines)


def say(console: Console, line: str, style: str | None = None) -> None:
    """Print a line, which a terminal may break anywhere: commands and paths are copied whole."""
    console.print(line, style=style, soft_wrap=True)


# --- evaluations in words -------------------------------------------------------------------------


def result_lines(evaluation: Evaluation, *more: str) -> list[str]:
    """Score, return and success in a line, with ``more`` behind them; then lines on the scale."""
    yardstick = evaluation.yardstick
    n_episodes = 0 if evaluation.is_exact else len(evaluation.returns)
    told = judged(evaluation.mean_return, yardstick, n_episodes)
    if evaluation.success_rate is not None:
        told.append(f"success {percent(evaluation.success_rate)}")
    return [APART.join([*told, *more]), *([] if yardstick is None else scale_lines(yardstick))]


def judged(value: float, yardstick: Yardstick | None, n_episodes: int = 0) -> list[str]:
    """The score of a return and the return; with 0 episodes it is exact."""
    count = f"{n_episodes:,} episode{'s' * (n_episodes > 1)}"
    notes = [f"sampled, {count}"] if n_episodes else []
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


def scale_lines(yardstick: Yardstick) -> list[str]:
    """What a score of 0 is; and the optimum, if it is bracketed or there are several."""
    hidden, most = yardstick.hidden, yardstick.optimum
    kind = ""
    if hidden is not None:
        kind = " with memory" if hidden.with_memory else " without memory"
    first, meaning = "score 0", "best random or constant policy"
    if not yardstick.has_scale:
        nearly = "nearly " * (most - yardstick.baseline > rounding(most))
        first, meaning = "no score", f"a random or constant policy is {nearly}optimal{kind}"
    lines = [f"{first}{APART}return {figures(yardstick.baseline)[0]}{APART}{meaning}"]
    if hidden is None and yardstick.at_least is None:
        return lines
    least = most if yardstick.at_least is None else yardstick.at_least
    optima = [_span(least, most)]
    optima[0] += kind if yardstick.is_proven else f" (the upper end is not proven){kind}"
    if hidden is not None:
        if not hidden.with_memory:
            optima.append(f"{_span(*hidden.memory_optimum)} with memory")
        optima.append(f"{figures(hidden.full_optimum)[0]} by the state")
    return [*lines, f"optimum{APART}{', '.join(optima)}"]


def _span(least: float, most: float) -> str:
    """Two ends, or one figure where they round to the same."""
    low, high = figures(least, most)
    return high if float(low) == float(high) else f"{low} to {high}"


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
