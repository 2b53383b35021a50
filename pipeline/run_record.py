"""What a run folder says of the run before it begins: what was asked for, and what it runs on."""

from __future__ import annotations

import os
import platform
from collections.abc import Mapping
from functools import cache
from importlib.metadata import version
from pathlib import Path
from typing import Any

import yaml

from pipeline.files import write_text
from pipeline.module_records import keep_copies
from pipeline.run_folder import Run
from pipeline.train_spec import TrainSpec

# The field of ``run.json`` with the digest of the zip that a run goes on with.
TRAINED_AGENT = "trained_agent_digest"
_PROCESSORS = Path("/proc/cpuinfo")
RECORDED_PACKAGES = ("rl-yardstick", "stable-baselines3", "gymnasium", "torch", "numpy", "numba")


def write_settings(run: Run, spec: TrainSpec, command: str) -> None:
    """Write the hyperparameters and the command, where rl_zoo3 has them; keep the user's files."""
    write_text(run.params_path / "config.yml", _yaml(spec.saved_hyperparams))
    write_text(run.params_path / "command.txt", command + "\n")
    keep_copies(spec.user_modules, run.path)


def write_arguments(run: Run, spec: TrainSpec, args: Mapping[str, Any]) -> None:
    """Write the arguments of the command, as rl_zoo3 does."""
    # Its tools take env_kwargs for the environment's arguments and let them win over config.yml.
    args = {**args, "env_kwargs": spec.saved_hyperparams.get("env_kwargs")}
    write_text(run.params_path / "args.yml", _yaml(args))


def _yaml(data: Mapping[str, Any]) -> str:
    """As `yaml.safe_dump`, by the library's faster half where that was built."""
    return str(yaml.dump(data, Dumper=getattr(yaml, "CSafeDumper", yaml.SafeDumper)))


@cache
def recorded_versions() -> dict[str, str]:
    """The versions that a run's results may depend on."""
    packages = {package: version(package) for package in RECORDED_PACKAGES}
    return {"python": platform.python_version(), **packages}


@cache
def recorded_machine() -> dict[str, str]:
    """What times may depend on, and the bits of networks; nothing that names this very machine."""
    return {
        "processor": _processor(),
        "cores": str(os.cpu_count() or "unknown"),
        "system": f"{platform.system()} {platform.release()}, {platform.machine()}",
    }


def _processor() -> str:
    """The model, as Linux tells it; Python itself knows the family alone."""
    try:
        lines = _PROCESSORS.read_text(encoding="utf-8", errors="replace").splitlines()
    except OSError:
        lines = []
    named = (line.partition(":")[2].strip() for line in lines if line.startswith("model name"))
    return next(named, "") or platform.processor() or platform.machine() or "unknown"
