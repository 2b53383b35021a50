"""What a driver tells a worker about a run."""

from __future__ import annotations

import contextlib
import hashlib
import importlib.metadata
import platform
import secrets
from collections.abc import Iterator
from dataclasses import asdict, dataclass, fields, replace
from functools import cache
from pathlib import Path
from typing import Any, Self

import yaml

from experiments.planned_runs import PlannedRun
from experiments.run_limits import RunLimits
from pipeline.source_digest import source_digest
from pipeline.train_spec import TrainSpec

# The topics of what workers tell drivers, besides answers: who has begun what, and who leaves.
LEAVING = "yardstick-leaving"

# As yaml.safe_dump and yaml.safe_load, by the library's faster half where that was built.
_Dumper: Any = getattr(yaml, "CSafeDumper", yaml.SafeDumper)
_Loader: Any = getattr(yaml, "CSafeLoader", yaml.SafeLoader)

_LIBRARIES = ("gymnasium", "numpy", "numba", "stable-baselines3", "torch")


@dataclass(frozen=True)
class Probe:
    """A file in the study's folder: a worker that finds it shares the folder.

    Attributes:
        home: the folder where the driver was started.
        root: the study's folder, as the driver knows it.
        name: of the file.
        content: its content.
    """

    home: Path
    root: Path
    name: str
    content: str

    @property
    def is_there(self) -> bool:
        """Whether the file is, with its content."""
        try:
            with (self.home / self.root / self.name).open("rb") as file:
                return file.read(len(self.content) + 1) == self.content.encode()
        except OSError:
            return False


@dataclass(frozen=True)
class RunOrder:
    """A run to do.

    Attributes:
        planned: the run.
        command: the command that asked for it.
        limits: what it may take.
        probe: what tells whether the study's folder is shared.
        topic: where to tell that it begins.
        version: the driver's `version`.
    """

    planned: PlannedRun
    command: str
    limits: RunLimits
    probe: Probe
    topic: str
    version: str

    def packed(self) -> bytes:
        """The order as YAML: plain data, whose numbers and keys stay what they are."""
        planned, limits = self.planned, self.limits
        data = {
            "planned": {field.name: getattr(planned, field.name) for field in fields(PlannedRun)}
            | {"spec": planned.spec.as_data(), "path": str(planned.path)},
            "limits": {"seconds": limits.seconds, "memory": limits.memory},
            "probe": asdict(self.probe)
            | {"home": str(self.probe.home), "root": str(self.probe.root)},
            **{name: getattr(self, name) for name in ("command", "topic", "version")},
        }
        return bytes(yaml.dump(data, Dumper=_Dumper, sort_keys=False, encoding="utf-8"))

    @classmethod
    def unpacked(cls, content: bytes) -> Self:
        """The order that `packed` has written."""
        loader = _Loader(content)
        data: dict[str, Any] = loader.get_single_data()
        loader.dispose()
        run, probe = data["planned"], data["probe"]
        spec, path = TrainSpec.of_data(run["spec"]), Path(run["path"])
        paths = {name: Path(probe[name]) for name in ("home", "root")}
        read = {
            "planned": PlannedRun(**{**run, "spec": spec, "path": path}),
            "limits": RunLimits(**data["limits"]),
            "probe": Probe(**{**probe, **paths}),
        }
        return cls(**{**data, **read})

    def apart(self) -> RunOrder:
        """The same in folders that a relative path can reach, where none is shared."""
        root, planned = self.probe.root, self.planned
        if not root.is_absolute() and ".." not in root.parts:
            return self
        log, new = planned.spec.tensorboard_log, Path("study")
        spec = replace(planned.spec, tensorboard_log=log and new / log.relative_to(root))
        planned = replace(planned, spec=spec, path=new / planned.path.relative_to(root))
        return replace(self, planned=planned, probe=replace(self.probe, root=new))


@contextlib.contextmanager
def probing(root: Path) -> Iterator[Probe]:
    """Let a probe lie in a study's folder while the ``with`` statement runs.

    One that is left, by a driver that was killed, is removed by the next.
    """
    name = f".cluster-{secrets.token_hex(8)}.tmp"
    probe = Probe(Path.cwd(), root, name, secrets.token_hex(16))
    path = root / name
    root.mkdir(parents=True, exist_ok=True)
    path.write_text(probe.content, encoding="utf-8")
    try:
        yield probe
    finally:
        path.unlink(missing_ok=True)


@cache
def version() -> str:
    """Of the sources that runs depend on, and of the libraries: workers of another do none."""
    lines = [f"{name} {importlib.metadata.version(name)}" for name in _LIBRARIES]
    lines += [f"python {platform.python_version()}", source_digest("experiments")]
    return hashlib.sha256("\n".join(lines).encode()).hexdigest()[:16]
