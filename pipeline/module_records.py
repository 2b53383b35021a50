"""What a run remembers of the user's modules, and how it asks for them: by saying what to type."""

from __future__ import annotations

import os
import shlex
import sys
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any

from pipeline.errors import UserError, shown
from pipeline.files import replacing
from pipeline.user_modules import UserModule
from safe_files.regular_files import NO_LIMIT, read_file

# The folder of a run that keeps copies of single files.
COPIES = "modules"
MAX_COPY_BYTES = 1_000_000


def as_flag(modules: Iterable[UserModule], env_id: str = "") -> str:
    """The flag that imports the modules again, to be typed; empty where none is needed.

    Args:
        modules: as `import_typed` returned them.
        env_id: typed beside it; the module before its colon needs no flag.
    """
    words = [m.typed for m in modules if m.typed != env_id.rpartition(":")[0]]
    return f" --gym-packages {shlex.join(words)}" if words else ""


def keep_copies(modules: Iterable[UserModule], folder: Path) -> None:
    """Put copies of the modules that are single small files into a run folder."""
    for module in modules:
        path = Path(module.path or "")
        if "." in module.name or not path.is_file() or path.stat().st_size > MAX_COPY_BYTES:
            continue
        (folder / COPIES).mkdir(exist_ok=True)
        with replacing(folder / COPIES / path.name) as file:
            file.write(path.read_bytes())


def changed_since(modules: Iterable[UserModule], folder: Path) -> list[Path]:
    """The files of modules that are no more what a run folder has copies of."""
    files = [Path(module.path) for module in modules if module.path is not None]
    copies = {path: folder / COPIES / path.name for path in files}
    return [
        path
        for path, copy in copies.items()
        if path.is_file() and copy.is_file() and path.read_bytes() != read_file(copy, NO_LIMIT)
    ]


def check_recorded(recorded: Mapping[str, Any], folder: Path) -> None:
    """Make sure that the modules that a run was trained with have been imported.

    Args:
        recorded: what the run folder says was asked for.
        folder: the run folder.

    Raises:
        UserError: if one has not; it says what to type.
    """
    names = [name for name in recorded.get("gym_packages") or () if isinstance(name, str)]
    missing = [name for name in names if name not in sys.modules]
    if not missing:
        return
    known = [m for m in recorded.get("user_modules") or () if isinstance(m, dict)]
    words = [_to_type(name, known, folder) for name in missing]
    raise UserError(
        f"{folder} was made with modules of yours ({', '.join(map(_printable, missing))}), and no "
        f"module is imported because a file asks: add --gym-packages {' '.join(words)}"
    )


def _to_type(name: str, known: Sequence[Mapping[str, Any]], folder: Path) -> str:
    """What to type for a module that a run recorded: where it was, or else the run's copy."""
    path = next((m.get("path") for m in known if m.get("name") == name), None)
    copy = folder / COPIES / f"{name}.py"
    if isinstance(path, str) and Path(path).exists():
        near = Path(path)
        if near.is_relative_to(Path.cwd()):
            return _printable(f".{os.sep}{near.relative_to(Path.cwd())}")
        return _printable(path)
    return _printable(str(copy) if name.isidentifier() and copy.is_file() else name)


def _printable(word: str) -> str:
    return shlex.quote(word) if word.isprintable() else shown(word)
