"""Make deliberate errors in a package, one at a time, and see whether the tests notice.

    make mutants PACKAGE=mdp N=25

The tests that enter the function are tried first, whatever folder they are in, cheap ones before
others, for a limited time: what survives may be caught by a test that there was no time for. mutmut
and cosmic-ray do not know that Numba's cache brings back the machine code from before the error.
"""

from __future__ import annotations

import argparse
import ast
import contextlib
import faulthandler
import hashlib
import importlib.util
import json
import os
import resource
import shutil
import signal
import sys
import types
from collections import defaultdict
from itertools import accumulate
from pathlib import Path

import hypothesis  # noqa: F401  # pytest's plugin imports it, in every child that has not
import pytest
from drawing import Mutant, drawn

NOT_COPIED = shutil.ignore_patterns(".*", "logs", "runs", "build", "__pycache__")
LIBRARIES = "torch._dynamo scipy.stats pandas matplotlib.pyplot gymnasium stable_baselines3 numba"
OPTIONS = ["-q", "-n", "0", "-p", "no:cacheprovider", "--hypothesis-seed=0"]
OPTIONS += ["-W", "ignore:Module already imported"]  # before the fork
# Seconds of processor time after which no further test begins, and more where all is compiled anew.
# The first round has tests of FIRST seconds. So much after the budget the test that runs hangs.
BUDGET, COMPILING, FIRST, HANG = 10, 30, 3, 40


class Observer:
    """A pytest plugin: a line for each test with its name, result, cost and functions entered."""

    def __init__(self, root: Path, report: Path, budget: float) -> None:
        self.root, self.report, self.limit = f"{root}/", report, processor_time() + budget
        self.failed: set[str] = set()
        self.entered: dict[int, types.CodeType] = {}

    def enter(self, frame: types.FrameType, event: str, _: object) -> None:
        """For `sys.settrace`: no lines are traced."""
        self.entered[id(frame.f_code)] = frame.f_code

    def pytest_runtest_logreport(self, report: pytest.TestReport) -> None:
        self.failed |= set() if report.passed else {report.nodeid}

    @pytest.hookimpl(wrapper=True)
    def pytest_runtest_protocol(self, item: pytest.Item):
        self.entered.clear()
        before = processor_time()
        result = yield
        codes = [code for code in [*self.entered.values()] if code.co_name != "<module>"]
        places = [f"{code.co_filename}:{code.co_firstlineno}" for code in codes]
        own = [p.removeprefix(self.root) for p in places if p.startswith(self.root)]
        passed, cost = item.nodeid not in self.failed, processor_time() - before
        with self.report.open("a") as file:
            file.write(json.dumps([item.nodeid, passed, cost, own]) + "\n")
        if processor_time() > self.limit:
            os._exit(0)
        return result


def processor_time() -> float:
    return sum(os.times()[:4])


