"""Pages of learning in the folder of a study, each with a note of what it was made from."""

from __future__ import annotations

import json
from hashlib import sha256
from pathlib import Path, PurePosixPath

from experiments.plan import PlannedRun
from pipeline.files import write_json
from report.learning_page.learning_assembly import MOST_BYTES, page_version
from report.page.sections import LearningPage
from safe_files.files import NO_LIMIT, UnsafeFileError, read_file

FOLDER = "learning"
LONGEST_WORDS = 300
_MOST_NOTED = 10_000  # bytes


def page_path(root: Path, run: PlannedRun) -> Path:
    """Where the page of a run is written."""
    return root / _place(run)


def without_page(run: PlannedRun, reason: str) -> LearningPage:
    """A run that cannot be shown."""
    return LearningPage(run.agent, run.environment, run.seed, "", reason[:LONGEST_WORDS])


def note_page(root: Path, run: PlannedRun, words: str) -> LearningPage:
    """Note what the page that has just been written was made from."""
    content = read_file(page_path(root, run), NO_LIMIT)
    write_json(_note_path(root, run), {"words": words, **_made_from(run, content)})
    return _page(run, words, content)


def kept_page(root: Path, run: PlannedRun) -> LearningPage | None:
    """The page of a run that an earlier command has left; None if it is none of this very run."""
    try:
        content = read_file(page_path(root, run), 2 * MOST_BYTES)
        note = json.loads(read_file(_note_path(root, run), _MOST_NOTED))
    except (OSError, ValueError, RecursionError, UnsafeFileError):
        return None
    words = note.pop("words", None) if isinstance(note, dict) else None
    if not isinstance(words, str) or len(words) > LONGEST_WORDS:
        return None
    made_from = _made_from(run, content)
    return _page(run, words, content) if made_from["agent"] and note == made_from else None


def _made_from(run: PlannedRun, content: bytes) -> dict[str, str]:
    """What decides what a page shows; the agent is empty where its run recorded no digests."""
    digests = run.run.files.digests or {}
    return {
        "agent": digests.get(run.run.model_path.name, ""),
        "page": sha256(content).hexdigest(),
        "version": page_version(),
    }


def _page(run: PlannedRun, words: str, content: bytes) -> LearningPage:
    place = _place(run).as_posix()
    return LearningPage(run.agent, run.environment, run.seed, place, words, len(content))


def _place(run: PlannedRun) -> PurePosixPath:
    return PurePosixPath(FOLDER, run.path.parent.name, f"{run.path.name}.html")


def _note_path(root: Path, run: PlannedRun) -> Path:
    return page_path(root, run).with_suffix(".json")
