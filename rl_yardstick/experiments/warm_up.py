"""``python -m rl_yardstick.experiments.warm_up`` compiles what the agents with tables and PPO need.

The machine code is cached, so that their first trainings need not wait for it. ``make`` does this
in the background; it may be done or left out at any time, also twice at once.
"""

from __future__ import annotations

from contextlib import suppress
from pathlib import Path
from tempfile import TemporaryDirectory

from rl_yardstick.agents import ALGORITHMS
from rl_yardstick.experiments.plan import plan
from rl_yardstick.experiments.pool import do_run
from rl_yardstick.experiments.study import AgentSpec, EnvironmentSpec, StudySpec
from rl_yardstick.pipeline.errors import UserError


def main() -> None:
    """Train each agent for a moment, those first that most people begin with."""
    tables = [name for name, entry in ALGORITHMS.items() if entry.family == "tabular"]
    ppo = AgentSpec("ppo", "ppo", {"engine": "compiled", "n_timesteps": 8192})
    few = {"n_timesteps": 300}
    agents = [AgentSpec(name, name, few) for name in tables]
    agents.insert(1, ppo)
    place = (EnvironmentSpec("Warehouse-v0", "Warehouse-v0"),)
    with TemporaryDirectory() as folder:
        study = StudySpec("warm_up", "", tuple(agents), place, n_seeds=1)
        for run in plan(study, Path(folder)):
            with suppress(UserError):
                do_run(run)


if __name__ == "__main__":
    main()
