"""What share of a training's time its evaluations take, where they are sampled.

    python benchmarks/evaluation_share.py                  # as typed, some twenty minutes
    python benchmarks/evaluation_share.py -n 20000         # so many steps of each
    python benchmarks/evaluation_share.py --env CartPole-v1 --work "a2c, compiled" qlearning

Each training is a process of its own: settings from our files, the budget too unless ``-n`` says
another, and no flag for evaluation. Times are of processors. Evaluations go by steps, so that the
same seed gives the same files on any machine; what they take of the time is what is shown here.
"""

from __future__ import annotations

import argparse
import json
import subprocess
import sys
import tempfile
from pathlib import Path

from rich.console import Console
from rich.table import Table

ROOT = Path(__file__).resolve().parent.parent
ENVIRONMENTS = ("CartPole-v1", "MountainCar-v0", "Acrobot-v1", "Pendulum-v1")
COMPILED = ("-params", "engine:compiled")
WORK: dict[str, tuple[str, ...]] = {
    "ppo": ("--algo", "ppo"),
    "ppo, compiled": ("--algo", "ppo", *COMPILED),
    "dqn": ("--algo", "dqn"),
    "dqn, compiled": ("--algo", "dqn", *COMPILED),
    "a2c": ("--algo", "a2c"),
    "a2c, compiled": ("--algo", "a2c", *COMPILED),
    "qlearning": ("--algo", "qlearning"),
    "semi_gradient_sarsa": ("--algo", "semi_gradient_sarsa"),
}
# In a process of its own: the command's flags, and what the outcome says that no file does.
TRAINING = """
import json
from rich.console import Console
from commands.train_flags import build_parser
from commands.train_request import train_spec
from pipeline import training
during = []
finish = training._finish
def noted(made, *rest):
    during.append(made.evaluation.taken)  # the last evaluation is still to come
    return finish(made, *rest)
training._finish = noted
spec = train_spec(build_parser().parse_args())
done = training.train(spec, Console(quiet=True), {}, "")
print(json.dumps({
    "steps": done.n_steps,
    "evaluation_steps": done.evaluation_steps,
    "training": (done.taken - during[0]).cpu_seconds,
    "evaluating": done.evaluating.cpu_seconds,
}))
"""


def trained(env_id: str, work: str, n: int | None) -> dict[str, float] | None:
    """What one training has taken; None where such an agent does not fit the environment."""
    budget = () if n is None else ("-n", str(n))
    with tempfile.TemporaryDirectory() as folder:
        flags = ("--env", env_id, *WORK[work], *budget, "--seed", "0", "-f", folder)
        command = [sys.executable, "-c", TRAINING, *flags, "--num-threads", "1"]
        done = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, check=False)
    if done.returncode:
        print(f"{work} on {env_id}: {done.stderr.strip().splitlines()[-1]}", file=sys.stderr)
        return None
    found: dict[str, float] = json.loads(done.stdout.splitlines()[-1])
    return found


def main() -> None:
    """Train, and print the shares."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").partition("\n")[0])
    parser.add_argument("-n", type=int, help="environment steps of each, instead of its own")
    parser.add_argument("--env", nargs="+", default=ENVIRONMENTS)
    parser.add_argument("--work", nargs="+", default=list(WORK), choices=list(WORK))
    args = parser.parse_args()
    table = Table(
        "environment",
        "agent",
        "steps",
        "evaluation's steps",
        "training, s",
        "evaluating, % of that",
    )
    for env_id in args.env:
        for work in args.work:
            found = trained(env_id, work, args.n)
            if found is not None:
                table.add_row(env_id, work, *_cells(found))
    Console(width=110).print(table)


def _cells(found: dict[str, float]) -> tuple[str, ...]:
    return (
        f"{found['steps']:,.0f}",
        f"{found['evaluation_steps']:,.0f}",
        f"{found['training']:.1f}",
        f"{100 * found['evaluating'] / found['training']:.1f}",
    )


if __name__ == "__main__":
    main()
