"""How often `audit` names a planted fault, and how often it accuses what is right.

    python benchmarks/audit_faults.py                     # planted faults, five seeds
    python benchmarks/audit_faults.py --only 'tables.q_*' --seeds 1
    python benchmarks/audit_faults.py FOLDER              # files with tables of your own
    python benchmarks/audit_faults.py --right --seeds 3   # shipped agents instead
    python benchmarks/audit_faults.py --publish           # writes docs/measured/audit-faults.json

A file of planted faults has a table ``FAULTS``: names of its functions or classes, and the id of
the fault that each has; ``RIGHT`` may name others that have none, and ``KINDS`` may say what an
agent claims to be. What is measured is kept, a line for each audit, in ``--results``: the same
command goes on where it was stopped, and ``--publish`` makes the page of all that is there.
"""

from __future__ import annotations

import argparse
import importlib.util
import json
import subprocess
import sys
import time
import warnings
from collections import Counter, defaultdict
from collections.abc import Iterator
from dataclasses import dataclass
from fnmatch import fnmatch
from pathlib import Path
from types import ModuleType
from typing import Any

from pipeline.errors import UserError

ROOT = Path(__file__).resolve().parent.parent
sys.path.insert(0, str(ROOT))

PLANTED = ROOT / "benchmarks" / "planted_faults"
MEASURED = ROOT / "docs" / "measured" / "audit-faults.json"
sys.path.append(str(ROOT / "docs" / "scripts"))

from measured_tables import publish  # noqa: E402

RESULTS = ROOT / "build" / "audit-faults.jsonl"
NOTHING = "-"


@dataclass(frozen=True)
class Case:
    """An agent, and what is wrong with it."""

    name: str
    agent: Any  # a class, a function, or a name of the registry
    fault: str  # an id, or NOTHING
    kind: str | None = None
    params: tuple[tuple[str, Any], ...] = ()


def planted(folder: Path) -> Iterator[Case]:
    """All that the files of a folder name."""
    for path in sorted(folder.glob("*.py")):
        module = _imported(path)
        kinds = getattr(module, "KINDS", {})
        for name, fault in getattr(module, "FAULTS", {}).items():
            yield Case(f"{path.stem}.{name}", getattr(module, name), fault, kinds.get(name))
        for name in getattr(module, "RIGHT", ()):
            yield Case(f"{path.stem}.{name}", getattr(module, name), NOTHING, kinds.get(name))


def _imported(path: Path) -> ModuleType:
    spec = importlib.util.spec_from_file_location(f"planted_{path.stem}", path)
    assert spec is not None
    assert spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    sys.modules[spec.name] = module
    spec.loader.exec_module(module)
    return module


def shipped() -> Iterator[Case]:
    """All agents of the registry that learn values or policies, and their other engines."""
    from agents import ALGORITHMS

    for name, entry in ALGORITHMS.items():
        does_not_learn = entry.family in ("planning", "reference")
        if entry.for_bandits or does_not_learn or not entry.is_installed:
            continue
        yield Case(name, name, NOTHING)
        if "interpreted" in entry.engines:
            yield Case(f"{name} (interpreted)", name, NOTHING, None, (("engine", "interpreted"),))
        elif "compiled" in entry.engines:
            yield Case(f"{name} (compiled)", name, NOTHING, None, (("engine", "compiled"),))


def measure(case: Case, seed: int, n_seeds: int) -> dict[str, Any]:
    """One audit: what it said, and how long it took."""
    from diagnosis.audit import Verdict, audit
    from diagnosis.probes import Finding
    from diagnosis.subjects import ClassSubject, ScriptSubject, Subject, class_named

    started = time.process_time()
    agent = class_named(case.agent) if isinstance(case.agent, str) else case.agent
    kind = ClassSubject if isinstance(agent, type) else ScriptSubject
    try:
        subject: Subject = kind(case.name, agent, dict(case.params), case.kind)
        findings = tuple(audit(subject, range(seed, seed + n_seeds)))
    except UserError as error:
        findings = (Finding("begin", "unsaid", str(error)),)
    verdict = Verdict(case.name, findings)
    return {
        "name": case.name,
        "seed": seed,
        "fault": case.fault,
        "said": [finding.fault for finding in verdict.faults],
        "text": [finding.text for finding in verdict.faults],
        "unsaid": [f"{f.probe}: {f.text}" for f in verdict.findings if f.state == "unsaid"],
        "exit_code": verdict.exit_code,
        "seconds": round(time.process_time() - started, 1),
    }


