"""What the page says of itself: what it shows, and what it leaves out."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np

from pipeline.train_spec import TrainSpec

NO_WORDS = {"kind": "", "extent": "", "note": ""}


def page_words(spec: TrainSpec, data: Mapping[str, Any]) -> dict[str, str]:
    """The words that depend on what is shown, by the names that the template has for them."""
    return _words_of_steps(spec, data) if data["kind"] == "steps" else _words_of_maps(data)


def _words_of_steps(spec: TrainSpec, data: Mapping[str, Any]) -> dict[str, str]:
    n_steps = len(data["steps"]["timesteps"])
    n_episodes = int(np.count_nonzero(data["moves"]["end"]))
    note = ""
    if data["is_cut"] and spec.watch_episodes:
        asked = _count(spec.watch_episodes, "episode")
        note = f"a page has room for {n_steps:,} steps, and ends before the first {asked} do"
    elif data["begin"]:
        first = int(data["steps"]["timesteps"][0])
        note = f"from step {first:,} on, as the return of the greedy policy rises"
    elif data["is_longer"] and not spec.watch_episodes:
        note = "the beginning of a longer training"
    return {
        "kind": "step by step",
        "extent": f"{_count(n_steps, 'step')}, {_count(n_episodes, 'whole episode')}",
        "note": note,
    }


def _words_of_maps(data: Mapping[str, Any]) -> dict[str, str]:
    unit, stride, n_units = data["unit"], data["stride"], data["n_units"]
    extent = _count(n_units, unit)
    if stride > 1:
        extent += f", one in {stride:,} of which is shown"
    note = ""
    if unit == "update":
        note = "an update: all that is learnt from one rollout, at the end of it"
    return {"kind": f"from {unit} to {unit}", "extent": extent, "note": note}


def _count(number: int, word: str) -> str:
    return f"{number:,} {word}" if number == 1 else f"{number:,} {word}s"
