"""Records what the project produces, or tells what another checkout produces differently.

    python tests/golden                     # this checkout against golden.json
    python tests/golden --root ../other     # another checkout against it
    python tests/golden --record            # write golden.json anew

For changes that shall change nothing: whatever differs is told in one line, and the exit code is 1.
All is done through command lines, the names in the registry and the formats of files. So the same
program looks at commits before and after modules have moved. ``--only 'train Taxi*' 'help *'``
looks at a part.
"""

import argparse
import difflib
import fnmatch
import json
import os
import platform
import subprocess
import sys
import tempfile
from importlib.metadata import version
from itertools import zip_longest
from pathlib import Path

HERE = Path(__file__).resolve().parent
ROOT = HERE.parents[1]
GOLDEN = HERE / "golden.json"
LIBRARIES = (
    *("gymnasium", "mabwiser", "matplotlib", "numba", "numpy", "optuna", "sb3-contrib", "scipy"),
    *("stable-baselines3", "torch"),
)
SHOWN = 160  # characters of a value in a difference
NOT_HERE = "not comparable here: "


def main():
    """Record, or compare; the exit code."""
    arguments = _parse()
    found = look(arguments.root, arguments.only)
    spent = sum(seconds for _, _, seconds in found.values())
    print(f"{len(found)} entries, {spent:.0f} s of processor time")
    if arguments.record:
        record(found, arguments.only)
        return 0
    recorded = json.loads(GOLDEN.read_text(encoding="utf-8"))
    lines = list(differences(recorded, found, arguments.only))
    print(*lines or ["no difference"], sep="\n")
    return int(any(not line.startswith(NOT_HERE) for line in lines))


def look(root, patterns):
    """Look at a checkout, in a new process that imports its packages and no others of that name.

    By name: where a value holds, the value, and the seconds that it took.
    """
    with tempfile.TemporaryDirectory() as folder:
        out = Path(folder) / "found.jsonl"
        threads = {f"{library}_NUM_THREADS": "1" for library in ("OMP", "MKL", "OPENBLAS", "NUMBA")}
        own = {"XDG_CONFIG_HOME": folder, "SDL_VIDEODRIVER": "dummy", "MPLBACKEND": "Agg"}
        # A study in this process may have left it, and the program imports what lies beside it.
        env = {name: value for name, value in os.environ.items() if name != "PYTHONSAFEPATH"}
        subprocess.run(
            [sys.executable, HERE / "observe.py", root, out, *patterns],
            env=env | threads | own | {"PYTHONPATH": str(root.resolve())},
            check=True,
        )
        rows = map(json.loads, out.read_text(encoding="utf-8").splitlines())
        return {name: tuple(row) for name, *row in rows}


def facts():
    """What values depend on that do not hold anywhere."""
    import torch as th

    return {
        "python": ".".join(platform.python_version_tuple()[:2]),
        "machine": f"{platform.system()} {platform.machine()}",
        "capability": th.backends.cpu.get_cpu_capability(),
        **{name: version(name) for name in LIBRARIES},
    }


def record(found, patterns):
    """Write the file of results, a line for each entry or for each line of its text."""
    values, here = {name: (holds, value) for name, (holds, value, _) in found.items()}, facts()
    if patterns != ["*"] and GOLDEN.exists():  # those that were not looked at stay
        before = json.loads(GOLDEN.read_text(encoding="utf-8"))
        if before["facts"] != here and "here" in {holds for holds, _ in values.values()}:
            raise SystemExit("the other entries are of another machine: record all, without --only")
        here = before["facts"]
        for where, entries in before["entries"].items():
            values |= {n: (where, v) for n, v in entries.items() if not matches(n, patterns)}
    entries = {
        where: {name: values[name][1] for name in sorted(values) if values[name][0] == where}
        for where in ("anywhere", "here")
    }
    text = json.dumps({"facts": here, "entries": entries}, indent=0, ensure_ascii=False)
    GOLDEN.write_text(f"{text}\n", encoding="utf-8")
    print(f"{GOLDEN.name}: {len(text) / 1000:.0f} kB")


def matches(name, patterns):
    """Whether a name is one of those that are looked at."""
    return any(fnmatch.fnmatchcase(name, pattern) for pattern in patterns)


def differences(recorded, found, patterns):
    """A line for each difference, and for each thing that cannot be compared here."""
    here = facts()
    changed_facts = [name for name, value in recorded["facts"].items() if here[name] != value]
    left = {name: value for name, (_, value, _) in found.items()}
    for where, entries in recorded["entries"].items():
        skipped = 0
        for name, was in entries.items():
            if not matches(name, patterns):
                continue
            lines = list(changes(name, was, left.pop(name, None)))
            if where == "here" and changed_facts and lines:
                skipped += 1
            else:
                yield from lines
        if skipped:
            names = ", ".join(f"{n} {recorded['facts'][n]}, here {here[n]}" for n in changed_facts)
            yield f"{NOT_HERE}{skipped} entries that depend on {names}"
    for name in sorted(left):
        yield f"{name}: is new; {sys.executable} tests/golden --record --only {name!r}"


def changes(name, was, now):
    """What was and what is, in a line for each line that has changed."""
    if was == now:
        return
    if now is None:
        yield f"{name}: is gone"
    elif isinstance(was, str) or isinstance(now, str):
        yield f"{name}: was {shown(was)}, is {shown(now)}"
    else:
        matcher = difflib.SequenceMatcher(a=was, b=now, autojunk=False)
        for kind, first, last, begin, end in matcher.get_opcodes():
            if kind != "equal":
                old, new = map(shown, was[first:last]), map(shown, now[begin:end])
                for before, after in zip_longest(old, new, fillvalue="nothing"):
                    yield f"{name}: was {before}, is {after}"


def shown(value):
    """A value, cut where it is long."""
    text = json.dumps(value, ensure_ascii=False)
    return text if len(text) <= SHOWN else f"{text[:SHOWN]}..."


def _parse():
    parser = argparse.ArgumentParser(description=(__doc__ or "").partition("\n")[0])
    parser.add_argument("--root", type=Path, default=ROOT, help="another checkout than this one")
    parser.add_argument("--record", action="store_true", help=f"write {GOLDEN.name}")
    parser.add_argument("--only", nargs="+", default=["*"], metavar="NAME", help="patterns")
    return parser.parse_args()


if __name__ == "__main__":
    sys.exit(main())
