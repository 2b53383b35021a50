"""Where the trials of a tuning are kept: a file of its own, or what ``--storage`` names."""

from __future__ import annotations

import contextlib
import json
import re
import time
import warnings
from collections.abc import Iterator
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal
from urllib.parse import urlsplit

from pipeline.errors import UserError, one_line, shown

if TYPE_CHECKING:
    from optuna.storages import BaseStorage

OWN_FILE = "trials.db"
SECONDS_TO_WAIT = 120  # for others who write into the same SQLite file
SECONDS_TO_CONNECT = 15  # to a proxy
_LONGEST_LINE = 1 << 20  # bytes
_TRIES, _SECONDS_BETWEEN_TRIES = 5, 0.2
# Whose errors are the storage's.
_LIBRARIES = frozenset({"optuna", "sqlalchemy", "sqlite3", "grpc", "json"})
_JOURNAL = "journal:"
_GRPC = "grpc"
_SCHEME = re.compile(r"[a-z][a-z0-9+.-]*(?=://)", re.IGNORECASE)
_SECRET = re.compile(r"(?<=://)([^\s/@:]*):[^\s/@]*@")
_ANY_PORT = 13000  # of Optuna's proxy
_DATABASES = ("sqlite", "postgresql", "mysql", "mariadb")
KNOWN = "a file for a journal, sqlite:///FILE, postgresql://..., mysql://..., grpc://HOST:PORT"


def open_storage(root: Path, given: str | None) -> BaseStorage:
    """The storage of a tuning.

    Args:
        root: the folder of the tuning.
        given: what ``--storage`` says; None for a SQLite file in that folder.

    Raises:
        UserError: if it cannot be opened.
    """
    if given is None:
        return _own_file(root / OWN_FILE)
    try:
        match kind_of(given):
            case "journal":
                return _journal(Path(given.removeprefix(_JOURNAL)))
            case "proxy":
                return _proxy(given)
            case "database":
                return _database(given)
    except ImportError as error:
        lacking = getattr(error.__cause__ or error, "name", None)
        what = f"it needs the package of {lacking}" if lacking else one_line(error)
        raise UserError(f"--storage {without_secret(given)}: {what}: install that") from error


@contextlib.contextmanager
def failing_in_a_line(given: str | None) -> Iterator[None]:
    """Say in one line what the storage fails of, whenever it does: full, gone, or damaged.

    Args:
        given: what ``--storage`` says.

    Raises:
        UserError: in place of what the libraries raise.
    """
    try:
        yield
    except Exception as error:
        if not _LIBRARIES & {kind.__module__.partition(".")[0] for kind in type(error).__mro__}:
            raise
        name = OWN_FILE if given is None else f"--storage {without_secret(given)}"
        goes_on = "; what is done stays, and the same command goes on"
        if isinstance(error, json.JSONDecodeError):
            name, goes_on = f"{name} is damaged", ""
        raise UserError(f"{name}: {_reason(error)}{goes_on}") from error


def kind_of(given: str) -> Literal["journal", "proxy", "database"]:
    """What a storage is by its name.

    Raises:
        UserError: if it is none.
    """
    scheme = _SCHEME.match(given)
    if scheme is None:
        return "journal"
    name = scheme[0].partition("+")[0].lower()
    if name not in (*_DATABASES, _GRPC):
        raise UserError(f"--storage: {shown(without_secret(given))} is no storage: {KNOWN}")
    return "proxy" if name == _GRPC else "database"


def without_secret(text: str) -> str:
    """The text with the password of each address in it left out."""
    return _SECRET.sub(r"\1:***@", text)


def _own_file(path: Path) -> BaseStorage:
    """A SQLite file. In an address, some signs of its path would mean something else."""
    import sqlite3

    def connect() -> sqlite3.Connection:
        return sqlite3.connect(path, timeout=SECONDS_TO_WAIT, check_same_thread=False)

    return _opened(f"sqlite:///{OWN_FILE}", {"creator": connect}, str(path))


def _journal(path: Path) -> BaseStorage:
    from optuna.storages import JournalStorage
    from optuna.storages.journal import JournalFileBackend, JournalFileOpenLock

    _check_journal(path)
    path.parent.mkdir(parents=True, exist_ok=True)
    backend = JournalFileBackend(str(path), lock_obj=JournalFileOpenLock(str(path)))
    return JournalStorage(backend)


def _check_journal(path: Path) -> None:
    """Refuse a file of something else, before a line is written to it, and one that is cut off."""
    if path.is_dir() or not path.name:
        raise UserError(f"--storage journal:FILE: {path} is no file")
    if not path.exists():
        return
    with path.open("rb") as file:
        first = file.readline(_LONGEST_LINE)
    try:
        is_journal = not first or "op_code" in json.loads(first)
    except (ValueError, TypeError, RecursionError):
        is_journal = False
    if not is_journal:
        raise UserError(f"--storage {path}: is there already, and no journal of trials")
    if not any(_ends_whole(path) for _ in range(_TRIES)):
        raise UserError(f"--storage {path}: its last line is cut off: remove that line")


def _ends_whole(path: Path) -> bool:
    """Whether a file ends with a line; if not, after a while in which another may write it."""
    with path.open("rb") as file:
        file.seek(max(path.stat().st_size - 1, 0))
        is_whole = file.read(1) in (b"", b"\n")
    if not is_whole:
        time.sleep(_SECONDS_BETWEEN_TRIES)
    return is_whole


def _proxy(url: str) -> BaseStorage:
    from optuna.exceptions import ExperimentalWarning
    from optuna.storages import GrpcStorageProxy

    parts = urlsplit(url)
    if not parts.hostname:
        raise UserError(f"--storage: which machine? {shown(url)} names none: grpc://HOST:PORT")
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", ExperimentalWarning)  # of the proxy, since 4.2
            proxy = GrpcStorageProxy(host=parts.hostname, port=parts.port or _ANY_PORT)
        proxy.wait_server_ready(SECONDS_TO_CONNECT)
    except (ValueError, OSError) as error:
        raise UserError(f"--storage {url}: there is no proxy: {one_line(error)}") from error
    return proxy


def _database(url: str) -> BaseStorage:
    options = {}
    if url.startswith("sqlite"):
        if url.partition("://")[2].strip("/") in ("", ":memory:"):
            raise UserError(f"--storage {url}: names no file: sqlite:///FILE")
        options = {"connect_args": {"timeout": SECONDS_TO_WAIT}}
    # Optuna fills braces in.
    return _opened(url.replace("{", "{{").replace("}", "}}"), options, without_secret(url))


def _opened(url: str, options: dict[str, Any], name: str) -> BaseStorage:
    from optuna.exceptions import StorageInternalError
    from optuna.storages import RDBStorage
    from sqlalchemy.exc import SQLAlchemyError

    try:
        return RDBStorage(url, engine_kwargs=options)
    except (SQLAlchemyError, StorageInternalError, RuntimeError, ValueError) as error:
        raise UserError(f"--storage {name}: cannot be opened: {_reason(error)}") from error


def _reason(error: Exception) -> str:
    """What a library says in a line, without its questions, its manual's address and passwords."""
    cause = error.__cause__ if type(error).__name__ == "StorageInternalError" else None
    said = one_line(cause or error)
    for rest in ("(Background on", "[SQL: "):
        said = said.partition(rest)[0]
    return without_secret(said.strip())
