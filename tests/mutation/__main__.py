"""Make deliberate errors in a package, one at a time, and see whether the tests notice.

    make mutants PACKAGE=mdp N=25

Why not mutmut or cosmic-ray: mutmut 3 puts a dispatcher in place of each function, which Numba
cannot compile, and passes decorated functions by; cosmic-ray changes the working tree in place, and
neither knows that Numba's cache brings back the machine code from before the error.
"""

from __future__ import annotations

import argparse
import queue
import sys
import tempfile
import time
from concurrent.futures import ThreadPoolExecutor, as_completed
from pathlib import Path

from drawing import Mutant, draw
from imports import Imports
from running import ABOVE, Checkout, test_files

ROOT = Path(__file__).resolve().parents[2]
# A hang is recognised by this: so many times the tests' usual time, plus what a cold start takes.
PATIENCE, COLD_START = 4, 120


def main() -> int:
    """Draw, and unless that is all that is wanted, judge each error and count."""
    arguments = _parse()
    root = arguments.root.resolve()
    drawn = draw(root, arguments.package, arguments.n, arguments.seed)
    if not drawn:
        print(f"no errors can be made in {root / arguments.package}", file=sys.stderr)
        return 2
    if arguments.list:
        for mutant in drawn:
            print(mutant.describe((root / mutant.path).read_bytes()))
        return 0
    above = () if arguments.own else ABOVE.get(arguments.package, ())
    with tempfile.TemporaryDirectory(prefix="mutants-") as folder:
        copies = [Checkout(root, Path(folder) / f"copy-{i}") for i in range(arguments.jobs)]
        start = time.monotonic()
        broken = copies[0].first_failure(test_files(root, (arguments.package,)), limit=3600)
        if broken:
            print(f"without any error, {broken} fails already", file=sys.stderr)
            return 2
        limit = PATIENCE * (time.monotonic() - start) + COLD_START
        caught = _judge_all(drawn, copies, above, limit)
    print(f"caught {caught} of {len(drawn)} ({100 * caught / len(drawn):.0f} %)")
    return 0


def _judge_all(
    drawn: list[Mutant], copies: list[Checkout], above: tuple[str, ...], limit: float
) -> int:
    """Print each error with what became of it; how many were caught."""
    folders = [path.name for path in copies[0].path.iterdir() if path.is_dir()]
    imports = Imports(copies[0].path, [name for name in folders if name[0] != "."])
    free: queue.Queue[Checkout] = queue.Queue()
    for copy in copies:
        free.put(copy)

    def judge(mutant: Mutant) -> str | None:
        copy = free.get()
        try:
            return copy.judge(mutant, imports, above, limit)
        finally:
            free.put(copy)

    sources = copies[0].path
    described = {m: m.describe((sources / m.path).read_bytes()) for m in drawn}
    caught = 0
    with ThreadPoolExecutor(len(copies)) as pool:
        futures = {pool.submit(judge, mutant): mutant for mutant in drawn}
        for future in as_completed(futures):
            mutant, failure = futures[future], future.result()
            caught += failure is not None
            print(described[mutant])
            print(f"    caught by {failure}" if failure else "    SURVIVED", flush=True)
    return caught


def _parse() -> argparse.Namespace:
    parser = argparse.ArgumentParser(description=(__doc__ or "").partition("\n")[0])
    parser.add_argument("package", help="a package of the project, such as mdp")
    parser.add_argument("-n", type=int, default=25, help="how many errors (25)")
    parser.add_argument("--seed", type=int, default=0, help="which errors (0)")
    parser.add_argument("--jobs", type=int, default=2, help="how many at a time (2)")
    parser.add_argument("--own", action="store_true", help="run the tests of the package alone")
    parser.add_argument("--list", action="store_true", help="draw them, and run nothing")
    parser.add_argument("--root", type=Path, default=ROOT, help="another checkout than this one")
    return parser.parse_args()


if __name__ == "__main__":
    sys.exit(main())
