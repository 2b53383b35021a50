"""How many faults the audit names, names wrongly, passes as right, and cannot read.

    python benchmarks/audit_faults.py [FOLDER] [--json FILE]

Without a folder, the programs are those of tests/diagnosis/planted.py. In a folder, the first line
of each Python file is ``# right``, or ``# fault: name``; several names that are right are joined by
"or". What is audited is the function ``train``, or the class of the file that learns.
"""

from __future__ import annotations

import argparse
import contextlib
import inspect
import io
import json
import re
import sys
import tempfile
import time
import warnings
from collections import Counter
from pathlib import Path
from typing import Any

import torch as th

from rl_yardstick.diagnosis.audit import Verdict, audit
from rl_yardstick.diagnosis.subjects import ClassSubject, ScriptSubject, Subject
from rl_yardstick.pipeline.components import class_name, import_modules, module_name
from rl_yardstick.pipeline.errors import UserError

ROOT = Path(__file__).resolve().parents[1]
sys.path[:0] = [str(ROOT)]

from tests.diagnosis.planted import FAULTS, PROGRAMS, text_of  # noqa: E402


def write_own(folder: Path) -> None:
    """Write the programs of the tests: right ones, and one for each fault."""
    for program in PROGRAMS:
        (folder / f"{program}.py").write_text(f"# right\n{text_of(program)}")
    for i, (program, fault, old, new) in enumerate(FAULTS):
        path = folder / f"{program}_{i:02}.py"
        path.write_text(f"# fault: {fault or 'none of the table'}\n{text_of(program, old, new)}")


def subject_of(path: Path) -> Subject:
    """The function ``train`` of a file, or its last class that learns."""
    import_modules([str(path)])
    inside = vars(sys.modules[module_name(str(path))])
    if callable(inside.get("train")):
        return ScriptSubject(f"{path.stem}:train", inside["train"], {})
    learn = [each for each in inside.values() if inspect.isclass(each) and hasattr(each, "learn")]
    own = [each for each in learn if each.__module__ == module_name(str(path))]
    typed = f"{path}:{own[-1].__name__}"
    import_modules([typed])
    return ClassSubject(class_name(typed), {})


def audited(path: Path) -> Verdict:
    """The verdict on a file; one that cannot be read if it is refused."""
    try:
        with warnings.catch_warnings(), contextlib.redirect_stdout(io.StringIO()):
            warnings.simplefilter("ignore")
            return audit(subject_of(path))
    except UserError as error:
        return Verdict(path.stem, "unreadable", notes=(str(error),))


def outcome(planted: str, verdict: Verdict) -> str:
    """What became of a program: ``planted`` is its fault, empty for a right one."""
    if verdict.state == "unreadable":
        return "unreadable"
    if verdict.state == "right":
        return "passed" if planted else "accepted"
    if not planted:
        return "right one accused"
    names = [re.sub(r"\W+", "-", name.strip().lower()) for name in planted.split(" or ")]
    if not verdict.fault:
        return "wrong, no name"
    return "named" if set(names) & set(verdict.fault.split(" or ")) else "other name"


def main() -> None:
    """Print a line for each program, and the counts."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").partition("\n")[0])
    parser.add_argument("folder", nargs="?", type=Path)
    parser.add_argument("--only", default="", help="part of the names of files")
    parser.add_argument("--json", type=Path)
    args = parser.parse_args()
    th.set_num_threads(1)
    counts, rows = Counter[str](), list[dict[str, Any]]()
    with tempfile.TemporaryDirectory() as own:
        folder: Path = args.folder or Path(own)
        if args.folder is None:
            write_own(folder)
        for path in sorted(folder.glob("*.py")):
            first = path.read_text(encoding="utf-8").partition("\n")[0].lstrip("# ")
            if args.only not in path.name or not first.startswith(("right", "fault")):
                continue
            planted = first.partition(":")[2].strip() if first.startswith("fault") else ""
            start = time.process_time()
            verdict = audited(path)
            seconds = time.process_time() - start
            found = outcome(planted, verdict)
            counts[found] += 1
            told = [verdict.target, *verdict.notes]
            print(
                f"{path.stem:16}{found:20}{planted or 'right'} -> {verdict.fault} ({seconds:.0f} s)"
            )
            print(*(f"    {line}" for line in told if line), sep="\n", flush=True)
            rows.append(
                {"file": path.stem, "planted": planted, "outcome": found} | verdict.as_json()
            )
    print(dict(counts))
    if args.json:
        args.json.write_text(json.dumps({"counts": counts, "programs": rows}, indent=2))


if __name__ == "__main__":
    main()
