"""What runs have to say, read while others are still under way."""

from __future__ import annotations

import contextlib
from collections.abc import Callable
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING

from experiments.planned_runs import PlannedRun
from experiments.study_spec import StudySpec
from pipeline.digests import DamagedFileError
from pipeline.library_loading import loading_libraries

if TYPE_CHECKING:
    from experiments.study_results import RunResults


class EarlyResults:
    """What each run has to say, read when it has ended.

    Args:
        study: whose runs they are.
    """

    def __init__(self, study: StudySpec) -> None:
        self.study = study
        self._found: dict[Path, RunResults] = {}

    @cached_property
    def _read_run(self) -> Callable[[StudySpec, PlannedRun], RunResults | None]:
        with loading_libraries():
            from experiments.study_results import read_run
        return read_run

    def get_ready(self) -> None:
        """Load what reading takes, which is long: best while the first runs are under way."""
        self._read_run  # noqa: B018

    def read(self, planned: PlannedRun) -> None:
        """Read a run that has just ended; one that is damaged is found to be so at the end."""
        with contextlib.suppress(DamagedFileError):
            found = self._read_run(self.study, planned)
            if found is not None:
                self._found[planned.path] = found

    def of(self, planned: PlannedRun) -> RunResults | None:
        """As `read_run`, where that was not done before."""
        return self._found.get(planned.path) or self._read_run(self.study, planned)
