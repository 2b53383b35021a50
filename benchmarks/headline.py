r"""Fills the headline study's tables into README.md and docs/library-vs-hand-rolled.md.

    python compare.py studies/library-vs-hand-rolled.yml --first-seed 1000 --name held-out
    python benchmarks/headline.py logs/studies/held-out

Nothing is run: the program reads the finished study, and judges it again. It replaces the text
between pairs of comments such as ``<!-- headline: held-out -->`` and ``<!-- end -->``.
"""

from __future__ import annotations

import argparse
import re
import sys
from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path

from rl_yardstick.experiments.analysis import StudyAnalysis, analyse
from rl_yardstick.experiments.plan import plan
from rl_yardstick.experiments.results import read_results
from rl_yardstick.experiments.study import read_study
from rl_yardstick.report.documents import headline, table_as

ROOT = Path(__file__).resolve().parent.parent
STUDY = ROOT / "studies" / "library-vs-hand-rolled.yml"
PAGES = (ROOT / "README.md", ROOT / "docs" / "library-vs-hand-rolled.md")
BLOCK = re.compile(r"(<!-- headline: ([\w-]+) -->\n).*?(<!-- end -->)", re.DOTALL)


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


def filled(page: str, blocks: Mapping[str, str]) -> str:
    """The page with the given blocks replaced."""

    def put(found: re.Match[str]) -> str:
        text = blocks.get(found[2])
        return found[0] if text is None else f"{found[1]}{text.rstrip()}\n{found[3]}"

    return BLOCK.sub(put, page)


def main() -> None:
    """Read the study, and fill the pages."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("study", type=Path, metavar="FOLDER", help="the study's folder")
    analysis = judged(parser.parse_args().study)
    blocks = {"held-out": table_as("md", headline(analysis))}
    for path in PAGES:
        path.write_text(filled(path.read_text(encoding="utf-8"), blocks), encoding="utf-8")
        print(f"filled {path}")


if __name__ == "__main__":
    main()
