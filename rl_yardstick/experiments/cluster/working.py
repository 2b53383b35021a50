"""Orders from a driver to a worker, and their execution by the worker.

A worker is a supervisor whose child process does the run.
"""

from __future__ import annotations

import asyncio
import contextlib
import json
import multiprocessing
import platform
import secrets
import shutil
import signal
import threading
from collections.abc import Iterator, Mapping
from dataclasses import asdict, dataclass, fields, replace
from functools import partial
from pathlib import Path
from typing import Any, Self

import yaml
from distributed import Scheduler, Worker, WorkerPlugin, get_worker

from rl_yardstick.experiments import child_processes
from rl_yardstick.experiments.child_processes import StoppedError, TaskFailedError
from rl_yardstick.experiments.cluster.answers import (
    DONE,
    FAILED,
    STOPPED,
    UNFIT,
    Answer,
    files_in,
    packed,
)
from rl_yardstick.experiments.cluster.sent_code import SentCode, SentModule, UnfitError, versions
from rl_yardstick.experiments.launching import do_supervised
from rl_yardstick.experiments.plan import PlannedRun
from rl_yardstick.experiments.run_limits import RunLimits
from rl_yardstick.pipeline.errors import one_line
from rl_yardstick.pipeline.loaded_code import digest_of_lines
from rl_yardstick.pipeline.train_spec import TrainSpec
from rl_yardstick.pipeline.user_modules import UserModule

# The topics of workers' events, besides answers: the start of a run, and a worker's retirement.
LEAVING = "yardstick-leaving"

# Like yaml.safe_dump and yaml.safe_load, with the faster C version if available.
_Dumper: Any = getattr(yaml, "CSafeDumper", yaml.SafeDumper)
_Loader: Any = getattr(yaml, "CSafeLoader", yaml.SafeLoader)


@dataclass(frozen=True)
class Probe:
    """A file in the study's folder: a worker that finds it shares the folder."""

    home: Path  # the folder where the driver was started
    root: Path  # the study's folder, as the driver knows it
    name: str  # the name of the file
    content: str  # the content of the file

    @property
    def is_there(self) -> bool:
        """Whether the file exists with its content."""
        try:
            with (self.home / self.root / self.name).open("rb") as file:
                return file.read(len(self.content) + 1) == self.content.encode()
        except OSError:
            return False


@dataclass(frozen=True)
class RunOrder:
    """An order to do a run."""

    planned: PlannedRun  # the run
    command: str  # the command that requested it
    limits: RunLimits  # its limits
    probe: Probe  # the test for a shared folder
    topic: str  # the topic of the event that the run has begun
    code: SentCode  # the code that the run loads

    def packed(self) -> bytes:
        """The order as YAML: plain data that keeps the types of numbers and keys."""
        planned, limits = self.planned, self.limits
        data = {
            "planned": {field.name: getattr(planned, field.name) for field in fields(PlannedRun)}
            | {"spec": planned.spec.as_data(), "path": str(planned.path)},
            "limits": {"seconds": limits.seconds, "memory": limits.memory},
            "probe": asdict(self.probe)
            | {"home": str(self.probe.home), "root": str(self.probe.root)},
            "code": self.code.as_data(),
            **{name: getattr(self, name) for name in ("command", "topic")},
        }
        return bytes(yaml.dump(data, Dumper=_Dumper, sort_keys=False, encoding="utf-8"))

    @classmethod
    def unpacked(cls, content: bytes) -> Self:
        """Read an order that `packed` wrote."""
        loader = _Loader(content)
        data: dict[str, Any] = loader.get_single_data()
        loader.dispose()
        run, probe = data["planned"], data["probe"]
        spec, path = TrainSpec.of_data(run["spec"]), Path(run["path"])
        paths = {name: Path(probe[name]) for name in ("home", "root")}
        read = {
            "planned": PlannedRun(**{**run, "spec": spec, "path": path}),
            "limits": RunLimits(**data["limits"]),
            "code": SentCode.of_data(data["code"]),
            "probe": Probe(**{**probe, **paths}),
        }
        return cls(**{**data, **read})

    def apart(self) -> RunOrder:
        """The same order with relative paths, for a worker without the shared folder."""
        root, planned = self.probe.root, self.planned
        if not root.is_absolute() and ".." not in root.parts:
            return self
        log, new = planned.spec.tensorboard_log, Path("study")
        spec = replace(planned.spec, tensorboard_log=log and new / log.relative_to(root))
        planned = replace(planned, spec=spec, path=new / planned.path.relative_to(root))
        return replace(self, planned=planned, probe=replace(self.probe, root=new))


