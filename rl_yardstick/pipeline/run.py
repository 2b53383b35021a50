"""A run's folder, as rl_zoo3 lays it out, with its lock, its console and the request to stop."""

from __future__ import annotations

import os
import platform
import re
import shutil
import signal
import threading
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from functools import cache
from io import BytesIO
from pathlib import Path
from types import FrameType
from typing import Any, Self
from warnings import catch_warnings

import numpy as np
import yaml
from filelock import FileLock, Timeout
from pydantic import ValidationError
from rich.console import Console

from rl_yardstick.mdp.transition_model import Floats
from rl_yardstick.pipeline import files
from rl_yardstick.pipeline.errors import Stopped, UserError, as_user_error
from rl_yardstick.pipeline.spec import TrainSpec

RUNNING, FINISHED, INTERRUPTED, FAILED = "running", "finished", "interrupted", "failed"
RECORD, STATE, LOCK = "run.json", "state.bin", ".lock"
PULLS_FILE = "pulls.npz"
LAST_PULLS = 100  # pulls at the end whose mean is reported
MAX_RECORD = 100_000_000  # bytes of run.json, which holds the rows of maps


class Stop:
    """Notices the first SIGINT or SIGTERM; the second signal ends the process."""

    number = 0  # of the first signal

    def listen(self, *numbers: int) -> Self:
        """Take over the signals, in a process's main thread; elsewhere Python delivers none."""
        if threading.current_thread() is threading.main_thread():
            for number in numbers or (signal.SIGINT, signal.SIGTERM):
                signal.signal(number, self._noticed)
        return self

    def _noticed(self, number: int, frame: FrameType | None) -> None:
        if self.number:
            raise KeyboardInterrupt
        self.number = number

    def check(self) -> None:
        """Raise `Stopped` after a signal; called between two pieces of work."""
        if self.number:
            raise Stopped(self.number)


class Run:
    """A run folder, held by this process while the ``with`` statement lasts."""

    def __init__(
        self, path: Path, console: Console | None = None, stop: Stop | None = None
    ) -> None:
        self.path = path  # <log folder>/<algo>/<env>_<n>
        self.state_path = path / STATE  # from which the training can go on
        self.best_model_path = path / "best_model.zip"  # of the agent that evaluated best
        self.console = console or Console(quiet=True)
        self.stop = stop or Stop()  # asked between two pieces of work whether to go on
        self.is_new = False  # whether this process has made the folder
        self.has_begun = False  # about to take steps; a new run without any leaves no folder
        self._lock = FileLock(path / LOCK, timeout=0)

    @classmethod
    def claim(cls, folder: Path, spec: TrainSpec, suffix: str = "", **kwargs: Any) -> Self:
        """Make the next free folder of an agent on an environment; ``mkdir`` decides who has it."""
        parent = folder / spec.algo
        parent.mkdir(parents=True, exist_ok=True)
        number = max((n for n, _ in numbered_runs(parent, spec.env_name)), default=0)
        while True:
            number += 1
            path = parent / f"{spec.env_name}_{number}{suffix}"
            with suppress(FileExistsError):
                path.mkdir()
                run = cls(path, **kwargs)
                run.is_new = True
                return run

    def __enter__(self) -> Self:
        try:
            self._lock.acquire()
        except Timeout:
            process = f", process {pid}" if (pid := self.recorded().get("pid")) else ""
            raise UserError(f"{self.path} is in use by another command{process}") from None
        except NotImplementedError as error:  # no flock
            raise UserError(f"{self.path}: {error}") from error
        return self

    def __exit__(self, kind: object, error: BaseException | None, trace: object) -> None:
        if error is not None and self.is_new and not self.has_begun:
            shutil.rmtree(self.path, ignore_errors=True)
            for folder in list(self.path.parents)[:2]:  # those that are empty now
                with suppress(OSError):
                    folder.rmdir()
        self._lock.release()

    # --- files ------------------------------------------------------------------------------------

    def model_path(self, spec: TrainSpec) -> Path:
        """The zip of the agent at the end."""
        return self.path / f"{spec.env_name}.zip"

    def checkpoints(self) -> dict[int, Path]:
        """The checkpoints by their steps, in rising order."""
        form = re.compile(r"rl_model_(\d+)_steps\.zip")
        named = [(form.fullmatch(path.name), path) for path in self.path.iterdir()]
        return dict(sorted((int(match[1]), path) for match, path in named if match))

    def recorded(self) -> dict[str, Any]:
        """The content of ``run.json``; empty if there is none yet."""
        path = self.path / RECORD
        data = files.read_json(path, MAX_RECORD) if path.exists() else {}
        return data if isinstance(data, dict) else {}

    def spec(self) -> TrainSpec:
        """The spec in ``run.json``, which is data; UserError if there is none."""
        try:
            return TrainSpec.model_validate(self.recorded()["spec"])
        except (ValidationError, LookupError, TypeError) as error:
            fault = f"is no run folder of this version: it has no {RECORD} with a spec"
            raise UserError(f"{self.path} {fault}") from error

    def begin(self, spec: TrainSpec, args: Mapping[str, Any], command: str) -> None:
        """Write what the run is about to do: settings for rl_zoo3, and ``run.json``."""
        settings = self.path / spec.env_name
        settings.mkdir(exist_ok=True)
        # rl_zoo3's tools use env_kwargs in args.yml before those in config.yml.
        args = {**args, "env_kwargs": spec.env_kwargs or None}
        for name, data in (("config.yml", spec.hyperparams), ("args.yml", args)):
            dumper = getattr(yaml, "CSafeDumper", yaml.SafeDumper)
            files.write_text(settings / name, yaml.dump(files.plain(data), Dumper=dumper))
        files.write_text(settings / "command.txt", f"{command}\n")
        self.record(spec, RUNNING)

    def record(self, spec: TrainSpec, state: str, **figures: Any) -> None:
        """Write ``run.json``; with the state ``finished`` it is the last file of a run."""
        known = {"state": state, "env_name": spec.env_name, "spec": spec.model_dump()}
        facts = {"versions": versions(), "machine": machine(), "pid": os.getpid()}
        files.write_json(self.path / RECORD, {**known, **facts, **figures})


