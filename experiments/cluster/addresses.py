"""What ``--cluster`` says: workers here, a scheduler's address or file, or a queue of jobs.

Dask's own messages are pickles, so whoever can talk to a scheduler can run code as its user, on the
scheduler, on its workers and in the driver. Hence a scheduler is spoken to only where nobody from
outside can: by TLS, which both sides prove themselves to, or on this machine alone.
"""

from __future__ import annotations

import ipaddress
import json
from dataclasses import dataclass
from pathlib import Path
from typing import Any
from urllib.parse import urlsplit

from pipeline.errors import UserError, shown
from pipeline.settings.yaml import read_yaml
from safe_files.files import UnsafeFileError, read_file

MOST_LOCAL_WORKERS = 1024
_LARGEST_FILE = 1 << 20  # bytes, of a scheduler's file
_FORMS = "ADDRESS:PORT, a scheduler's file, a YAML of dask-jobqueue, or local:N"


@dataclass(frozen=True)
class LocalWorkers:
    """That many workers on this machine, for as long as the command takes."""

    n_workers: int


@dataclass(frozen=True)
class SchedulerAddress:
    """A scheduler that is there, by its address or by the file that has it."""

    text: str  # the address; empty where it stands in the file
    file: Path | None = None  # the file; None where there is none

    def read(self) -> str:
        """The address, as it is now: with ``tcp://`` or ``tls://``."""
        text = self.text if self.file is None else _address_in(self.file)
        return text if "://" in text else f"tcp://{text}"


@dataclass(frozen=True)
class JobQueue:
    """Workers that a queueing system starts as jobs."""

    system: str  # its name in dask-jobqueue
    settings: dict[str, Any]  # what dask-jobqueue is told of it
    n_cores: int  # of each job, as many runs at once
    file: Path  # where that stands


Cluster = LocalWorkers | SchedulerAddress | JobQueue


def read_cluster(text: str, systems: tuple[str, ...]) -> Cluster:
    """What ``--cluster`` means, or `UserError`; ``systems`` are the queueing systems there are."""
    if text.startswith("local:"):
        number = text.removeprefix("local:")
        if number.isascii() and number.isdecimal() and 0 < int(number[:9]) <= MOST_LOCAL_WORKERS:
            return LocalWorkers(int(number))
        raise UserError(f"--cluster local:N: N is 1 to {MOST_LOCAL_WORKERS:,}, not {shown(number)}")
    path = Path(text)
    if path.suffix in (".yml", ".yaml"):
        return _job_queue(path, systems)
    if path.suffix == ".json" or path.is_file():
        return SchedulerAddress("", path)
    if _host(text) is None:
        raise UserError(f"--cluster {shown(text)}: give {_FORMS}")
    return SchedulerAddress(text)


def check_address(address: str, has_certificates: bool, is_told: bool) -> None:
    """Refuse a scheduler that is open to the network, or by TLS without its certificates.

    Where ``is_told``, the user has said that an open one will do.
    """
    scheme = urlsplit(address).scheme
    if scheme not in ("tcp", "tls"):
        raise UserError(f"--cluster {address}: give an address that begins with tls:// or tcp://")
    if scheme == "tls" and not has_certificates:
        raise UserError(
            f"--cluster {address}: TLS takes a ca-file and the client's cert and key in Dask's "
            "configuration, under distributed.comm.tls; docs/cluster.md shows how"
        )
    if scheme == "tcp" and not is_loopback(address) and not is_told:
        raise UserError(
            f"--cluster {address}: without TLS, anybody who can connect to a scheduler can run "
            "code as you; use tls://, or give --insecure-cluster if the network is yours alone"
        )


def is_loopback(address: str) -> bool:
    """Whether an address can be reached from its own machine alone."""
    host = _host(address)
    if host is None or host == "localhost":
        return host is not None
    try:
        return ipaddress.ip_address(host).is_loopback
    except ValueError:  # a name
        return False


def _host(address: str) -> str | None:
    """The host of an address; None where it is none, or lacks the port."""
    try:
        parts = urlsplit(address if "://" in address else f"tcp://{address}")
        return parts.hostname if parts.port else None
    except ValueError:
        return None


def _address_in(path: Path) -> str:
    try:
        found = json.loads(read_file(path, _LARGEST_FILE))
    except OSError as error:
        raise UserError(f"--cluster {path}: cannot be read: {error.strerror}") from error
    except (UnsafeFileError, ValueError, RecursionError) as error:
        raise UserError(f"--cluster {path}: is no scheduler's file") from error
    address = found.get("address") if isinstance(found, dict) else None
    if not isinstance(address, str) or _host(address) is None:
        raise UserError(f"--cluster {path}: holds no scheduler's address")
    return address


def _job_queue(path: Path, systems: tuple[str, ...]) -> JobQueue:
    content = read_yaml(path)
    queues = content.get("jobqueue") if isinstance(content, dict) else None
    if not isinstance(queues, dict) or len(content) != 1 or len(queues) != 1:
        raise UserError(f"{path}: must hold the key jobqueue, and in it one queueing system")
    ((system, settings),) = queues.items()
    if system not in systems:
        raise UserError(f"{path}: {shown(system)} is none of {', '.join(systems)}")
    if not isinstance(settings, dict) or not {"cores", "memory"} <= settings.keys():
        raise UserError(f"{path}: {system}: say how many cores and how much memory a job has")
    cores = settings["cores"]
    if not isinstance(cores, int) or isinstance(cores, bool) or cores < 1:
        raise UserError(f"{path}: {system}: cores must be a whole number, not {shown(cores)}")
    return JobQueue(system, settings, cores, path)
