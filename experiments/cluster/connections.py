"""The way to a scheduler, made again when it is lost."""

from __future__ import annotations

import contextlib
import threading
import time
from collections.abc import Callable, Mapping
from typing import Any

from distributed import Client

from experiments.cluster.addresses import is_loopback
from pipeline.errors import UserError, one_line

# How long a scheduler may be gone: to be started again takes a few seconds, a reboot a minute.
SECONDS_WITHOUT_SCHEDULER = 120.0
SECONDS_TO_CONNECT = 8.0
_SECONDS_BETWEEN_LOOKS = 0.2


class ClusterGoneError(UserError):
    """There is no scheduler any more."""


class Connection:
    """A client of a scheduler, and another when it has lost it.

    Args:
        connect: makes one; raises OSError where there is no scheduler.
        prepare: called with each.
        is_told: whether the user has said that an open scheduler will do.
    """

    def __init__(
        self, connect: Callable[[], Client], prepare: Callable[[Client], None], is_told: bool
    ) -> None:
        self._connect = connect
        self._prepare = prepare
        self._is_told = is_told
        self._lock = threading.Lock()
        self._closed = threading.Event()
        self._client: Client | None = None
        self._is_lost = False
        self._identity = ""

    def begin(self) -> None:
        """Connect for the first time.

        Raises:
            UserError: if there is no scheduler, or it is open to the network.
        """
        try:
            self._client = self._connected()
        except OSError as error:
            raise UserError(f"--cluster: there is no scheduler: {one_line(error)}") from error

    def lose(self, client: Client) -> None:
        """Take a client for lost: also one that has found another scheduler in its place."""
        with self._lock:
            if self._client is client and not self._closed.is_set():
                self._is_lost = True

    def client(self) -> Client:
        """A client that has its scheduler; it is waited for.

        Raises:
            ClusterGoneError: if it does not come back.
        """
        with self._lock:
            client = self._client
            if client is None or self._closed.is_set():
                raise ClusterGoneError("the cluster is closed")
            if client.status == "running" and not self._is_lost:
                return client
            _close(client)
            self._client, self._is_lost = self._waited_for(), False
            return self._client

    def n_threads(self) -> Mapping[str, int]:
        """How many runs each worker does at once, by address.

        Raises:
            UserError: if a worker is open to the network.
            OSError: if the scheduler cannot be asked.
        """
        client = self.client()
        if _identity(client)["id"] != self._identity:
            self.lose(client)
            return {}
        workers: Mapping[str, int] = client.nthreads()
        self._check_open(workers)
        return workers

    def close(self) -> None:
        """Leave the scheduler; what is under way there ends."""
        self._closed.set()
        with self._lock:
            if self._client is not None:
                _close(self._client)
                self._client = None

    def _waited_for(self) -> Client:
        until = time.monotonic() + SECONDS_WITHOUT_SCHEDULER
        reason = "it is gone"
        while time.monotonic() < until and not self._closed.is_set():
            try:
                return self._connected()
            except (OSError, UserError) as error:  # its file may be missing, or half-written
                reason = one_line(error)
            time.sleep(_SECONDS_BETWEEN_LOOKS)
        raise ClusterGoneError(
            f"--cluster: there was no scheduler for {SECONDS_WITHOUT_SCHEDULER:.0f} s ({reason}); "
            "finished runs are kept, and the same command continues"
        )

    def _connected(self) -> Client:
        client = self._connect()
        try:
            identity = _identity(client)
            self._check_open([identity["address"]])
            self._identity = identity["id"]
            self._prepare(client)
        except BaseException:
            _close(client)
            raise
        return client

    def _check_open(self, addresses: Any) -> None:
        """Refuse what listens to a network without TLS, whatever it was called here."""
        for address in addresses:
            if not (self._is_told or address.startswith("tls://") or is_loopback(address)):
                raise UserError(
                    f"--cluster: {address} is open to its network without TLS: start it with "
                    "--host 127.0.0.1 or with TLS, or say --insecure-cluster"
                )


def _identity(client: Client) -> dict[str, Any]:
    """What a scheduler says of itself: where it listens among it."""
    found: dict[str, Any] = client.scheduler_info(n_workers=0)
    return found


def _close(client: Client) -> None:
    # Whatever goes wrong in leaving, there is nothing left to be done.
    with contextlib.suppress(Exception):
        client.close(timeout=2)
