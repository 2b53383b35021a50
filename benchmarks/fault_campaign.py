"""Stops and kills trainings and studies at random moments, until they are done.

    python benchmarks/fault_campaign.py --kills 30       # a look, a minute or two
    python benchmarks/fault_campaign.py --kills 1000     # docs/run-folder.md: half an hour

Every agent is trained once undisturbed. Then the same command is started again and again, and gets
a signal at a moment drawn uniformly from its duration: SIGKILL, SIGTERM, SIGINT, or SIGINT twice.
When a process has finished, its files are compared bit for bit with those of the undisturbed run,
except for times and durations. After twenty signals it is left alone. The same is done with
studies, where the signal goes to the driver, a worker, or all processes, and with filming and
judging by a log, which start from the beginning.

It counts differing results, damaged files, orphaned processes, and files left behind. All counts
must be 0.
"""

from __future__ import annotations

import argparse
import os
import random
import signal
import subprocess
import sys
import tempfile
import time
from collections import Counter
from concurrent.futures import ThreadPoolExecutor
from functools import partial
from pathlib import Path

from rich.console import Console
from rich.table import Table

from _campaigns import Case, cases, send

SIGNALS = ("SIGKILL", "SIGTERM", "SIGINT", "SIGINT twice")
TARGETS = ("driver", "worker", "all")
MOST_STARTS = 200  # of one command, which should be done by then
MOST_SIGNALS = 20  # to one command, before it is left alone
LONGEST = 60  # seconds of a start, in addition to twenty times the undisturbed duration


def disturbed(case: Case, seed: int) -> int:
    """Run the command until it is done, with a signal each time; return the number of signals.

    Args:
        case: the command.
        seed: of the moments.
    """
    draw = random.Random(f"{case.name} {seed}")  # noqa: S311  # reproducible, not secret
    logs = case.folder_of(f"disturbed {seed}")
    signals = 0
    for _ in range(MOST_STARTS):
        process = case.start(logs)
        if signals < MOST_SIGNALS:
            try:
                process.wait(draw.uniform(0.0, case.seconds))
            except subprocess.TimeoutExpired:
                _disturb(case, process, draw)
                signals += 1
        code = _ended(case, process)
        case.counts["orphans"] += _orphans(process.pid)
        if "Traceback" in case.read_said():
            case.counts["tracebacks"] += 1
            print(f"{case.name}:\n{case.said}", file=sys.stderr)
        if code == 0:
            break
    else:
        case.counts["never done"] += 1
    _judge(case, logs)
    return signals


def _ended(case: Case, process: subprocess.Popen[str]) -> int:
    """The exit code; a command that hangs is killed, and `faulthandler` prints where."""
    try:
        return process.wait(LONGEST + 20 * case.seconds)
    except subprocess.TimeoutExpired:
        for pid in _group(process.pid):
            send(pid, signal.SIGABRT)
        case.counts["never done"] += 1
        process.wait()
        print(f"{case.name} hangs:\n{case.read_said()}", file=sys.stderr)
        return 0


def _disturb(case: Case, process: subprocess.Popen[str], draw: random.Random) -> None:
    how = draw.choice(SIGNALS)
    has_workers = case.words[0] == "compare.py" and not case.is_told
    target = draw.choice(TARGETS) if has_workers else "driver"
    pids = [process.pid] if target == "driver" else _group(process.pid)
    if target == "worker":
        workers = [pid for pid in pids if pid != process.pid] or [process.pid]
        pids, how = draw.sample(workers, 1), "SIGKILL"
    case.counts[how] += 1
    for pid in pids:
        send(pid, getattr(signal, how.partition(" ")[0]))
    if how == "SIGINT twice":
        time.sleep(draw.uniform(0.0, 1.0))
        send(process.pid, signal.SIGINT)


def _group(session: int) -> list[int]:
    """The running processes of a session, without zombies."""
    found = []
    for stat in Path("/proc").glob("[0-9]*/stat"):
        try:
            fields = stat.read_text().rpartition(")")[2].split()
        except OSError:
            continue
        if int(fields[3]) == session and fields[0] not in "ZX":
            found.append(int(stat.parent.name))
    return found


def _orphans(session: int) -> int:
    """The number of processes still running five seconds after the end of the started one."""
    until = time.monotonic() + 5.0
    while (left := _group(session)) and time.monotonic() < until:
        time.sleep(0.05)
    for pid in left:
        send(pid, signal.SIGKILL)
    return len(left)


def _judge(case: Case, logs: Path) -> None:
    """Compare the result of the disturbed command with that of the undisturbed one."""
    case.counts["done"] += 1
    try:
        found = case.result(logs)
    except Exception as error:  # noqa: BLE001  # of whatever kind: a damaged file
        case.counts["damaged files"] += 1
        print(f"{case.name}: {logs}: {error!r}", file=sys.stderr)
        return
    left, missing = found.keys() - case.whole.keys(), case.whole.keys() - found.keys()
    differing = [n for n in found.keys() & case.whole.keys() if found[n] != case.whole[n]]
    case.counts["files left"] += len(left)
    case.counts["differing results"] += bool(differing or missing)
    if left or missing or differing:
        print(f"{case.name}: {logs}: {left=} {missing=} {differing=}", file=sys.stderr)


ENDS = ("done", "differing results", "damaged files", "orphans", "files left", "tracebacks")


def table(found: list[Case]) -> Table:
    """The counts."""
    shown = Table("command", "s", "signals", *SIGNALS, *ENDS, "never done")
    totals: Counter[str] = Counter()
    for case in found:
        totals += case.counts
    for name, seconds, counts in [
        *((case.name, f"{case.seconds:.1f}", case.counts) for case in found),
        ("all", "", totals),
    ]:
        signals = sum(counts[how] for how in SIGNALS)
        cells = [counts[key] for key in (*SIGNALS, *ENDS, "never done")]
        shown.add_row(name, seconds, f"{signals:,}", *(f"{n:,}" for n in cells))
    return shown


def main() -> int:
    """Do the campaign; return 1 if a count is not 0."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").partition("\n")[0])
    parser.add_argument("--kills", type=int, default=30, help="signals in all, at least")
    parser.add_argument("--jobs", type=int, default=max((os.cpu_count() or 2) // 2, 1))
    parser.add_argument("--only", nargs="+", default=[], help="names of the commands to try")
    args = parser.parse_args()
    # A process started in the background ignores SIGINT, and its children would, too.
    signal.signal(signal.SIGINT, signal.default_int_handler)
    with tempfile.TemporaryDirectory(prefix="fault-campaign-") as folder:
        os.environ["XDG_CONFIG_HOME"] = str(Path(folder) / "config")
        found = cases(Path(folder))
        chosen = [case for case in found if case.name in args.only or not args.only]
        signals, seed = 0, 0
        with ThreadPoolExecutor(args.jobs) as pool:
            list(pool.map(Case.run_in_peace, chosen))
            while signals < args.kills:
                signals += sum(pool.map(partial(disturbed, seed=seed), chosen))
                seed += 1
                print(f"{signals:,} signals", flush=True)
                Console(width=180).print(table(chosen))
    bad = ("differing results", "damaged files", "orphans", "files left", "tracebacks")
    return int(any(case.counts[key] for case in chosen for key in (*bad, "never done")))


if __name__ == "__main__":
    sys.exit(main())
