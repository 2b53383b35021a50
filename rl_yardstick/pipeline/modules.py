"""Modules of the user, with environments or agents: imported because their names were typed."""

from __future__ import annotations

import importlib
import importlib.util
import sys
import traceback
from collections.abc import Iterable
from pathlib import Path

from rl_yardstick.pipeline.errors import UserError, one_line


def import_modules(typed: Iterable[str]) -> None:
    """Import modules by name or by file; the current folder comes first, as with ``python -m``.

    Without any name the current folder is not searched: it may be a stranger's.

    Raises:
        UserError: if there is no such module, or importing it fails.
    """
    names = list(typed)
    if names and str(Path.cwd()) not in sys.path[:1]:
        sys.path.insert(0, str(Path.cwd()))
    for name in names:
        try:
            if name.endswith(".py") or "/" in name:
                _import_file(Path(name).expanduser())
            else:
                importlib.import_module(name)
        except ModuleNotFoundError as error:
            raise UserError(f"--gym-packages {name}: no module named {error.name}") from error
        except (Exception, SystemExit) as error:  # an import may raise anything
            last = traceback.extract_tb(error.__traceback__)[-1]
            place = f"{last.filename}:{last.lineno}"
            raise UserError(f"--gym-packages {name}: {place}: {one_line(error)}") from error


def module_name(typed: str) -> str:
    """The name under which `import_modules` has imported what was typed."""
    return Path(typed).stem if typed.endswith(".py") or "/" in typed else typed


def _import_file(path: Path) -> None:
    path = path / "__init__.py" if path.is_dir() else path
    if not path.is_file():
        raise UserError(f"--gym-packages {path}: no such file")
    package = path.parent if path.name == "__init__.py" else None
    name, folder = (package.name, package.parent) if package else (path.stem, path.parent)
    if (loaded := sys.modules.get(name)) is not None:
        if Path(getattr(loaded, "__file__", None) or "").resolve() != path.resolve():
            raise UserError(f"--gym-packages {path}: another module is named {name}; rename it")
        return
    sys.path.insert(0, str(folder.resolve()))  # what lies beside it can be imported too
    importlib.import_module(name)


def split_id(env_id: str) -> tuple[str, str]:
    """The module and the id in ``module:Env-v0``, Gymnasium's form; an empty module without it."""
    module, _, name = env_id.rpartition(":")
    return module, name


def check_typed(recorded: Iterable[str], typed: Iterable[str], where: str) -> None:
    """Refuse to import what only a file names.

    Raises:
        UserError: if a module is missing among those that the user typed.
    """
    known = {module_name(name) for name in typed}
    missing = [name for name in recorded if module_name(name) not in known]
    if missing:
        raise UserError(
            f"{where} was made with modules of yours: add --gym-packages {' '.join(missing)}"
        )