def save_agent(agent: Any, path: Path, buffer: Path | None = None) -> None:
    """Save an agent's zip whole or not at all, its VecNormalize's statistics and replay buffer."""
    from rl_yardstick.pipeline.finite_numbers import check_model

    check_model(agent)
    with files.replacing(path) as beside:
        agent.save(beside)
    if (statistics := agent.get_vec_normalize_env()) is not None:
        with files.replacing(statistics_beside(path)) as beside:
            statistics.save(str(beside))
    if buffer is not None and getattr(agent, "replay_buffer", None) is not None:
        with files.replacing(buffer) as beside:
            agent.save_replay_buffer(beside)


@contextmanager
def tracked(run: Run, spec: TrainSpec, where: Mapping[str, Any]) -> Iterator[None]:
    """Send what TensorBoard is told to Weights & Biases, until the block ends.

    ``where`` has entity, project, group and tags of ``wandb.init``. With ``WANDB_MODE=offline`` the
    records stay in the run folder. Raises UserError if it refuses, e.g. without a key.
    """
    import wandb

    with as_user_error("--track", wandb.Error):
        tracking = wandb.init(
            name=f"{spec.algo}/{run.path.name}",
            dir=run.path,
            config={"algo": spec.algo, "env": spec.env_id, "seed": spec.seed, **spec.hyperparams},
            sync_tensorboard=True,  # its own integration
            settings=wandb.Settings(console="off", silent=run.console.quiet),
            **where,
        )
    with tracking:
        yield


def statistics_beside(model: Path) -> Path:
    """Where the statistics of a model's VecNormalize are saved, as in rl_zoo3."""
    if model.name.startswith("rl_model_"):
        return model.with_name(f"{model.stem.replace('model', 'model_vecnormalize')}.pkl")
    if model.stem == "best_model":
        return model.with_name("best_model_vecnormalize.pkl")
    return model.with_suffix("") / "vecnormalize.pkl"


@dataclass(frozen=True)
class Episodes:
    """The training episodes of a run, ordered by their ends; each array has the shape (n,)."""

    steps: Floats  # steps up to the end, over all environments
    returns: Floats  # undiscounted returns
    seconds: Floats  # time since the beginning


