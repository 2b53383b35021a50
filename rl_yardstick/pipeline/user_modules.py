"""Imports the user's modules: environments and agents outside this project.

A module is imported only if the user typed its name. A file may name modules that it needs; then
the user is told what to type. Files beside a user's module are visible only to its own code, and
are searched last, so that a user's ``agents.py`` never hides this project's. Two modules of the
same name are refused.
"""

from __future__ import annotations

import ast
import importlib
import importlib.util
import os
import re
import shlex
import sys
import threading
import traceback
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from importlib.abc import MetaPathFinder
from importlib.machinery import ModuleSpec, PathFinder
from pathlib import Path
from types import ModuleType
from typing import Any

from rl_yardstick.pipeline.errors import UserError, one_line, shown
from rl_yardstick.pipeline.files import files_below, replacing
from rl_yardstick.safe_files.files import NO_LIMIT, read_file


@dataclass(frozen=True)
class UserModule:
    """A module that the user typed."""

    typed: str  # as on the command line
    name: str  # its import name
    path: str | None = None  # absolute path of its file or package folder; None if installed

    @property
    def search_folder(self) -> str | None:
        """The folder to search for it; None if Python searches the folder anyway."""
        return None if self.path is None else str(Path(self.path).parents[self.name.count(".")])


class _TypedFolder(MetaPathFinder):
    """Finds typed modules and modules that their code names; `sys.path` would affect libraries.

    With ``is_first``, it finds only the given names, also if Python would find others elsewhere.
    """

    def __init__(self, folder: str, names: Iterable[str], is_first: bool = False) -> None:
        self.folder = folder
        self.names = set(names)
        self.is_first = is_first

    def find_spec(
        self, fullname: str, path: Sequence[str] | None, target: ModuleType | None = None
    ) -> ModuleSpec | None:
        spec = PathFinder.find_spec(fullname, [self.folder]) if path is None else None
        is_known = fullname in self.names or (not self.is_first and self._is_named(fullname))
        if spec is None or not is_known:
            return None
        self.names.add(fullname)
        return spec

    def _is_named(self, name: str) -> bool:
        """Whether the code of a module from this folder contains the name."""
        found = [m for n, m in list(sys.modules.items()) if n.partition(".")[0] in self.names]
        files = [Path(file) for module in found if (file := getattr(module, "__file__", None))]
        texts = (f.read_text(encoding="utf-8", errors="replace") for f in files if f.is_file())
        return any(re.search(rf"\b{name}\b", text) for text in texts)


def _search(folder: str, typed: str) -> None:
    """Search a folder for a typed top-level module, and for modules that its code names."""
    for finder in sys.meta_path:
        ours = finder if isinstance(finder, _TypedFolder) else None
        if ours and ours.folder == folder and not ours.is_first:
            ours.names.add(typed)
            return
    sys.meta_path.append(_TypedFolder(folder, [typed]))


def import_typed(words: Iterable[str], env_ids: Iterable[str] = ()) -> tuple[UserModule, ...]:
    """Import the modules after ``--gym-packages`` and before colons; returns the user's own."""
    prefixes = [env_id.rpartition(":")[0] for env_id in env_ids]
    modules = []
    for typed in dict.fromkeys([*words, *filter(None, prefixes)]):
        module = _at_path(typed) if _is_path(typed) else _by_name(typed)
        _import(module)
        if not is_ours(module.name):
            modules.append(module)
    return tuple(modules)


def import_checked(modules: Iterable[UserModule]) -> None:
    """Import modules with verified files, even if Python would find others of the same names."""
    for module in modules:
        folder = module.search_folder
        if folder is not None and module.name not in sys.modules:
            names = {module.name.partition(".")[0]}
            if Path(folder).parent.name == SENT:
                names |= {path.stem for path in Path(folder).iterdir()}
            sys.meta_path.insert(0, _TypedFolder(folder, names, is_first=True))
    import_again(modules)


def import_again(modules: Iterable[UserModule]) -> None:
    """Import the modules of `import_typed` in another process, from any folder."""
    for module in modules:
        if module.name not in sys.modules:
            _import(module)


def _is_path(typed: str) -> bool:
    return os.sep in typed or typed.startswith((".", "~")) or typed.endswith(".py")


