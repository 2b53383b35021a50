"""What saving the state of a training costs, as often as is done by default.

    python benchmarks/state_cost.py    # a few minutes

The time inside `StateSaver.save` over that of the training, evaluations included, compiling not.
"""

from __future__ import annotations

import tempfile
import time
from pathlib import Path
from typing import Any

from rich.console import Console
from rich.table import Table

from pipeline.resuming.state_saver import StateSaver
from pipeline.settings.hyperparam_entries import override, read_hyperparams
from pipeline.settings.hyperparams import split
from pipeline.train_spec import TrainSpec
from pipeline.training import train

CASES: tuple[tuple[str, str, int, dict[str, Any]], ...] = (
    ("Warehouse-v0", "qlearning", 30_000_000, {"engine": "compiled"}),
    ("Warehouse-v0", "qlearning", 400_000, {"engine": "interpreted"}),
    ("CartPole-v1", "dqn", 30_000, {}),
    ("CartPole-v1", "ppo", 60_000, {}),
    ("Pendulum-v1", "sac", 3000, {"buffer_size": 1_000_000}),
)


def main() -> None:
    """Train each case once and print the table."""
    table = Table("case", "states", "ms per state", "MB", "share of the time")
    saved: list[tuple[float, int]] = []
    save = StateSaver.save

    def timed(self: StateSaver) -> None:
        begun = time.perf_counter()
        save(self)
        seconds = time.perf_counter() - begun
        files = self.run.state_path.glob("*.state")
        saved.append((seconds, max((path.stat().st_size for path in files), default=0)))

    StateSaver.save = timed  # type: ignore[method-assign]
    for env_id, algo, steps, settings in CASES:
        saved.clear()
        raw = override({**read_hyperparams(algo, env_id, None), "n_timesteps": steps}, settings)
        raw.pop("n_episodes", None)
        with tempfile.TemporaryDirectory() as folder:
            spec = TrainSpec(
                algo,
                env_id,
                split(raw),
                raw,
                seed=1,
                log_folder=Path(folder),
                verbose=0,
                pictures=False,
            )
            outcome = train(spec, Console(quiet=True), {}, "")
        total, n = sum(seconds for seconds, _ in saved), max(len(saved), 1)
        largest = max((size for _, size in saved), default=0) / 1e6
        name = f"{algo} {settings.get('engine', '')} on {env_id}"
        share = f"{total / outcome.taken.seconds:.2%}"
        table.add_row(name, str(len(saved)), f"{1000 * total / n:.1f}", f"{largest:.2f}", share)
    Console().print(table)


if __name__ == "__main__":
    main()
