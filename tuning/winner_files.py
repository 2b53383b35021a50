"""The settings that won, as a file that says where they come from."""

from __future__ import annotations

import math
import textwrap
import time
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from pipeline.files import write_text
from tuning.entry_files import entry_text
from tuning.retesting import Outcome, Retested, interval_of
from tuning.tuning_spec import TuningSpec

FILE = "winner.yml"
LONGEST_LINE = 100
LIBRARY_LOOP = "Stable-Baselines3's own loop, in which the agent trains unless told otherwise"


def write_winner(
    tuning: TuningSpec, root: Path, outcome: Outcome, entry: Mapping[str, Any], n_trials: int
) -> Path:
    """Write the winner's entry, as `hyperparams/` and ``--conf-file`` take it; the file."""
    path = root / FILE
    write_text(path, entry_text(tuning, entry, provenance(tuning, outcome, entry, n_trials)))
    return path


def remove_winner(root: Path) -> None:
    """Remove the winner of a search that has gone on since and has none now."""
    (root / FILE).unlink(missing_ok=True)


def provenance(
    tuning: TuningSpec, outcome: Outcome, entry: Mapping[str, Any], n_trials: int
) -> list[str]:
    """Where the winner's settings come from, in lines."""
    winner, shipped = outcome.winner, outcome.retested[0]
    assert winner is not None
    seeds, held_out = tuning.study.seeds, tuning.held_out
    others = len(outcome.retested) - 1
    chosen = f", the best of {others} that were run again" if others > 1 else ""
    text = (
        f"Tuned by tune.py on {time.strftime('%Y-%m-%d')}: trial {winner.number} of {n_trials} "
        f"({tuning.sampler}), {_words(tuning)} over the seeds {seeds.start} to {seeds.stop - 1}: "
        f"{_figure(winner.in_search)}. On the seeds {held_out.start} to {held_out.stop - 1}, which "
        f"the search has not seen{chosen}: {_held_out(tuning, winner)}; the settings before, "
        f"there: {_held_out(tuning, shipped)}. Verdict: {winner.verdict}.{_engines(tuning, entry)}"
    )
    return textwrap.wrap(text, LONGEST_LINE - len("# "))


def _engines(tuning: TuningSpec, entry: Mapping[str, Any]) -> str:
    """On which engines, where search and re-test had different ones."""
    if tuning.searched(entry) == dict(entry):
        return ""
    return f" The search ran with engine: auto, the re-test in {LIBRARY_LOOP}."


def _words(tuning: TuningSpec) -> str:
    lower = "upper quartile" if tuning.is_cost else "lower quartile"
    names = {"mean": "mean", "iqm": "interquartile mean", "lower": lower}
    return f"{names[tuning.objective]} of {tuning.figure}"


def _figure(value: float | None) -> str:
    return "nothing" if value is None else f"{value:.4g}"


def _held_out(tuning: TuningSpec, each: Retested) -> str:
    """The figure, and an interval."""
    found, text = each.interval, _figure(each.held_out)
    if math.isnan(found.low):
        return text
    of_what = interval_of(tuning)
    ends = f"{found.low:.4g} to {found.high:.4g}"
    failed = f", {each.n_failed} of them failed" if each.n_failed else ""
    return f"{text} (95 % interval of the {of_what}: {ends}, {each.n_runs} runs{failed})"
