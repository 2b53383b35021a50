"""The code that a run loads beside this project: installed distributions and the user's modules.

A run records both in ``run.json``, and a worker of a cluster must have the same. The distributions
are the requirements of this project and the imports of the user's modules, each with its own
requirements, whether or not the run uses them.
"""

from __future__ import annotations

import hashlib
import os
import re
import sys
from collections.abc import Iterable, Iterator, Mapping
from functools import cache
from typing import TYPE_CHECKING, Any

from rl_yardstick.pipeline.digests import digest_of
from rl_yardstick.pipeline.user_modules import UserModule, files_of, is_ours, named_in

if TYPE_CHECKING:
    from importlib.metadata import Distribution

    from rl_yardstick.pipeline.train_spec import TrainSpec

DISTRIBUTIONS = "distributions"  # fields of ``run.json``
MODULES = "module_digests"

# With the extras that add agents, and with libraries that change the last bits of others' results.
_ROOTS = ("rl-yardstick[bandits,contrib]", "bottleneck", "icc-rt", "intel-cmplr-lib-rt", "numexpr")
_REQUIREMENT = re.compile(r"\s*([\w.-]+)\s*(?:\[([^\]]*)\])?")
_EXTRA = re.compile(r"""extra\s*==\s*["']([\w.-]+)["']""")
_REQUIRED = re.compile(r"^Requires-Dist:(.*)$", re.MULTILINE | re.IGNORECASE)


@cache
def distributions(*more: str) -> dict[str, str]:
    """The versions of this project, ``more`` and all their requirements, by name, if installed."""
    found: dict[str, str] = {}
    to_do, seen = [*_ROOTS, *more], set[tuple[str, frozenset[str]]]()
    while to_do:
        match = _REQUIREMENT.match(to_do.pop())
        if match is None:
            continue
        extras = frozenset(_normal(extra) for extra in (match[2] or "").split(","))
        wanted = _normal(match[1]), extras
        if wanted not in seen and (installed := _installed(wanted[0])) is not None:
            found[wanted[0]] = installed.version
            to_do += _requirements(installed, extras)
        seen.add(wanted)
    return dict(sorted(found.items()))


def _normal(name: str) -> str:
    return re.sub(r"[-_.]+", "-", name.strip()).lower()


def _installed(name: str) -> Distribution | None:
    from importlib.metadata import PackageNotFoundError, distribution

    try:
        return distribution(name)
    except PackageNotFoundError:
        return None


def _requirements(installed: Distribution, extras: frozenset[str]) -> Iterator[str]:
    """The requirements of a distribution; evaluates only the marker ``extra``.

    Other markers do not matter, because only installed distributions count.
    """
    text = installed.read_text("METADATA") or installed.read_text("PKG-INFO") or ""
    for line in _REQUIRED.findall(text.partition("\n\n")[0]):
        extra = _EXTRA.search(line)
        if extra is None or _normal(extra[1]) in extras:
            yield line


def imported_distributions(modules: Iterable[UserModule]) -> tuple[str, ...]:
    """The distributions that the user's modules import, except those of this project."""
    files = {name: path for module in modules for name, path in files_of(module).items()}
    beside = {name.partition("/")[0].removesuffix(".py") for name in files}
    tops = {top for path in files.values() for top in named_in(path)} | beside
    return tuple(sorted({name for top in tops for name in _distributions_with(top)}))


@cache
def _distributions_with(top: str) -> tuple[str, ...]:
    """The distributions with a module of that name."""
    if top in sys.stdlib_module_names or _normal(top) in distributions() or is_ours(top):
        return ()
    return (top,) if _installed(top) is not None else _by_module().get(top, ())


@cache
def _by_module() -> Mapping[str, tuple[str, ...]]:
    from importlib.metadata import packages_distributions  # which takes 0.2 s

    return {top: tuple(names) for top, names in packages_distributions().items()}


def digests_of_module(module: UserModule) -> dict[str, str]:
    """The digests of a module's files and of its imports from the same folder, by name."""
    return {name: digest_of(path) for name, path in files_of(module).items()}


def recorded_code(modules: Iterable[UserModule]) -> dict[str, Any]:
    """The fields of ``run.json`` that name this code."""
    modules = tuple(modules)
    found = {DISTRIBUTIONS: distributions(*imported_distributions(modules))}
    if not modules:
        return found
    digests = {k: v for module in modules for k, v in digests_of_module(module).items()}
    return {**found, MODULES: digests}


def files_in_settings(spec: TrainSpec) -> list[str]:
    """The texts in a run's hyperparameters that are paths of files, such as the log of a bandit."""
    texts = {text for text in _texts(spec.saved_hyperparams) if os.sep in text or "." in text}
    return sorted(text for text in texts if os.path.isfile(text))  # noqa: PTH113  # never raises


def _texts(value: Any) -> Iterator[str]:
    if isinstance(value, Mapping | list | tuple):
        for item in value.values() if isinstance(value, Mapping) else value:
            yield from _texts(item)
    elif isinstance(value, str):
        yield value


def digest_of_lines(versions: Mapping[str, str]) -> str:
    """A digest of names and versions: 16 hexadecimal digits."""
    lines = "\n".join(f"{name} {version}" for name, version in sorted(versions.items()))
    return hashlib.sha256(lines.encode()).hexdigest()[:16]