@contextlib.contextmanager
def probing(root: Path) -> Iterator[Probe]:
    """Keep a probe in a study's folder during the ``with`` statement.

    The next driver removes a probe that a killed driver has left.
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


# --- The side of the worker.

# The states of a task that its driver has cancelled, or that was lost with its scheduler.
_UNWANTED = ("cancelled", "released", "forgotten")


class _Closed:
    """Mixin that opens no HTTP port: it would answer every user of the machine without TLS."""

    def start_http_server(self, *args: Any, **kwargs: Any) -> None:
        """Do nothing, because Dask has no setting for this."""


class ClosedScheduler(_Closed, Scheduler):
    """A scheduler that only accepts TLS."""


class ClosedWorker(_Closed, Worker):
    """A worker that only accepts TLS."""


class Supervisors(WorkerPlugin):
    """Worker plugin that starts the fork server, so that workers can do runs."""

    name = "yardstick-supervisors"
    idempotent = True  # with several drivers, the first is enough

    def __init__(self, warm_ups: str, modules: Mapping[str, SentModule]) -> None:
        self.warm_ups = warm_ups  # compiled once, see `experiments.run_in_child.warm_ups`
        self.modules = modules  # the user's modules that warm-ups import, by name
        self._served: dict[str, str] = {}  # digests of imported modules, by top-level name

    def setup(self, worker: Worker) -> None:
        """Start the fork server in the background."""
        multiprocessing.current_process().daemon = False  # a nanny's process may have no children
        child_processes.start_server(self._checked_warm_ups(Path(worker.local_directory)))
        versions()  # caches the versions of what is loaded, before files change
        is_main = threading.current_thread() is threading.main_thread()
        if worker.nanny and is_main:  # otherwise Dask reacts to signals
            with contextlib.suppress(NotImplementedError):  # on Windows
                leave = partial(self._leave, worker)
                asyncio.get_running_loop().add_signal_handler(signal.SIGTERM, leave)

    def _checked_warm_ups(self, folder: Path) -> str:
        """The warm-ups whose modules have the driver's contents on this worker."""
        checked = []
        for item in json.loads(self.warm_ups):
            modules = [UserModule(**module) for module in item["modules"]]
            with contextlib.suppress(UnfitError, KeyError):
                placed = [self.modules[m.name].placed(m, folder) for m in modules]
                checked.append({**item, "modules": [*map(asdict, placed)]})
                for module in modules:
                    sent = self.modules[module.name]
                    self._served |= dict.fromkeys(sent.names, sent.digest)
        return json.dumps(checked)

    def serve(self, modules: tuple[SentModule, ...]) -> None:
        """Replace the fork server if it has imported other modules with these names."""
        for sent in modules:
            if any(self._served.get(name, sent.digest) != sent.digest for name in sent.names):
                self._served.clear()
                child_processes.serve_anew()

    def _leave(self, worker: Worker) -> None:
        """Retire in good order after SIGTERM, which a queue sends before it kills a job."""
        self.teardown(worker)
        self._leaving = asyncio.ensure_future(worker.close(nanny=False, reason="SIGTERM"))

    def teardown(self, worker: Worker) -> None:
        """End running runs, which save their states."""
        worker.log_event(LEAVING, {"at": worker.address})
        child_processes.stop_all()
        child_processes.end_server()


