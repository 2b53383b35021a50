"""Trains what every documented command trains, over seeds that were not used for tuning.

    python benchmarks/documented_commands.py --results found.json     # about an hour on one core
    python benchmarks/documented_commands.py --results found.json --only cliff --again
    python benchmarks/documented_commands.py --results found.json --fill

Trainings are collected from the text, see docs/scripts/recommended_commands.py, and done one after
another in this process, with ``--engine auto`` and the seeds 1000 to 1019. There are fewer seeds if
they take longer than ``--limit`` seconds, and one for deterministic planners. Results are saved in
the file at once, and not done again. ``--fill`` writes them into docs/documented-commands.json, and
beside the commands of all pages.

With ``PYTHONPATH=OLDER_CHECKOUT`` the same trainings are done with an older version.
"""

from __future__ import annotations

import argparse
import json
import os
import re
import shlex
import statistics
import sys
import tempfile
import time
from pathlib import Path
from typing import Any

ROOT = Path(__file__).resolve().parent.parent
sys.path.append(str(ROOT / "docs" / "scripts"))

from recommended_commands import RESULTS, trainings, with_outcomes  # noqa: E402

SEEDS = range(1000, 1020)
FEWEST = 5
REACHED = 0.9
OPTIMAL = 0.01
PLANNERS = {"optimal", "value_iteration", "policy_iteration"}


def prepared_folder(folder: Path) -> None:
    """Make the files that pages tell their readers to make."""
    from rl_yardstick.envs.bandits import log_uniformly

    page = (ROOT / "docs" / "own-map.md").read_text(encoding="utf-8")
    found = re.search(r"```\n(S.*?)```", page, re.DOTALL)
    assert found is not None
    (folder / "map.txt").write_text(found[1], encoding="utf-8")
    import gymnasium as gym

    with gym.make("SegmentBandit-v0") as env:
        log_uniformly(env, 5000, seed=0, path=str(folder / "train.csv"))


def outcome(training: str, seed: int, folder: Path) -> dict[str, Any]:
    """The results of one run: its return, its score if there is one, and its processor time."""
    from rl_yardstick.commands.train import build_parser, spec_from_flags
    from rl_yardstick.pipeline.run import Run
    from rl_yardstick.pipeline.training import train

    words = [*shlex.split(training), "--seed", str(seed), "--verbose", "0", "-f", str(folder)]
    parser = build_parser()
    args = parser.parse_args(words)
    if "engine" in args:
        args.engine = "auto"
    spec = spec_from_flags(args).changed(pictures=False)
    before = time.process_time()
    with Run.claim(folder, spec) as run:
        train(spec, run)
    spent = time.process_time() - before
    info = run.recorded()
    final = info["final"] or {}
    return {
        "return": final.get("mean_return"),
        "score": final.get("score"),
        "bracketed": "optimum_at_least" in final,
        "gap": final.get("gap"),
        "regret": info.get("regret"),
        "seconds": info["cpu_seconds"],
        "whole": spent,
    }


def measure(training: str, limit: float, folder: Path) -> list[dict[str, Any]]:
    """Do one run after another, until all seeds are done or the time limit is exceeded."""
    agent = training.split()[3]
    runs: list[dict[str, Any]] = []
    for seed in SEEDS[:1] if agent in PLANNERS else SEEDS:
        runs.append({"seed": seed, **outcome(training, seed, folder)})
        if len(runs) >= FEWEST and sum(run["whole"] for run in runs) > limit:
            break
    return runs


def row(training: str, runs: list[dict[str, Any]]) -> dict[str, Any]:
    """The number of solved runs, the median result, and the median processor time."""
    solved = n_solved(training, runs)
    # If a constant policy is optimal, the score is meaningless.
    no_score = any(abs(r["score"] or 0) > 10 or (_is_optimal(r) and r["score"] <= 0) for r in runs)
    names = ("return", "regret") if no_score else ("score", "return", "regret")
    kind = next((name for name in names if all(run[name] is not None for run in runs)), None)
    reached = f"{statistics.median(run[kind] for run in runs):.3g}" if kind else ""
    reached += "" if kind in ("score", None) else f" ({kind})"
    return {
        "solved": "" if solved is None else f"{solved} of {len(runs)}",
        "median": reached,
        "seconds": float(f"{statistics.median(run['seconds'] for run in runs):.2g}"),
    }


def _is_optimal(run: dict[str, Any]) -> bool:
    gap = run.get("gap")
    return gap is not None and gap <= OPTIMAL * abs(run["return"] + gap)


def n_solved(training: str, runs: list[dict[str, Any]]) -> int | None:
    """How many runs reach a score of 0.9 or, if the optimum is not known, the threshold."""
    import gymnasium as gym

    import rl_yardstick.envs  # noqa: F401

    if all(run["score"] is not None and not run["bracketed"] for run in runs):
        # If the best constant policy is optimal, the score is meaningless.
        return len([r for r in runs if r["score"] >= REACHED or _is_optimal(r)])
    threshold = gym.spec(training.split()[1]).reward_threshold
    if threshold is None or any(run["return"] is None for run in runs):
        return None
    return len([run for run in runs if run["return"] >= threshold])


def fill(found: dict[str, Any]) -> None:
    """Write the results of all trainings still recommended, also beside the commands."""
    before = json.loads(RESULTS.read_text(encoding="utf-8"))
    rows = {one: row(one, found[one]) if one in found else before.get(one) for one in trainings()}
    lines = [f"{json.dumps(one)}: {json.dumps(each)}" for one, each in rows.items() if each]
    RESULTS.write_text("{\n" + ",\n".join(lines) + "\n}\n", encoding="utf-8")
    for page in RESULTS.parent.rglob("*.md"):
        page.write_text(with_outcomes(page.read_text(encoding="utf-8")), encoding="utf-8")


def main() -> None:
    """Do missing trainings and save their results, or fill the pages."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawTextHelpFormatter
    )
    parser.add_argument("--results", type=Path, required=True, metavar="FILE")
    parser.add_argument("--only", default="", metavar="REGEX", help="trainings that match")
    parser.add_argument("--again", action="store_true", help="also trainings that are in the file")
    parser.add_argument(
        "--limit", type=float, default=120, metavar="S", help="for one training (120)"
    )
    parser.add_argument("--fill", action="store_true", help="write pages; nothing is run")
    args = parser.parse_args()
    found = json.loads(args.results.read_text()) if args.results.exists() else {}
    if args.fill:
        fill(found)
        return
    results = args.results.resolve()
    with tempfile.TemporaryDirectory() as name:
        os.chdir(name)
        prepared_folder(Path(name))
        for training in trainings():
            if re.search(args.only, training) and (args.again or training not in found):
                runs = measure(training, args.limit, Path(name) / "logs")
                # Another process may have added to the file.
                found = json.loads(results.read_text()) if results.exists() else {}
                results.write_text(json.dumps({**found, training: runs}, indent=1))
                print(training, *row(training, runs).values(), sep=" | ", flush=True)


if __name__ == "__main__":
    main()
