"""The code that runs of a study load: sent with each order by its digests, and compared by workers.

A worker must have the driver's versions of Python, this project and all distributions that a run
loads, and the same contents of files that settings name. The user's modules are sent: a worker
whose own copies differ imports the sent ones.
"""

from __future__ import annotations

import platform
from collections.abc import Mapping
from dataclasses import asdict, dataclass, replace
from functools import cache, lru_cache
from pathlib import Path
from typing import Any, Self

from rl_yardstick.experiments.child_processes import do_aside
from rl_yardstick.pipeline.digests import digest_of, source_digest
from rl_yardstick.pipeline.errors import one_line
from rl_yardstick.pipeline.files import replacing
from rl_yardstick.pipeline.loaded_code import (
    DISTRIBUTIONS,
    MODULES,
    digest_of_lines,
    digests_of_module,
    distributions,
    files_in_settings,
    imported_distributions,
)
from rl_yardstick.pipeline.train_spec import TrainSpec
from rl_yardstick.pipeline.user_modules import MAX_COPY_BYTES, SENT, UserModule, files_of
from rl_yardstick.safe_files.files import UnsafeFileError

PYTHON, SOURCES = "Python", "the sources of Yardstick"


class UnfitError(Exception):
    """This worker cannot do a run as the driver's machine would."""


def versions(*more: str) -> dict[str, str]:
    """The versions that a worker must share, with those of the distributions ``more``."""
    ours = {PYTHON: platform.python_version(), SOURCES: source_digest("experiments")}
    return {**ours, **distributions(*more)}


def differences(wanted: Mapping[str, str], found: Mapping[str, str]) -> str:
    """How versions differ, in words; empty if they do not."""
    names = sorted({**wanted, **found})
    return ", ".join(
        f"{name} {found.get(name, 'is missing')} instead of {wanted.get(name, 'none')}"
        for name in names
        if wanted.get(name) != found.get(name)
    )


@dataclass(frozen=True)
class SentModule:
    """A module of the user, with the modules in its folder that it imports."""

    digests: dict[str, str]  # of its files, by name
    files: dict[str, bytes] | None  # None if it is installed or too large

    @classmethod
    def of(cls, module: UserModule) -> Self:
        """The module as it is now."""
        paths = files_of(module)
        assert paths or module.path is None  # otherwise its import would have failed
        n_bytes = sum(path.stat().st_size for path in paths.values())
        is_sent = module.path is not None and n_bytes <= MAX_COPY_BYTES
        files = {name: path.read_bytes() for name, path in paths.items()} if is_sent else None
        return cls(digests_of_module(module), files)

    @property
    def digest(self) -> str:
        """The digest of all files."""
        return digest_of_lines(self.digests)

    @property
    def names(self) -> set[str]:
        """The names of its top-level modules."""
        return {name.partition("/")[0].removesuffix(".py") for name in self.digests}

    def placed(self, module: UserModule, folder: Path) -> UserModule:
        """The module as typed if it has these contents there, or else its copy in ``folder``."""
        if module.path is None:
            found = do_aside(digests_of_module, module)  # as a run would find it
        else:
            found = digests_of_module(module)
        if found == self.digests:
            return module
        if self.files is None:
            raise UnfitError(f"the module {module.name} has other contents there")
        place = folder / SENT / self.digest
        for name, content in self.files.items():
            if not (place / name).is_file():
                (place / name).parent.mkdir(parents=True, exist_ok=True)
                with replacing(place / name) as file:
                    file.write(content)
        path = place.joinpath(*module.name.split("."))
        return replace(module, path=str(path if path.is_dir() else path.with_suffix(".py")))


@dataclass(frozen=True)
class SentCode:
    """The code that the run of an order loads."""

    version: str  # the digest of `versions` with ``more``
    more: tuple[str, ...]  # the distributions that the user's modules import
    modules: tuple[SentModule, ...]  # in the order of the spec's
    files: dict[str, str]  # digests of the files that settings name, by path

    @classmethod
    def of(cls, spec: TrainSpec) -> Self:
        """The code of a run."""
        more, modules = _of_modules(spec.user_modules)
        files = {text: _first_digest(Path(text).absolute()) for text in files_in_settings(spec)}
        return cls(digest_of_lines(versions(*more)), more, modules, files)

    def as_data(self) -> dict[str, Any]:
        """Convert to plain data."""
        return {**asdict(self), "more": list(self.more), "modules": [*map(asdict, self.modules)]}

    @classmethod
    def of_data(cls, data: Mapping[str, Any]) -> Self:
        """Read what `as_data` returned."""
        modules = tuple(SentModule(**module) for module in data["modules"])
        return cls(data["version"], tuple(data["more"]), modules, data["files"])

    def is_recorded_in(self, info: Mapping[str, Any]) -> bool:
        """Whether a ``run.json`` says that its run has loaded this code."""
        digests = {name: d for sent in self.modules for name, d in sent.digests.items()}
        is_same = info.get(DISTRIBUTIONS) == distributions(*self.more)
        return is_same and info.get(MODULES, {}) == digests

    def check_files(self, home: Path) -> None:
        """Compare the files that settings name; relative paths start at ``home``."""
        for text, digest in self.files.items():
            try:
                found = _digest(home / text)
            except (OSError, UnsafeFileError) as error:
                raise UnfitError(f"{text} cannot be read: {one_line(error)}") from error
            if found != digest:
                raise UnfitError(f"the file {text} has other contents there")


@cache
def _of_modules(
    modules: tuple[UserModule, ...],
) -> tuple[tuple[str, ...], tuple[SentModule, ...]]:
    """The user's modules as they are at the first call: later changes do not enter a study."""
    return imported_distributions(modules), tuple(map(SentModule.of, modules))


@cache
def _first_digest(path: Path) -> str:
    """The digest of a file at the first call; later changes do not enter a study."""
    return digest_of(path)


def _digest(path: Path) -> str:
    stat = path.stat()
    return _digest_of(path, stat.st_size, stat.st_mtime_ns)


@lru_cache(100)
def _digest_of(path: Path, size: int, changed: int) -> str:
    """Cached until the file changes."""
    return digest_of(path)
