r"""Fills the headline study's table into docs, and writes its runs as docs/measured/held-out.csv.

    python compare.py studies/library-vs-hand-rolled.yml --first-seed 1000 --name held-out
    python benchmarks/headline.py logs/studies/held-out
    python docs/scripts/draw_images.py dots

Nothing is run. The text of the page between the comments ``<!-- headline: held-out -->`` and
``<!-- end -->`` is replaced.
"""

from __future__ import annotations

import argparse
import re
import sys
from dataclasses import replace
from pathlib import Path

import pandas as pd

from rl_yardstick.experiments.analysis import StudyAnalysis, analyse
from rl_yardstick.experiments.plan import plan
from rl_yardstick.experiments.results import read_results
from rl_yardstick.experiments.study import read_study
from rl_yardstick.report.documents import headline, table_as

ROOT = Path(__file__).resolve().parent.parent
STUDY = ROOT / "studies" / "library-vs-hand-rolled.yml"
PAGE = ROOT / "docs" / "library-vs-hand-rolled.md"
RUNS = ROOT / "docs" / "measured" / "held-out.csv"
BLOCK = re.compile(r"(?<=<!-- headline: held-out -->\n).*?(?=<!-- end -->)", re.DOTALL)


def judged(root: Path) -> StudyAnalysis:
    """The study in a folder, with the seeds of the runs that are there."""
    numbers = [
        int(path.name.rpartition("_")[2]) for path in root.glob("runs/*/*_*") if path.is_dir()
    ]
    if not numbers:
        raise SystemExit(f"{root}: there are no runs")
    first = min(numbers) - 1
    study = replace(read_study(STUDY), first_seed=first, n_seeds=max(numbers) - first)
    planned = plan(study, root)
    analysis = analyse(read_results(study, planned, root))
    there = len(analysis.results.summary)
    if there < len(planned):
        print(f"{root}: {there} of {len(planned)} runs are there", file=sys.stderr)
    return analysis


def runs_of(analysis: StudyAnalysis) -> pd.DataFrame:
    """A row for each run: its score in [0, 1], its seconds, 1 if it failed or was trained apart."""
    table = analysis.results.summary[["environment", "agent", "seed", "score", "cpu_seconds"]]
    scores = table["score"].astype(float).clip(0, 1)
    places = analysis.environments
    threshold = table["environment"].map({one.environment: one.failure_threshold for one in places})
    changed = {(one.environment, a.agent) for one in places for a in one.agents if a.changes}
    pairs = zip(table["environment"], table["agent"], strict=True)
    failed = (scores < threshold.astype(float)).astype(int)
    is_changed = [int(pair in changed) for pair in pairs]
    return table.assign(score=scores.round(5), failed=failed, changed=is_changed)


def main() -> None:
    """Read the study, fill the page, and write the runs."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("study", type=Path, metavar="FOLDER", help="the study's folder")
    analysis = judged(parser.parse_args().study)
    table = table_as("md", headline(analysis)).rstrip() + "\n"
    PAGE.write_text(BLOCK.sub(lambda _: table, PAGE.read_text("utf-8")), "utf-8")
    runs_of(analysis).to_csv(RUNS, index=False, lineterminator="\n")
    print(f"filled {PAGE}, wrote {RUNS}")


if __name__ == "__main__":
    main()