def read_episodes(folder: Path, limit: int = files.MAX_TABLE) -> Episodes:
    """Read the training episodes in Monitor's files, each of at most ``limit`` bytes."""
    tables = []
    form: Any = {"delimiter": ",", "skiprows": 2, "usecols": (0, 1, 2), "ndmin": 2}
    for path in sorted(folder.glob("*.monitor.csv")):
        content = BytesIO(files.read_bytes(path, limit))
        with as_user_error(f"{path} is damaged", ValueError), catch_warnings(action="ignore"):
            # Without an episode it has two lines, and NumPy warns.
            tables.append(np.loadtxt(content, **form).reshape(-1, 3))
    if not tables:
        raise UserError(f"{folder} has no 0.monitor.csv")
    return joined_episodes(tables)


def joined_episodes(tables: Sequence[Floats]) -> Episodes:
    """The episodes of all environments of a run: for each return, length, time, shape (n, 3)."""
    # The environments step together, so all have done the same number of steps.
    steps = np.concatenate([len(tables) * table[:, 1].cumsum() for table in tables])
    order = np.argsort(steps, kind="stable")
    rows = np.concatenate(tables)[order]
    # Episodes that end in one step are written a moment after each other, in no fixed order.
    return Episodes(steps[order], rows[:, 0], np.maximum.accumulate(rows[:, 2]))


def numbered_runs(parent: Path, env_name: str) -> list[tuple[int, Path]]:
    """The run folders of one environment, by rising number."""
    form = re.compile(re.escape(env_name) + r"_(\d+)(?:_[0-9a-f-]{36})?")
    names = [(form.fullmatch(p.name), p) for p in parent.iterdir()] if parent.is_dir() else []
    return sorted((int(match[1]), path) for match, path in names if match)


def resumable(path: Path) -> TrainSpec:
    """The spec of a run; UserError if it has finished, or if versions and so bits would differ."""
    run = Run(path)
    spec, recorded = run.spec(), run.recorded()
    if recorded.get("state") == FINISHED:
        raise UserError(f"{path} is finished already")
    begun_with = recorded.get("versions", {}) if run.state_path.exists() else versions()
    for name, version in versions().items():
        if (was := begun_with.get(name)) != version:
            raise UserError(f"{path} was begun with {name} {was}, here is {version}")
    return spec


@cache
def versions() -> dict[str, str]:
    """The versions on which the bits of a run depend."""
    from importlib.metadata import version

    names = ("rl-yardstick", "torch", "stable-baselines3", "gymnasium", "numpy", "numba")
    return {"python": platform.python_version(), **{name: version(name) for name in names}}


@cache
def machine() -> dict[str, str]:
    """Hardware that may affect times and the bits of networks; does not identify the machine."""
    listed = Path("/proc/cpuinfo")
    text = listed.read_text(encoding="utf-8") if listed.exists() else ""
    named = re.search(r"model name\s*:(.*)", text)
    processor = named[1].strip() if named else platform.processor() or platform.machine()
    system = f"{platform.system()} {platform.release()}, {platform.machine()}"
    return {"processor": processor, "cores": str(os.cpu_count() or ""), "system": system}


# --- the comparisons of ``--diagnose`` ------------------------------------------------------------

# The columns of ``diagnosis.csv`` after the first, in their order.
MEANINGS = {
    "v_error": "error of V, RMS over states",
    "v_error_visited": "error of V, RMS over visits",
    "q_error": "error of Q, RMS over states",
    "q_error_visited": "error of Q, RMS over visits",
    "advantage_error": "error of advantages, RMS over states",
    "advantage_error_visited": "error of advantages, RMS over visits",
    "overestimation": "max Q less true value, mean over visits",
    "entropy": "entropy of the policy, nats, mean over visits",
    "gae_bias": "GAE: bias between actions, RMS",
    "gae_offset": "GAE: bias of the state, RMS",
    "gae_std": "GAE: standard deviation",
    "gradient_cosine": "gradient: cosine with the exact one",
    "gradient_snr": "gradient: signal-to-noise ratio",
}
