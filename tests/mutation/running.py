"""Each error is made in a copy of the checkout, and the tests are run there."""

from __future__ import annotations

import contextlib
import os
import re
import shutil
import signal
import subprocess
import sys
import tempfile
from pathlib import Path

from drawing import Mutant
from imports import Imports

# The packages whose tests get a chance once those of the mutated package have stayed green.
ABOVE = {
    "machine_code": ("mdp", "agents"),
    "mdp": ("envs", "agents", "pipeline"),
    "verdicts": ("experiments", "report", "commands"),
    "envs": ("mdp", "agents", "pipeline", "experiments"),
    "agents": ("pipeline", "experiments", "studies"),
    "pipeline": ("experiments", "report", "commands", "studies"),
    "experiments": ("report", "commands", "studies"),
    "tuning": ("commands", "report"),
    "report": ("experiments", "commands"),
    "commands": ("pipeline",),
}
NOT_COPIED = shutil.ignore_patterns(
    ".git", ".venv", "logs", "runs", "build", "__pycache__", ".*_cache", ".hypothesis"
)
OPTIONS = ["-x", "-q", "-n", "0", "-p", "no:cacheprovider", "--hypothesis-seed=0"]
# Seconds after which the tests of the packages above are taken to hang.
LIMIT_ABOVE = 1800


class Checkout:
    """A copy of the checkout, in which one error at a time is made and mended."""

    def __init__(self, root: Path, copy: Path) -> None:
        shutil.copytree(root, copy, ignore=NOT_COPIED)
        self.path = copy
        self._caches = copy.parent / f"{copy.name}-machine-code"

    def first_failure(self, files: list[str], limit: float, fresh: bool = False) -> str | None:
        """The first test that fails, or what else went wrong; None when all are green.

        No byte code is written, since that of an error could outlive it. Nor may machine code: a
        run that is ``fresh`` compiles everything anew.
        """
        self._caches.mkdir(exist_ok=True)
        with tempfile.TemporaryDirectory(dir=self._caches) as new_cache:
            environment = os.environ | {
                "PYTHONPATH": str(self.path),
                "PYTHONDONTWRITEBYTECODE": "1",
                "NUMBA_CACHE_DIR": new_cache if fresh else str(self._caches / "kept"),
                "OMP_NUM_THREADS": "1",
            }
            command = [sys.executable, "-m", "pytest", *OPTIONS, *files]
            code, output = _run(command, self.path, environment, limit)
        if code == 0:
            return None
        failed = re.search(r"^(?:FAILED|ERROR) (.+?)(?: - .*)?$", output, re.MULTILINE)
        return failed[1] if failed else "a time-out" if code is None else f"pytest's code {code}"

    def judge(
        self, mutant: Mutant, imports: Imports, above: tuple[str, ...], limit: float
    ) -> str | None:
        """The test that catches an error, or None when it survives them all.

        Args:
            mutant: the error.
            imports: of the checkout.
            above: the packages whose tests get a chance after those of the mutated one.
            limit: seconds after which the tests of the mutated package are taken to hang.
        """
        file = self.path / mutant.path
        source = file.read_bytes()
        fresh = mutant.path in imports.beneath_machine_code()
        distances = imports.distances(mutant.path)

        def remoteness(test: str) -> tuple[bool, int]:
            return file.stem not in test, distances.get(test, 99)

        own, others = (
            # The module's namesakes come first, then those that stand nearest to it.
            sorted(test_files(self.path, packages), key=remoteness)
            for packages in ((mutant.path.partition("/")[0],), above)
        )
        try:
            file.write_bytes(mutant.applied_to(source))
            failure = self.first_failure(own, limit, fresh)
            if failure or not others:
                return failure
            failure = self.first_failure(others, LIMIT_ABOVE, fresh)
        finally:
            file.write_bytes(source)
        # These tests were not seen green before: they may fail without the error as well.
        if failure and failure.startswith("tests") and self.first_failure([failure], limit):
            return None
        return failure


def test_files(root: Path, packages: tuple[str, ...]) -> list[str]:
    folders = [root / "tests" / package for package in packages]
    return [p.relative_to(root).as_posix() for f in folders for p in sorted(f.rglob("test_*.py"))]


def _run(
    command: list[str], cwd: Path, environment: dict[str, str], limit: float
) -> tuple[int | None, str]:
    """Exit code and output, the code being None where time ran out."""
    with subprocess.Popen(
        command,
        cwd=cwd,
        env=environment,
        text=True,
        stdout=subprocess.PIPE,
        stderr=subprocess.STDOUT,
        start_new_session=True,
    ) as process:
        try:
            output, _ = process.communicate(timeout=limit)
            return process.returncode, output
        except subprocess.TimeoutExpired:
            return None, ""
        finally:
            # The whole group: tests start processes of their own.
            with contextlib.suppress(ProcessLookupError):
                os.killpg(process.pid, signal.SIGKILL)
