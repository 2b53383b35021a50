r"""Is the change that an explanation proposes the one that wins? Counted over twenty runs.

    python benchmarks/explain_hits.py --publish

Ten runs are of agents with shipped settings that are not optimal, ten of agents that failed by a
known mistake: too low a discount, too few steps, too little exploration. Each run of seed 4 is
explained; then the proposal and the usual changes (`experiments.interventions`) are trained with
the seeds 0 to 3. A proposal hits where no change is better on average by over 5 % of the gap of the
runs as they are; where nothing is proposed, that is a hit if no change regains 5 % of that gap.
The result goes to docs/measured/explain-hits.json; what the explanations of the first ten say, to
docs/measured/why-not-optimal.json.
"""

from __future__ import annotations

import argparse
import json
import subprocess
import sys
import tempfile
from pathlib import Path
from typing import Any

ROOT = Path(__file__).resolve().parent.parent
MEASURED = ROOT / "docs" / "measured"
sys.path.append(str(ROOT / "docs" / "scripts"))

from measured_tables import publish  # noqa: E402

SEED = 4
MATTERS = 0.05  # of the gap

SHIPPED = [
    "--algo qlearning --env FrozenLake-v1",
    "--algo sarsa --env FrozenLake-v1",
    "--algo ppo --env FrozenLake-v1",
    "--algo qlearning --env FrozenLake8x8-v1",
    "--algo sarsa --env FrozenLake8x8-v1",
    "--algo dqn --env FrozenLake8x8-v1",
    "--algo ppo --env FrozenLake8x8-v1",
    "--algo sarsa --env CliffWalking-v1",
    "--algo ppo --env Taxi-v4",
    "--algo a2c --env FrozenLake-v1",
]
SLIPPING = "--env Warehouse-v0 --env-kwargs slip:0.1"
FAILED = [
    f"--algo qlearning {SLIPPING} -n 100000 -params gamma:0.99 learning_rate:0.1",
    f"--algo sarsa {SLIPPING} -n 100000 -params gamma:0.99 learning_rate:0.1",
    "--algo qlearning --env Warehouse-v0 -n 3000",
    "--algo sarsa --env Warehouse-v0 -params gamma:0.5",
    "--algo qlearning --env Taxi-v4 -n 5000",
    "--algo qlearning --env FrozenLake8x8-v1 -n 20000",
    "--algo qlearning --env MineMaze-v0 -n 2000",
    "--algo sarsa --env CliffWalking-v1 -n 500",
    "--algo dqn --env Warehouse-v0 -n 4000",
    "--algo ppo --env Taxi-v4 -n 50000",
]


def explained(words: str, folder: Path) -> dict[str, Any]:
    """What `explain.py --test` says of a run."""
    told = folder / "why.json"
    network = any(f"--algo {name} " in words for name in ("dqn", "ppo", "a2c"))
    engine = ["--engine", "auto"] if network else []
    train = [*words.split(), *engine, "--seed", str(SEED), "-f", str(folder), "--verbose", "0"]
    _run("train.py", *train)
    run = next(path for path in folder.glob("*/*_1") if path.is_dir())
    _run("explain.py", str(run), "-f", str(folder), "--test", "--json", str(told))
    return dict(json.loads(told.read_text(encoding="utf-8")))


def judged(words: str, found: dict[str, Any]) -> list[str]:
    """A row of the table: the run, its gap, what was proposed, what won, and whether they agree."""
    means = {one["change"]: sum(one["returns"]) / len(one["returns"]) for one in found["tried"]}
    as_it_is, optimum = means.pop("as it is"), found["optimum"]
    gap = optimum - as_it_is
    best = max(means, key=lambda change: means[change])
    proposal = found["proposal"]
    reached = as_it_is if proposal is None else means[proposal]
    is_hit = max(means[best], as_it_is) - reached <= MATTERS * gap
    regained = (means[best] - as_it_is) / gap if gap > 0 else 0.0
    return [
        f"`{words}`",
        f"{gap:.4g}",
        f"`{proposal}`" if proposal else "nothing",
        f"`{best}`, {regained:.0%} of the gap" if regained > MATTERS else "nothing",
        "yes" if is_hit else "no",
    ]


def where(words: str, found: dict[str, Any]) -> list[str]:
    """A row of the other table: the run, its gap and parts, the worst state and the repairs."""
    gap, own = found["gap"], found["gap_in_own_objective"]
    told = [(part["name"], f"{part['loss'] / gap:.0%}") for part in found["parts"]]
    parts = [f"{name} {share}" for name, share in told if share != "0%"]
    worst = found["states"][0]
    regained = [(one["return"] - found["return"]) / gap for one in found["repairs"]]
    return [
        f"`{words}`",
        f"{found['return']:.4g} of {found['optimum']:.4g}",
        f"{gap:.3g}",
        "" if own is None else f"{own:.3g}",
        ", ".join(parts),
        f"{worst['loss'] / gap:.0%}",
        f"{len(regained)}: {regained[-1]:.0%}" if regained else "none",
    ]


def _run(script: str, *words: str) -> None:
    command = [sys.executable, str(ROOT / script), *words]
    done = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, check=False)
    if done.returncode not in (0, 1):
        raise SystemExit(f"{script} {' '.join(words)}:\n{done.stderr}")


def as_markdown(headings: list[str], rows: list[list[str]]) -> str:
    """A table."""
    lines = [headings, ["---"] * len(headings), *rows]
    return "\n".join([*("| " + " | ".join(line) + " |" for line in lines), ""])


def hits(rows: list[list[str]]) -> str:
    """How many rows are hits."""
    won = [row for row in rows if row[3] != "nothing"]
    n_hits, n_won = (sum(row[-1] == "yes" for row in some) for some in (rows, won))
    return (
        f"In {len(won)} of {len(rows)} runs some change regained more than 5 % of the gap; the "
        f"proposal was as good as the best of them in {n_won}. All in all {n_hits} of {len(rows)} "
        "proposals hit."
    )


def main() -> None:
    """Judge all runs, and print the tables."""
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("--publish", action="store_true", help="write the pages in docs/measured")
    args = parser.parse_args()
    rows, places = [], []
    for words in (*SHIPPED, *FAILED):
        with tempfile.TemporaryDirectory() as folder:
            found = explained(words, Path(folder))
        rows.append(judged(words, found))
        places.append(where(words, found))
        print(" | ".join(rows[-1]), flush=True)
    headings = ["run of seed 4", "mean gap, seeds 0 to 3", "proposed", "won", "hit"]
    pages = {"explain-hits.json": f"{hits(rows)}\n\n{as_markdown(headings, rows)}"}
    headings = ["run of seed 4", "return", "gap", "in its own objective", "parts of the gap"]
    headings += ["worst state", "states to mend, and what that regains"]
    pages["why-not-optimal.json"] = as_markdown(headings, places[: len(SHIPPED)])
    for name, text in pages.items():
        print(text)
        if args.publish:
            publish(MEASURED / name, text)


if __name__ == "__main__":
    main()
