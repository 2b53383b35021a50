"""Looks at one checkout, in a process of its own: ``observe.py ROOT OUT PATTERN...``.

The checkout's packages come first on the import path. Each thing that was looked at is a line of
JSON in OUT: its name, where its value holds, the value, and the seconds of processor time it took.
"""

import json
import os
import sys
import tempfile
import warnings
from fnmatch import fnmatchcase
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
            thing.name for thing in things if any(fnmatchcase(thing.name, p) for p in patterns)
        }
        needed = with_needs(things, wanted)
        with Path(out).open("w", encoding="utf-8") as file, warnings.catch_warnings():
            warnings.simplefilter("ignore")
            for thing in things:
                if thing.name not in needed:
                    continue
                before = sum(os.times()[:4])  # with those processes that it has waited for
                try:
                    found = thing.look()
                except Exception as error:  # noqa: BLE001  # that is what becomes of it
                    found = f"{type(error).__name__}: {error}"
                if thing.name in wanted:
                    spent = round(sum(os.times()[:4]) - before, 2)
                    line = [thing.name, thing.holds, found, spent]
                    print(json.dumps(line), file=file, flush=True)


def with_needs(things, wanted):
    """The names that are wanted, and of those things that have to be done before."""
    groups = tuple({thing.needs for thing in things if thing.name in wanted and thing.needs})
    more = wanted | {thing.name for thing in things if thing.name.startswith(groups)}
    return wanted if more == wanted else with_needs(things, more)


if __name__ == "__main__":
    main()
