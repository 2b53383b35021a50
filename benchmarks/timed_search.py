"""Compares tune.py with plain Optuna and with rl_zoo3's -optimize, with equal processor time.

    python benchmarks/timed_search.py --env MountainCar-v0 --algo dqn -n 60000 --seconds 180

Each contender searches several times, with other seeds each time. What it proposes is trained again
on seeds that no search has seen, all with ``--engine compiled``, and judged by the final policy's
return. tune.py has its re-test within the budget: its search ends after ``SEARCH_SHARE`` of it. It
proposes the shipped settings if nothing is shown to be better. The others propose their best trial,
train with Stable-Baselines3, and have rl_zoo3's ranges; Optuna's search is that of many tutorials.

The processor time is that of training and evaluation alone, and not of loading the libraries. What
each search really took stands in the table: a trial that has begun ends.
"""

from __future__ import annotations

import argparse
import json
import os
import signal
import subprocess
import sys
import time
from collections.abc import Sequence
from pathlib import Path

from tests.peers.peer_environment import peer_python

ROOT = Path(__file__).resolve().parent.parent
SEARCH_SHARE = 0.5
FIRST_UNSEEN = 2000
ENVIRON = {**os.environ, "OMP_NUM_THREADS": "1", "PYTHONPATH": str(ROOT)}


def processor_seconds(root: Path) -> float:
    """What the runs in a folder have taken that have ended."""
    files = root.glob("runs/*/*/run.json")
    return sum(json.loads(path.read_text()).get("cpu_seconds") or 0.0 for path in files)


def run(words: Sequence[object], root: Path = ROOT, budget: float = float("inf")) -> None:
    """Run a command of the project until it ends, or the runs in a folder have taken a budget."""
    command = [sys.executable, *map(str, words)]
    with subprocess.Popen(
        command, cwd=ROOT, env=ENVIRON, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL
    ) as child:
        while child.poll() is None:
            if processor_seconds(root) > budget:
                child.send_signal(signal.SIGTERM)
                budget = float("inf")
            time.sleep(0.2)


def tuned(args: argparse.Namespace, number: int, folder: Path) -> tuple[Path | None, float, int]:
    """A search of tune.py: the winner's file, its processor time and its number of trials."""
    first = 100 * number
    words: list[object] = ["tune.py", "--env", args.env, "--algo", args.algo]
    words += ["-n", args.n_timesteps, "--engine", "compiled", "--trials", 1000]
    words += ["--seed", number, "--first-seed", first]
    words += ["--seeds-per-trial", 3, "--n-startup-trials", 5, "--retest", 2, "--retest-seeds", 8]
    words += ["--eval-freq", args.n_timesteps // 2]  # as often as the others
    words += ["-j", 1, "--no-report", "-f", folder, "--name", f"tune-{number}"]
    root = folder / f"tune-{number}"
    run(words, root, SEARCH_SHARE * args.seconds)
    run([*words, "--timeout", "1s"])
    taken = processor_seconds(root) + processor_seconds(root / "retest")
    record = json.loads((folder / f"tune-{number}" / "tuning.json").read_text())
    n_trials = sum(trial["state"] in ("complete", "pruned") for trial in record["trials"])
    winner = folder / f"tune-{number}" / "winner.yml"
    return winner if winner.exists() else None, taken, n_trials


def searched_by_peer(
    args: argparse.Namespace, contender: str, number: int, folder: Path
) -> tuple[Path | None, float, int]:
    """The same of another program, in the environment of the peers."""
    place = folder / f"{contender}-{number}"
    place.mkdir()
    file = place / "best.yml"
    words = [args.env, args.algo, args.n_timesteps, args.n_envs, 100 * number, args.seconds, file]
    command = [peer_python(), str(ROOT / "benchmarks/peer_search.py"), contender, *map(str, words)]
    done = subprocess.run(
        command, cwd=place, env=ENVIRON, capture_output=True, text=True, check=False
    )
    if done.returncode:
        raise RuntimeError(f"{contender} failed:\n{done.stdout}{done.stderr}")
    taken, n_trials = done.stdout.split()[-2:]
    return file if file.exists() else None, float(taken), int(n_trials)


def returns(args: argparse.Namespace, name: str, file: Path | None, folder: Path) -> str:
    """Mean, lowest and highest return of settings on unseen seeds; None are the shipped ones."""
    import pandas as pd
    import yaml

    if not (folder / name).exists():
        study = {
            "title": name,
            "environments": [args.env],
            "agents": [args.algo],
            "seeds": {"first": FIRST_UNSEEN, "count": args.seeds},
            "eval_freq": args.n_timesteps,  # what judges a run comes after it
        }
        asked = folder / f"{name}.yml"
        asked.write_text(yaml.safe_dump(study))
        words: list[object] = ["compare.py", asked, "-n", args.n_timesteps, "-j", 1]
        words += ["--engine", "compiled", "--no-report", "--name", name, "-f", folder]
        run([*words, *(() if file is None else ("--conf-file", file))])
    final = pd.read_csv(folder / name / "summary.csv")["final"]
    assert len(final) == args.seeds, f"{name}: {len(final)} of {args.seeds} runs"
    return f"{final.mean():.3g} | {final.min():.3g} to {final.max():.3g}"


def main() -> int:
    """Do the searches, judge what they propose, and print a table."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawTextHelpFormatter
    )
    add = parser.add_argument
    add("--env", default="CartPole-v1", help="an environment of Gymnasium")
    add("--algo", default="ppo", choices=("dqn", "ppo"))
    add("-n", "--n-timesteps", type=int, default=6000, metavar="N", help="steps of a run")
    add("--n-envs", type=int, default=8, metavar="N", help="environments of the others' runs")
    add("--seconds", type=int, default=40, help="processor time of each search")
    add("--searches", type=int, default=3, help="searches of each contender")
    add("--seeds", type=int, default=20, help="unseen seeds that judge")
    add(
        "--folder", type=Path, default=Path("logs/timed-search"), help="for runs, which must be new"
    )
    args = parser.parse_args()
    args.folder.mkdir(parents=True)
    folder = args.folder.resolve()
    print(f"{args.algo} on {args.env}, {args.n_timesteps:,} steps, {args.seconds} s a search\n")
    print("| contender | search | processor time | trials | proposes | mean | range |")
    print("|---" * 7 + "|")
    print(f"| shipped | | | | | {returns(args, 'shipped', None, folder)} |", flush=True)
    for number in range(args.searches):
        for name in ("tune.py", "Optuna", "rl_zoo3"):
            search = (
                tuned(args, number, folder)
                if name == "tune.py"
                else searched_by_peer(args, name, number, folder)
            )
            file, taken, n_trials = search
            judged = f"{name.removesuffix('.py')}-judged-{number}" if file else "shipped"
            found = returns(args, judged, file, folder)
            what = "the shipped settings" if file is None else "a trial"
            print(f"| {name} | {number} | {taken:.0f} s | {n_trials} | {what} | {found} |")
            sys.stdout.flush()
    return 0


if __name__ == "__main__":
    sys.exit(main())