def _at_path(typed: str) -> UserModule:
    """The module in a file or folder; inside a package, with its full name."""
    try:
        path = Path(typed).expanduser()
    except RuntimeError as error:  # unknown user after ~
        raise _refused(typed, one_line(error)) from error
    path = path.resolve() if path.is_dir() else path.parent.resolve() / path.name
    path = path.parent if path.name == "__init__.py" else path
    if not path.exists():
        raise _refused(typed, "there is no such file or folder")
    if path.is_dir() and not (path / "__init__.py").is_file():
        raise _refused(typed, "the folder is no package: it holds no __init__.py")
    if path.is_file() and path.suffix != ".py":
        raise _refused(typed, "it is no Python file")
    parts, folder = [path.stem if path.is_file() else path.name], path.parent
    while (folder / "__init__.py").is_file():
        parts, folder = [folder.name, *parts], folder.parent
    for part in parts:
        if not part.isidentifier():
            raise _refused(typed, f"{shown(part)} is no name of a module: rename it")
    return UserModule(typed, ".".join(parts), str(path))


def _by_name(typed: str) -> UserModule:
    """The module of that name in the current folder, or an installed one."""
    if typed.startswith("__") or not all(part.isidentifier() for part in typed.split(".")):
        raise _refused(typed, "it is neither the name of a module nor the path of one")
    here = Path.cwd()
    found = _source(here, typed)
    if found is None and _source(here, typed.partition(".")[0]) is None:
        return UserModule(typed, typed)
    return UserModule(typed, typed, str(found or here.joinpath(*typed.split("."))))


def _source(folder: Path, name: str) -> Path | None:
    """The file or the package of that dotted name in a folder, or None."""
    path = folder.joinpath(*name.split("."))
    if (path / "__init__.py").is_file() or (path.is_dir() and any(path.glob("*.py"))):
        return path
    file = path.with_suffix(".py")
    return file if file.is_file() else None


def found_beside(folder: Path, top: str) -> Path | None:
    """The file or package of that name in a folder, unless Python would find another one."""
    place = _source(folder, top)
    if place is None or top in sys.stdlib_module_names or is_ours(top):
        return None
    elsewhere = _places(top) - {place.resolve(), (place / "__init__.py").resolve()}
    return None if elsewhere else place


def _import(module: UserModule) -> ModuleType:
    """Import one module; its folder is searched last."""
    importlib.invalidate_caches()
    folder = module.search_folder
    if folder is not None:
        _search(folder, module.name.partition(".")[0])
        _check_name(module, Path(folder))
    try:
        return importlib.import_module(module.name)
    except (Exception, SystemExit) as error:  # an import may raise anything
        raise _refused(module.typed, _what_failed(error, module)) from error


def _check_name(module: UserModule, folder: Path) -> None:
    """Check that Python finds the user's module under its name, and no other."""
    top = module.name.partition(".")[0]
    wanted = _source(folder, top) or folder / top
    found = _places(top)
    if not found & {wanted.resolve(), (wanted / "__init__.py").resolve()}:
        if is_ours(top):
            whose = f"{top} is the name of one of Yardstick's own modules"
        elif not found or top in sys.stdlib_module_names:
            whose = f"{top} is the name of one of Python's own modules"
        else:
            whose = f"Python finds another {top} first, at {min(found)}"
        raise _refused(
            module.typed, f"{whose}: rename {wanted}, or put it into a package of another name"
        )


def _places(top: str) -> set[Path]:
    """The places where Python finds a top-level module of that name."""
    try:
        spec = importlib.util.find_spec(top)
    except ValueError:  # of `__main__`
        return set()
    places = [] if spec is None else [spec.origin, *(spec.submodule_search_locations or ())]
    return {Path(place).resolve() for place in places if place}


def is_ours(name: str) -> bool:
    """Whether a module of that name belongs to this project."""
    return name.partition(".")[0] == "rl_yardstick"


def _what_failed(error: BaseException, module: UserModule) -> str:
    """The error of an import, with file and line."""
    if isinstance(error, ModuleNotFoundError) and f"{module.name}.".startswith(f"{error.name}."):
        return f"cannot import {error.name}: it is neither in {Path.cwd()} nor installed"
    if isinstance(error, SyntaxError) and error.filename:
        return f"{error.filename}:{error.lineno}: {type(error).__name__}: {error.msg}"
    what = f"{type(error).__name__}: {one_line(error)}"
    frames = traceback.extract_tb(error.__traceback__)[1:]
    if module.search_folder is None:  # installed: any file outside Python may be its own
        pythons = ("<", str(Path(importlib.__file__).parent))
        own = [frame for frame in frames if not frame.filename.startswith(pythons)]
    else:
        own = [f for f in frames if Path(f.filename).is_relative_to(module.search_folder)]
    return f"{own[-1].filename}:{own[-1].lineno}: {what}" if own else what


def _refused(typed: str, reason: str) -> UserError:
    return UserError(f"--gym-packages {shlex.quote(typed)}: {reason}")


# --- copies of modules in run folders, and requests to type their names ---------------------------

