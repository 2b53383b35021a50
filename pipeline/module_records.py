"""What a run remembers of the user's modules, and how it asks for them: by saying what to type."""

from __future__ import annotations

import ast
import os
import re
import shlex
import sys
from collections.abc import Iterable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

from pipeline.errors import UserError, shown
from pipeline.files import files_below, replacing
from pipeline.user_modules import UserModule, found_beside
from safe_files.files import NO_LIMIT, read_file

# The folder of a run that keeps copies of the user's modules.
COPIES = "modules"
MAX_COPY_BYTES = 1_000_000  # of a module, with all that it imports from beside it
_FOLDERS_ABOVE = 3  # that a study's modules may lie from the pack of one of its runs


def as_flag(modules: Iterable[UserModule], env_id: str = "") -> str:
    """The flag that imports the modules again, to be typed; empty where none is needed.

    Args:
        modules: as `import_typed` returned them.
        env_id: typed beside it; the module before its colon needs no flag.
    """
    words = [m.typed for m in modules if m.typed != env_id.rpartition(":")[0]]
    return f" --gym-packages {shlex.join(words)}" if words else ""


def keep_copies(modules: Iterable[UserModule], folder: Path) -> None:
    """Put copies of the modules, and of what they import from beside them, into a run folder.

    Of a module that is too large with these, there is none.
    """
    for module in modules:
        sources = _sources(module)
        if sum(path.stat().st_size for path in sources.values()) > MAX_COPY_BYTES:
            continue
        for name, path in sources.items():
            copy = folder / COPIES / name
            copy.parent.mkdir(parents=True, exist_ok=True)
            with replacing(copy) as file:
                file.write(path.read_bytes())


def _sources(module: UserModule) -> dict[str, Path]:
    """The Python files of a module and of those that it imports from beside it, by their names."""
    if module.search_folder is None:
        return {}
    beside, files = Path(module.search_folder), {}
    to_do, seen = [module.name.partition(".")[0]], set[str]()
    while to_do:
        top = to_do.pop()
        place = found_beside(beside, top)
        if top in seen or place is None:
            continue
        seen.add(top)
        for path in sorted(files_below(place)) if place.is_dir() else [place]:
            if path.suffix == ".py":
                files[path.relative_to(beside).as_posix()] = path
                to_do += _named_in(path)
    return files


def _named_in(path: Path) -> Iterator[str]:
    """The modules that a file imports, or names in a text such as ``"module:Class"``."""
    try:
        tree = ast.parse(path.read_bytes())
    except (SyntaxError, ValueError, RecursionError):
        return
    for node in ast.walk(tree):
        if isinstance(node, ast.Import):
            yield from (alias.name.partition(".")[0] for alias in node.names)
        elif isinstance(node, ast.ImportFrom) and node.module and not node.level:
            yield node.module.partition(".")[0]
        elif isinstance(node, ast.Constant) and isinstance(node.value, str):
            found = re.match(r"(\w+)[.:]\w", node.value)
            if found is not None:
                yield found[1]


def changed_since(modules: Iterable[UserModule], folder: Path) -> list[Path]:
    """The files of modules that are no more what a run folder has copies of."""
    files = {name: path for module in modules for name, path in _sources(module).items()}
    return [
        path
        for name, path in files.items()
        if (copy := folder / COPIES / name).is_file()
        and path.read_bytes() != read_file(copy, NO_LIMIT)
    ]


def copy_among(names: Iterable[str], module: str) -> str | None:
    """What to type for the copy of a module among the files of a run or pack; None without one."""
    place = f"{COPIES}/{module.replace('.', '/')}"
    known = set(names)
    if f"{place}/__init__.py" in known:
        return place
    return f"{place}.py" if f"{place}.py" in known else None


def check_recorded(
    recorded: Mapping[str, Any], folder: Path, zipped_in: Path | None = None
) -> None:
    """Make sure that the modules that a run was trained with have been imported.

    Args:
        recorded: what the run folder says was asked for.
        folder: the run folder.
        zipped_in: the pack that it was unpacked from.

    Raises:
        UserError: if one has not; it says what to type.
    """
    names = [name for name in recorded.get("gym_packages") or () if isinstance(name, str)]
    missing = [name for name in names if name not in sys.modules]
    if not missing:
        return
    told = ", ".join(map(_printable, missing))
    if zipped_in is None:
        known = [m for m in recorded.get("user_modules") or () if isinstance(m, dict)]
        words = [_to_type(name, known, folder) for name in missing]
        whose, how = f"{folder} was made with modules of yours ({told})", "add"
    else:
        near = {name: copy for name in missing if (copy := _copy_near(zipped_in, name))}
        inside = {name: copy for name in missing if (copy := _copy_in(folder, name))}
        words = [{**inside, **near}.get(name, _printable(name)) for name in missing]
        whose = f"{zipped_in} was made with modules of its maker ({told})"
        how = "read them, and if you trust them add" if near else "add"
        if inside.keys() - near.keys():
            how = "unzip it, read them, and if you trust them add, there,"
    raise UserError(
        f"{whose}, and no module is imported because a file asks: {how} --gym-packages "
        f"{' '.join(words)}"
    )


def _copy_in(folder: Path, name: str) -> str | None:
    """What to type for the copy of a module in a folder, relative to it; None without one."""
    parts = name.split(".")
    if not all(part.isidentifier() for part in parts):
        return None
    names = (f"{COPIES}/{'/'.join(parts)}{end}" for end in (".py", "/__init__.py"))
    return copy_among((name for name in names if (folder / name).is_file()), name)


def _copy_near(pack: Path, name: str) -> str | None:
    """What to type for the copy of a module that lies beside a pack, or in a folder above it."""
    folders = list(pack.resolve().parents)[:_FOLDERS_ABOVE]
    return next((_near(f / copy) for f in folders if (copy := _copy_in(f, name))), None)


def _to_type(name: str, known: Sequence[Mapping[str, Any]], folder: Path) -> str:
    """What to type for a module that a run recorded: where it was, or else the run's copy."""
    path = next((m.get("path") for m in known if m.get("name") == name), None)
    if isinstance(path, str) and Path(path).exists():
        return _near(Path(path))
    copy = _copy_in(folder, name)
    return _printable(name if copy is None else str(folder / copy))


def _near(path: Path) -> str:
    """A path as short as it may be typed here, and never taken for the name of a module."""
    if path.is_relative_to(Path.cwd()):
        return _printable(f".{os.sep}{path.relative_to(Path.cwd())}")
    return _printable(str(path))


def _printable(word: str) -> str:
    return shlex.quote(word) if word.isprintable() else shown(word)
