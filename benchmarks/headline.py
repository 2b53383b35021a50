r"""Fills the headline study's tables into README.md and docs/library-vs-hand-rolled.md.

    python compare.py studies/library-vs-hand-rolled.yml
    python compare.py studies/library-vs-hand-rolled.yml --first-seed 1000 --name held-out
    python benchmarks/headline.py --tuned logs/studies/library-vs-hand-rolled \
        --held-out logs/studies/held-out

Nothing is run: the studies are read where they lie, and judged anew. What stands between a pair
of comments such as ``<!-- headline: held-out -->`` and ``<!-- end -->`` is replaced. Without one of
the studies, the blocks that need it stay as they are.
"""

from __future__ import annotations

import argparse
import re
import sys
from collections.abc import Iterator, Mapping
from dataclasses import replace
from pathlib import Path

from experiments.analysis import AgentAnalysis, EnvironmentAnalysis, StudyAnalysis, analyse
from experiments.plan import plan
from experiments.results import read_results
from experiments.study import read_study
from report.conclusions import conclusion
from report.documents import headline, markdown_text, name_of, table_as
from report.words import spans

ROOT = Path(__file__).resolve().parent.parent
STUDY = ROOT / "studies" / "library-vs-hand-rolled.yml"
PAGES = (ROOT / "README.md", ROOT / "docs" / "library-vs-hand-rolled.md")
BLOCK = re.compile(r"(<!-- headline: ([\w-]+) -->\n).*?(<!-- end -->)", re.DOTALL)
MATTERS = 0.02  # of the score, as the verdicts have it


def judged(root: Path) -> StudyAnalysis:
    """The study in a folder, with the seeds of whatever runs are there."""
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


def verdicts(analysis: StudyAnalysis) -> str:
    """What is said of each environment."""
    parts = []
    for environment in analysis.environments:
        said = conclusion(analysis.study, environment).everything
        parts.append(f"**{markdown_text(environment.environment)}**\n")
        parts.append("\n".join(f"- {markdown_text(text)}" for text in said) + "\n")
    return "\n".join(parts)


def what_fell(tuned: StudyAnalysis, held_out: StudyAnalysis) -> str:
    """By agent, failures and mean scores of both studies, and where typical runs differ."""
    spans_of = [spans(one.study.seeds) for one in (tuned, held_out)]
    headings = ["", *(f"{what}, seeds {s}" for what in ("failed", "mean score") for s in spans_of)]
    rows = [
        [
            name_of(agent.label),
            *(_failed(one, agent.label) for one in (tuned, held_out)),
            *(_mean_score(one, agent.label) for one in (tuned, held_out)),
        ]
        for agent in tuned.study.agents
    ]
    changes = [f"- {text}" for text in _changes(tuned, held_out)]
    told = changes or [f"No agent's median run changed by more than {MATTERS} of the score."]
    table = ["| " + " | ".join(row) + " |" for row in [headings, ["---"] * len(headings), *rows]]
    return "\n".join([*table, "", *told, ""])


def _failed(analysis: StudyAnalysis, agent: str) -> str:
    counts = [e.failures[agent] for e in analysis.environments if agent in e.failures]
    return f"{sum(c.n_failed for c in counts)} of {sum(c.n for c in counts)}"


def _mean_score(analysis: StudyAnalysis, agent: str) -> str:
    table = analysis.results.summary
    scores = table[table["agent"] == agent].groupby("environment")["score"].mean()
    return f"{scores.mean():.3f}"


def _changes(tuned: StudyAnalysis, held_out: StudyAnalysis) -> Iterator[str]:
    """Where the median run, or the number of failures, is another on the other seeds."""
    for environment in tuned.environments:
        others = {e.environment: e for e in held_out.environments}
        now = others.get(environment.environment)
        for agent in environment.agents:
            after = None if now is None else _agent(now, agent.agent)
            if now is None or after is None or agent.score is None or after.score is None:
                continue
            medians = agent.score.median.point, after.score.median.point
            failed = [e.failures[agent.agent].n_failed for e in (environment, now)]
            if abs(medians[0] - medians[1]) > MATTERS or failed[0] != failed[1]:
                yield (
                    f"{name_of(agent.agent)} on {markdown_text(environment.environment)}: median "
                    f"{medians[0]:.3f} and {failed[0]} failed, "
                    f"then {medians[1]:.3f} and {failed[1]}"
                )


def _agent(environment: EnvironmentAnalysis, label: str) -> AgentAnalysis | None:
    return next((agent for agent in environment.agents if agent.agent == label), None)


def filled(page: str, blocks: Mapping[str, str]) -> str:
    """The page with what stands in its blocks replaced, as far as they are given."""

    def put(found: re.Match[str]) -> str:
        text = blocks.get(found[2])
        return found[0] if text is None else f"{found[1]}{text.rstrip()}\n{found[3]}"

    return BLOCK.sub(put, page)


def main() -> None:
    """Read what is given, and fill the pages."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--tuned", type=Path, metavar="FOLDER", help="of seeds 0 to 9")
    parser.add_argument("--held-out", type=Path, metavar="FOLDER", help="of seeds 1000 to 1009")
    args = parser.parse_args()
    studies = {
        name: judged(root)
        for name, root in (("tuned", args.tuned), ("held-out", args.held_out))
        if root is not None
    }
    blocks = {name: table_as("md", headline(analysis)) for name, analysis in studies.items()}
    blocks |= {f"verdicts-{name}": verdicts(analysis) for name, analysis in studies.items()}
    if len(studies) == 2:
        blocks["what-fell"] = what_fell(studies["tuned"], studies["held-out"])
    for path in PAGES:
        path.write_text(filled(path.read_text(encoding="utf-8"), blocks), encoding="utf-8")
        print(f"filled {path}")


if __name__ == "__main__":
    main()
