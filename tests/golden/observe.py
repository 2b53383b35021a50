"""Looks at one checkout, in a process of its own: ``observe.py ROOT OUT PATTERN...``.

The checkout's packages come first on the import path. Each thing that was looked at is a line of
JSON in OUT: its name, where its value holds, the value, and the seconds of processor time it took.
"""

import fnmatch
import json
import os
import sys
import tempfile
import warnings
from pathlib import Path


def main():
    """Look at what the patterns name, and before that do what it needs."""
    root, out, *patterns = sys.argv[1:]
    with tempfile.TemporaryDirectory(prefix="golden-") as folder:
        place = Path(folder).resolve()
        os.chdir(place)
        # Before the first fork: what the children would import one by one.
        import results
        import stable_baselines3  # noqa: F401
        import trained

        things = [*results.things(Path(root).resolve(), place), *trained.things(place)]
        wanted = {
            thing.name
            for thing in things
            if any(fnmatch.fnmatchcase(thing.name, pattern) for pattern in patterns)
        }
        needed = with_needs(things, wanted)
        with Path(out).open("w", encoding="utf-8") as file, warnings.catch_warnings():
            warnings.simplefilter("ignore")
            for thing in things:
                if thing.name not in needed:
                    continue
                start = os.times()
                try:
                    found = thing.look()
                except Exception as error:  # noqa: BLE001  # that is what becomes of it
                    found = f"{type(error).__name__}: {error}"
                if thing.name in wanted:
                    line = [thing.name, thing.holds, found, spent(start, os.times())]
                    print(json.dumps(line), file=file, flush=True)


def with_needs(things, wanted):
    """The names that are wanted, and of those things that have to be done before."""
    while True:
        groups = tuple({thing.needs for thing in things if thing.name in wanted and thing.needs})
        more = wanted | {thing.name for thing in things if thing.name.startswith(groups)}
        if not groups or more == wanted:
            return wanted
        wanted = more


def spent(before, after):
    """Processor time between two moments, of this process and of those that it has waited for."""
    return round(sum(after[:4]) - sum(before[:4]), 2)


if __name__ == "__main__":
    main()