COPIES = "modules"  # the folder in a run for copies of modules
SENT = "yardstick-modules"  # the folder on a worker for modules that a driver has sent
MAX_COPY_BYTES = 1_000_000  # of a module with its imports from the same folder
_parsing = threading.Lock()  # in several threads at once, Python 3.11 raises SystemError
_OF_LIBRARIES = ("site-packages", "dist-packages")  # folders of installed distributions
_FOLDERS_ABOVE = 3  # parent folders of a run's pack to search for a study's modules


def as_flag(modules: Iterable[UserModule], env_id: str = "") -> str:
    """The flag that imports the modules again; none for a module before an id's colon."""
    words = [m.typed for m in modules if m.typed != env_id.rpartition(":")[0]]
    return f" --gym-packages {shlex.join(words)}" if words else ""


def keep_copies(modules: Iterable[UserModule], folder: Path) -> None:
    """Copy the modules, and their imports from the same folder, into a run folder."""
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
    """The `files_of` a module that is not installed."""
    return {} if module.search_folder is None else files_of(module)


def files_of(module: UserModule) -> dict[str, Path]:
    """The Python files of a module and of its imports from the same folder, by name.

    Only its own files for an installed module, because its imports are other distributions.
    """
    beside, files = _folder_of(module), dict[str, Path]()
    to_do, seen = [module.name.partition(".")[0]], set[str]()
    while to_do and beside is not None:
        top = to_do.pop()
        place = found_beside(beside, top)
        if top in seen or place is None:
            continue
        seen.add(top)
        for path in sorted(files_below(place)) if place.is_dir() else [place]:
            if path.suffix == ".py":
                files[path.relative_to(beside).as_posix()] = path
                to_do += [] if beside.name in _OF_LIBRARIES else named_in(path)
    return files


def _folder_of(module: UserModule) -> Path | None:
    """The folder with a module's top-level file or package."""
    if module.search_folder is not None:
        return Path(module.search_folder)
    top = module.name.partition(".")[0]
    origin = next((p for p in _places(top) if p.name in ("__init__.py", f"{top}.py")), None)
    if origin is None:
        return None
    return origin.parent.parent if origin.name == "__init__.py" else origin.parent


def named_in(path: Path) -> Iterator[str]:
    """The modules that a file imports, or names in texts such as ``"module:Class"``."""
    try:
        with _parsing:
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
    """The files of modules that differ from their copies in a run folder."""
    files = {name: path for module in modules for name, path in _sources(module).items()}
    return [
        path
        for name, path in files.items()
        if (copy := folder / COPIES / name).is_file()
        and path.read_bytes() != read_file(copy, NO_LIMIT)
    ]


def copy_of(module: str, is_there: Callable[[str], bool]) -> str | None:
    """The path to type for a module's copy in a run or pack; None without a copy."""
    place = f"{COPIES}/{module.replace('.', '/')}"
    if is_there(f"{place}/__init__.py"):
        return place
    return f"{place}.py" if is_there(f"{place}.py") else None


def check_recorded(
    recorded: Mapping[str, Any], folder: Path, zipped_in: Path | None = None
) -> None:
    """Check that the modules of a run or pack are imported; else say what to type."""
    names = [name for name in recorded.get("gym_packages") or () if isinstance(name, str)]
    missing = [name for name in names if name not in sys.modules]
    if not missing:
        return
    told = ", ".join(map(_printable, missing))
    if zipped_in is None:
        known = [m for m in recorded.get("user_modules") or () if isinstance(m, dict)]
        words = []
        for name in missing:  # its original place, or else the run's copy
            path = next((m.get("path") for m in known if m.get("name") == name), None)
            if isinstance(path, str) and Path(path).exists():
                words.append(_near(Path(path)))
            else:
                copy = _copy_in(folder, name)
                words.append(_printable(name if copy is None else str(folder / copy)))
        whose, how = f"{folder} was made with modules of yours ({told})", "add"
    else:
        inside = {name: copy for name in missing if (copy := _copy_in(folder, name))}
        near = {}  # beside the pack, or in a parent folder
        for name in missing:
            above = list(zipped_in.resolve().parents)[:_FOLDERS_ABOVE]
            copies = (_near(f / copy) for f in above if (copy := _copy_in(f, name)))
            if copy := next(copies, None):
                near[name] = copy
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
    """The path to type for a module's copy, relative to its folder; None without a copy."""
    if not all(part.isidentifier() for part in name.split(".")):
        return None
    return copy_of(name, lambda path: (folder / path).is_file())


def _near(path: Path) -> str:
    """The shortest path to type here that cannot be mistaken for a module name."""
    if path.is_relative_to(Path.cwd()):
        return _printable(f".{os.sep}{path.relative_to(Path.cwd())}")
    return _printable(str(path))


def _printable(word: str) -> str:
    return shlex.quote(word) if word.isprintable() else shown(word)
