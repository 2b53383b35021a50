"""What saving the state of a training costs, as often as is done by default.

    python benchmarks/state_cost.py    # a few minutes

Processor time inside `StateSaver.save` over that of the process since the training's first step,
evaluations included: when the first state had been saved, and when the training was over. States
are due by processor time here, so that what else the machine does changes nothing.
"""

from __future__ import annotations

import tempfile
import time
from pathlib import Path
from types import SimpleNamespace
from typing import Any

from rich.console import Console
from rich.table import Table

from pipeline import state_saver
from pipeline.agent_settings import resolved_spec
from pipeline.settings.hyperparams import override, read_hyperparams
from pipeline.state_saver import StateSaver
from pipeline.training import train

CASES: tuple[tuple[str, str, int, dict[str, Any]], ...] = (
    ("Warehouse-v0", "qlearning", 30_000_000, {"engine": "compiled"}),
    ("Warehouse-v0", "qlearning", 400_000, {"engine": "interpreted"}),
    ("CartPole-v1", "dqn", 30_000, {}),
    ("CartPole-v1", "ppo", 60_000, {}),
    ("Pendulum-v1", "sac", 3000, {"buffer_size": 1_000_000}),
)


Saved = list[tuple[float, float, int]]


def watched(saved: Saved, started: list[float]) -> None:
    """Let the saver note when it began, and of each state what it took and when it was over."""
    save, start = StateSaver.save, StateSaver._on_training_start

    def timed(self: StateSaver) -> None:
        begun = time.process_time()
        save(self)
        ended = time.process_time()
        files = self.run.state_path.glob("*.state")
        size = max((path.stat().st_size for path in files), default=0)
        saved.append((ended - begun, ended - started[0], size))

    def noted(self: StateSaver) -> None:
        start(self)
        started[0] = time.process_time()

    clock = SimpleNamespace(monotonic=time.process_time)
    state_saver.time = clock  # type: ignore[attr-defined,assignment]
    StateSaver.save = timed  # type: ignore[method-assign]
    StateSaver._on_training_start = noted  # type: ignore[method-assign]


def main() -> None:
    """Train each case once and print the table."""
    table = Table("case", "states", "ms, the first", "ms, each", "MB", "share at first", "in all")
    saved: Saved = []
    started = [0.0]
    watched(saved, started)
    for env_id, algo, steps, settings in CASES:
        saved.clear()
        raw = override({**read_hyperparams(algo, env_id, None), "n_timesteps": steps}, settings)
        raw.pop("n_episodes", None)
        with tempfile.TemporaryDirectory() as folder:
            spec = resolved_spec(
                raw,
                algo=algo,
                env_id=env_id,
                seed=1,
                log_folder=Path(folder),
                verbose=0,
                pictures=False,
            )
            train(spec, Console(quiet=True), {}, "")
        name = f"{algo} {settings.get('engine', '')} on {env_id}"
        table.add_row(name, *_row(saved, time.process_time() - started[0]))
    Console().print(table)


def _row(saved: Saved, seconds: float) -> list[str]:
    """The figures of a training that took so long."""
    if not saved:
        return ["0"]
    total, (first, since, _) = sum(taken for taken, _, _ in saved), saved[0]
    each, largest = 1000 * total / len(saved), max(size for _, _, size in saved) / 1e6
    shares = [f"{first / since:.2%}", f"{total / seconds:.2%}"]
    return [str(len(saved)), f"{1000 * first:.1f}", f"{each:.1f}", f"{largest:.2f}", *shares]


if __name__ == "__main__":
    main()
