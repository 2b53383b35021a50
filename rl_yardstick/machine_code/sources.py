"""The sources of packages, a digest of their content, and the packages with cached machine code."""

from __future__ import annotations

import hashlib
from collections.abc import Iterable
from pathlib import Path

# The folder of `rl_yardstick`, with all packages.
ROOT = Path(__file__).resolve().parent.parent

# For each package: all packages whose sources its machine code depends on.
_SOURCES_OF_CODE: dict[str, tuple[str, ...]] = {}


def keep_machine_code(package: str, *others: str) -> None:
    """Cache the machine code of a package's functions on disk.

    Args:
        package: its name.
        others: the packages from which functions, types or constants are compiled into them.
    """
    _SOURCES_OF_CODE[package] = (package, *others, "machine_code")


def kept_packages() -> dict[str, tuple[str, ...]]:
    """The packages with cached machine code, each with those whose sources the code depends on."""
    return dict(_SOURCES_OF_CODE)


def source_paths(packages: Iterable[str]) -> list[Path]:
    """Every source of the packages, in the order of their names."""
    return sorted(path for package in packages for path in (ROOT / package).rglob("*.py"))


def content_lines(paths: Iterable[Path]) -> list[str]:
    """A line for each source: its path below the packages' folder, and a digest of its content."""
    return [
        f"{path.relative_to(ROOT).as_posix()} {hashlib.sha256(path.read_bytes()).hexdigest()}"
        for path in paths
    ]


def digest_of(lines: Iterable[str]) -> str:
    """The first 16 hexadecimal digits of the lines' SHA-256."""
    return hashlib.sha256("\n".join(lines).encode()).hexdigest()[:16]
