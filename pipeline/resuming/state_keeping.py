"""How often the state of a training is saved, and what becomes of it."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from pipeline.resuming.saved_states import SavedState


@dataclass(frozen=True)
class SaveInterval:
    """How often to save the state.

    Attributes:
        seconds: between two states; 0 for as often as takes `SHARE_OF_TIME`.
        steps: environment steps between them instead, counted over all environments; or 0.
        is_off: to save none.
    """

    seconds: float = 0.0
    steps: int = 0
    is_off: bool = False


@dataclass(frozen=True)
class StateKeeping:
    """What becomes of a training's state.

    Attributes:
        interval: how often it is saved.
        state: what the training goes on from; None where it begins.
        goes_on: whether the run folder is an earlier process's, also where that left no state.
        was_cut_off: whether another process began the run and did not finish it, so that states
            come sooner.
        stays: whether states are still there when the run is finished.
    """

    interval: SaveInterval = SaveInterval()
    state: SavedState | None = None
    goes_on: bool = False
    was_cut_off: bool = False
    stays: bool = False