def found_versions(dask_worker: Worker) -> dict[str, Any]:
    """The name and versions of a worker, which a driver reads before it sends runs."""
    _supervisors(dask_worker)
    return {"name": _name(dask_worker), "versions": versions()}


def _name(worker: Worker) -> str:
    return f"{worker.address} on {platform.node()}"


def _supervisors(worker: Worker) -> Supervisors:
    """The plugin of this worker; adds it if missing, as after a restart of the scheduler."""
    plugin = worker.plugins.get(Supervisors.name)
    if isinstance(plugin, Supervisors):
        return plugin
    worker.plugins[Supervisors.name] = plugin = Supervisors("[]", {})
    plugin.setup(worker)
    return plugin


def answer_to(content: bytes) -> bytes:
    """Do the run of an order, and return how it ended; see `experiments.cluster.do_order`."""
    worker = get_worker()
    key = worker.get_current_task()
    order = RunOrder.unpacked(content)
    try:
        order = _fitting(order, worker)
    except UnfitError as error:
        told = {"at": worker.address, "name": _name(worker), "versions": versions(*order.code.more)}
        return packed(Answer(UNFIT, str(error), json.dumps(told)))
    worker.log_event(order.topic, {"run": key, "at": worker.address})
    limits = replace(order.limits, is_wanted=partial(_is_wanted, worker, key))
    order = replace(order, limits=limits)
    try:
        if order.probe.is_there:
            _do(order, order.probe.home)
            return packed(Answer(DONE))
        return packed(_done_apart(order.apart(), Path(worker.local_directory)))
    except StoppedError:
        return packed(Answer(STOPPED))
    except TaskFailedError as error:
        return packed(Answer(FAILED, str(error), error.details))
    except OSError as error:
        return packed(Answer(FAILED, f"{worker.address}: {error}"))


def _fitting(order: RunOrder, worker: Worker) -> RunOrder:
    """The order with the paths of the user's modules on this worker, if its code is the same.

    Raises:
        UnfitError: if this worker does not have the same code.
    """
    supervisors, code = _supervisors(worker), order.code
    if code.version != digest_of_lines(versions(*code.more)):
        raise UnfitError
    folder, spec = Path(worker.local_directory), order.planned.spec
    try:
        placed = [
            sent.placed(module, folder)
            for module, sent in zip(spec.user_modules, code.modules, strict=True)
        ]
    except OSError as error:
        raise UnfitError(one_line(error)) from error
    code.check_files(order.probe.home if order.probe.is_there else folder / order.topic)
    supervisors.serve(code.modules)
    spec = replace(spec, user_modules=tuple(placed))
    return replace(order, planned=replace(order.planned, spec=spec))


def _is_wanted(worker: Worker, key: Any) -> bool:
    task = worker.state.tasks.get(key)
    return task is not None and task.state not in _UNWANTED


def _do(order: RunOrder, home: Path) -> None:
    there = replace(order.planned, path=home / order.planned.path)
    if not there.is_finished:  # else an earlier worker finished it, but lost the answer
        do_supervised(order.planned, order.probe.root, order.command, order.limits, home)


def _done_apart(order: RunOrder, folder: Path) -> Answer:
    """Do a run in a temporary folder of the worker, and add its files to the answer."""
    home = folder / order.topic
    home.mkdir(exist_ok=True)
    _do(order, home)
    run, log = home / order.planned.path, order.planned.spec.tensorboard_log
    try:
        files = files_in(run, "run/")
        files |= {} if log is None else files_in(home / log, "tensorboard/")
    except ValueError as error:
        return Answer(FAILED, str(error))
    finally:
        shutil.rmtree(run, ignore_errors=True)
        if log is not None:
            shutil.rmtree(home / log, ignore_errors=True)
    return Answer(DONE, files=files)