class Copy:
    """A copy of a checkout, and which functions each test enters in it."""

    def __init__(self, root: Path) -> None:
        self.place = root / "build" / "mutants"
        self.path, self.report = self.place / "copy", self.place / "report"
        shutil.rmtree(self.path, ignore_errors=True)
        shutil.copytree(root, self.path, symlinks=True, ignore=NOT_COPIED)
        folders = [file.parent for file in self.path.glob("*/__init__.py")]
        sources = sorted(folder for folder in folders if not folder.is_symlink())
        self.broken: list[str] = []
        self.costs: dict[str, float] = {}
        self.entering: dict[str, set[str]] = defaultdict(set)
        for folder in sorted({file.parent for file in self.path.glob("tests/*/test_*.py")}):
            self._watch(folder, [*sources, folder])
        assert self.costs, f"without any error no test passes: {self.place / 'log'}"

    def _watch(self, folder: Path, sources: list[Path]) -> None:
        """Run the tests of a folder, or take what they did when the same sources were watched."""
        text = b"\0".join(p.read_bytes() for f in sources for p in sorted(f.rglob("*.py")))
        results = self.place / f"{folder.name}.{hashlib.sha256(text).hexdigest()[:16]}"
        if not results.exists():
            for old in self.place.glob(f"{folder.name}.*"):
                old.unlink()
            self.run([f"tests/{folder.name}"], trace=True)
            self.report.rename(results)
        for line in results.read_text().splitlines():
            test, passed, cost, functions = json.loads(line)
            if not passed:
                self.broken.append(test)
                continue
            self.costs[test] = cost
            for function in functions:
                self.entering[function].add(test)

    def run(self, tests: list[str], fresh: bool = False, trace: bool = False) -> str | None:
        """Run tests in a child: the first that fails, or how it ended; None if all is well."""
        budget = 10_000 if trace else BUDGET + COMPILING * fresh
        self.report.write_text("")
        child = os.fork()
        if not child:
            try:
                os._exit(self._child(tests, budget, fresh, trace))
            finally:
                os._exit(99)
        code = os.waitstatus_to_exitcode(os.waitpid(child, 0)[1])
        with contextlib.suppress(ProcessLookupError):
            os.killpg(child, signal.SIGKILL)  # the whole group: tests start processes
        found = [json.loads(line) for line in self.report.read_text().splitlines()]
        failed = [test for test, passed, *_ in found if not passed]
        if code == 0 or failed:
            return failed[0] if code else None
        return "a time-out" if code < 2 else f"pytest's code {code}"

    def _child(self, tests: list[str], budget: float, fresh: bool, trace: bool) -> int:
        os.setsid()
        os.chdir(self.path)
        resource.setrlimit(resource.RLIMIT_CPU, (int(budget + HANG), int(budget + HANG) + 5))
        faulthandler.dump_traceback_later(8 * (budget + HANG), exit=True)
        log = os.open(self.place / "log", os.O_WRONLY | os.O_CREAT | os.O_TRUNC)
        os.dup2(log, 1)
        os.dup2(log, 2)
        # What multiprocessing starts is not to run this program again.
        sys.modules["__main__"], sys.argv = types.ModuleType("__main__"), ["pytest"]
        sys.path[0] = str(self.path)
        code = self.place / ("kept" if trace else "code")
        os.environ |= {"PYTHONPATH": str(self.path), "NUMBA_CACHE_DIR": str(code)}
        observer = Observer(self.path, self.report, budget)
        options = [*OPTIONS, f"--basetemp={self.place / 'tmp'}", f"--maxfail={int(not trace)}"]
        if trace:
            sys.settrace(observer.enter)
        else:
            shutil.rmtree(code, ignore_errors=True)
            with contextlib.suppress(Exception):
                self._keep_machine_code(code, fresh)
        status = pytest.main([*options, *tests], plugins=[observer])
        sys.stdout.flush()
        return int(status)

    def _keep_machine_code(self, code: Path, fresh: bool) -> None:
        """Give what was compiled before the error the error's digest, if it is not about that."""
        from rl_yardstick.machine_code.compiling import digest

        digests = (self.place / "kept" / "yardstick").iterdir()
        before = max(digests, key=lambda p: p.stat().st_mtime)
        if digest() == before.name or not fresh:
            shutil.copytree(before, code / "yardstick" / digest(), copy_function=os.link)

    def judge(self, mutant: Mutant) -> str:
        """The test that catches an error, or another fate."""
        file = self.path / mutant.path
        source = file.read_text()
        tests, fresh = self._likely(mutant, source)
        totals = [*accumulate(self.costs[test] for test in tests)]
        few, many = (1 + sum(total < limit for total in totals) for limit in (FIRST, BUDGET))
        # Byte code may be as old as its source, to the second: none is kept of this file.
        byte_code = Path(importlib.util.cache_from_source(str(file)))
        try:
            file.write_text(mutant.applied_to(source))
            byte_code.unlink(missing_ok=True)
            for chosen in filter(None, (tests[:few], tests[few:many])):
                files = list(dict.fromkeys(test.split("::")[0] for test in chosen))
                chosen.sort(key=lambda test, files=files: files.index(test.split("::")[0]))
                if failure := self.run(chosen, fresh):
                    return failure
        finally:
            file.write_text(source)
            byte_code.unlink(missing_ok=True)
        return "survived"

    def _likely(self, mutant: Mutant, source: str) -> tuple[list[str], bool]:
        """The tests in the order of trying them; and whether the error may be in machine code.

        Compiled functions leave no trace. Nor does a fixture of several tests but in the first: so
        after the tests that enter the function come the others of their files.
        """
        functions = [n for n in ast.walk(ast.parse(source)) if isinstance(n, ast.FunctionDef)]
        around = [node for node in functions if node.lineno <= mutant.line <= node.end_lineno]
        parts = [part.lineno for node in around[-1:] for part in (node, *node.decorator_list)]
        covering = self.entering[f"{mutant.path}:{min(parts, default=0)}"]
        places = [place for place in self.entering if place.startswith(f"{mutant.path}:")]
        entering = covering or set().union(*map(self.entering.get, places))
        files = {test.split("::")[0] for test in entering}
        own = f"tests/{mutant.path.removeprefix('rl_yardstick/').split('/')[0]}/"

        def rank(test: str) -> tuple[bool, bool, bool, bool, float]:
            file = test.partition("::")[0]
            is_far = file not in files, Path(mutant.path).stem not in file, not test.startswith(own)
            return test not in covering, *is_far, self.costs[test]

        return sorted(self.costs, key=rank), not covering


def main() -> None:
    """Draw errors, judge each, and count."""
    root = Path(__file__).resolve().parents[2]
    parser = argparse.ArgumentParser(description=(__doc__ or "").partition("\n")[0])
    parser.add_argument("packages", nargs="+", help="folders of sources, such as rl_yardstick/mdp")
    parser.add_argument("-n", type=int, default=25, help="how many errors in each (25)")
    parser.add_argument("--seed", type=int, default=0, help="which errors (0)")
    args, fates = parser.parse_args(), []
    os.environ |= {f"{name}_NUM_THREADS": "1" for name in ("OMP", "MKL", "OPENBLAS", "NUMBA")}
    for name in LIBRARIES.split():
        importlib.import_module(name)
    copy = Copy(root)
    for test in copy.broken:
        print(f"left out, as it fails without any error: {test}", file=sys.stderr)
    for package in args.packages:
        for mutant in drawn(root, package, args.n, args.seed):
            fates.append(copy.judge(mutant))
            was, now = (" ".join(text.split())[:90] for text in (mutant.old, mutant.new))
            print(f"{mutant.path}:{mutant.line}: {was}  ->  {now}\n    {fates[-1]}", flush=True)
    print(f"caught {len(fates) - fates.count('survived')} of {len(fates)}")


if __name__ == "__main__":
    main()