def report(rows: list[dict[str, Any]]) -> str:
    """Markdown: planted faults and what was said of them; what is right, and what was said."""
    faulty = [row for row in rows if row["fault"] != NOTHING]
    right = [row for row in rows if row["fault"] == NOTHING]
    said: dict[str, Counter[str]] = defaultdict(Counter)
    times: dict[str, list[float]] = defaultdict(list)
    for row in faulty:
        answer = (
            row["said"][0]
            if row["said"]
            else ("right", "", "nothing can be said")[row["exit_code"]]
        )
        said[row["fault"]][answer] += 1
        times[row["fault"]].append(row["seconds"])
    named = sum(counter[fault] for fault, counter in said.items())
    files = [
        f"{stem}: {len({row['name'] for row in own})} agents, {len({row['seed'] for row in own})} "
        f"seeds, {sum(row['said'][:1] == [row['fault']] for row in own)} of {len(own)} audits"
        for stem in sorted({row["name"].partition(".")[0] for row in faulty})
        if (own := [row for row in faulty if row["name"].startswith(f"{stem}.")])
    ]
    lines = [
        (
            f"Of {len(faulty)} audits of {len({row['name'] for row in faulty})} agents with a "
            f"planted fault, {named} named it rightly ({named / max(len(faulty), 1):.0%}): "
            f"{'; '.join(files)}."
        ),
        "",
        "| planted | named so | other answers | processor time |",
        "| --- | --- | --- | --- |",
    ]
    for fault in sorted(said):
        others = {answer: n for answer, n in said[fault].items() if answer != fault}
        told = ", ".join(f"{answer}: {n}" for answer, n in others.items())
        total, slowest = sum(said[fault].values()), max(times[fault])
        lines += [f"| {fault} | {said[fault][fault]} of {total} | {told} | up to {slowest:.0f} s |"]
    alarms = sorted({row["name"] for row in right if row["said"]})
    unsaid = [f"`{row['name']}`" for row in right if row["exit_code"] == 2]
    lines += [
        "",
        (
            f"Of {len(right)} audits of {len({row['name'] for row in right})} agents that are "
            f"right, {sum(bool(row['said']) for row in right)} named a fault"
            f"{f' ({chr(44).join(alarms)})' if alarms else ''}. "
            f"{sum(row['exit_code'] == 0 for row in right)} were found right; nothing could be "
            f"said in {len(unsaid)}{f' ({chr(44).join(unsaid)})' if unsaid else ''}. An audit "
            f"took up to {max((row['seconds'] for row in right), default=0):.0f} s of processor "
            "time."
        ),
    ]
    return "\n".join(lines) + "\n"


def main() -> None:
    """Measure what is not measured yet, print it, and publish it where asked to."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").partition("\n")[0])
    parser.add_argument("folder", nargs="?", type=Path, default=PLANTED)
    parser.add_argument("--right", action="store_true", help="audit the shipped agents instead")
    parser.add_argument("--only", nargs="+", default=["*"], metavar="PATTERN")
    parser.add_argument("--seeds", type=int, default=5)
    parser.add_argument("--first-seed", type=int, default=0)
    parser.add_argument("--results", type=Path, default=RESULTS)
    parser.add_argument("--publish", action="store_true", help=f"write {MEASURED.name}")
    args = parser.parse_args()
    warnings.simplefilter("ignore")
    import torch as th

    th.set_num_threads(1)
    args.results.parent.mkdir(parents=True, exist_ok=True)
    rows = _read(args.results)
    done = {(row["name"], row["seed"]) for row in rows}
    cases = list(shipped()) if args.right else list(planted(args.folder))
    for seed in range(args.first_seed, args.first_seed + args.seeds):
        for case in cases:
            is_wanted = any(fnmatch(case.name, pattern) for pattern in args.only)
            if (case.name, seed) in done or not is_wanted:
                continue
            row = measure(case, seed, 3)
            rows.append(row)
            with args.results.open("a", encoding="utf-8") as file:
                file.write(json.dumps(row) + "\n")
            print(json.dumps(row), flush=True)
    text = report(rows)
    print(text)
    if args.publish:
        head = ["git", "rev-parse", "--short", "HEAD"]
        version = subprocess.run(head, cwd=ROOT, capture_output=True, text=True, check=True).stdout
        publish(
            MEASURED, f"{text}\nThe last of them was measured with version {version.strip()}.\n"
        )


def _read(path: Path) -> list[dict[str, Any]]:
    if not path.exists():
        return []
    rows = [json.loads(line) for line in path.read_text(encoding="utf-8").splitlines()]
    return list({(row["name"], row["seed"]): row for row in rows}.values())


if __name__ == "__main__":
    main()
