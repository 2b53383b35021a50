"""Where the trials of a tuning are kept: a file of its own, or what ``--storage`` names."""

from __future__ import annotations

import re
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal
from urllib.parse import urlsplit

from pipeline.errors import UserError, one_line, shown

if TYPE_CHECKING:
    from optuna.storages import BaseStorage

OWN_FILE = "trials.db"
SECONDS_TO_WAIT = 120  # for others who write into the same SQLite file
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
        lacking = one_line(error).partition(".")[0]
        raise UserError(f"--storage {without_secret(given)}: {lacking}: install one") from error


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

    path.parent.mkdir(parents=True, exist_ok=True)
    backend = JournalFileBackend(str(path), lock_obj=JournalFileOpenLock(str(path)))
    return JournalStorage(backend)


def _proxy(url: str) -> BaseStorage:
    from optuna.storages import GrpcStorageProxy

    parts = urlsplit(url)
    if not parts.hostname:
        raise UserError(f"--storage: which machine? {shown(url)} names none: grpc://HOST:PORT")
    return GrpcStorageProxy(host=parts.hostname, port=parts.port or _ANY_PORT)


def _database(url: str) -> BaseStorage:
    options = {}
    if url.startswith("sqlite"):
        options = {"connect_args": {"timeout": SECONDS_TO_WAIT}}
    # Optuna fills braces in.
    return _opened(url.replace("{", "{{").replace("}", "}}"), options, without_secret(url))


def _opened(url: str, options: dict[str, Any], name: str) -> BaseStorage:
    from optuna.exceptions import StorageInternalError
    from optuna.storages import RDBStorage
    from sqlalchemy.exc import SQLAlchemyError

    try:
        return RDBStorage(url, engine_kwargs=options)
    except (SQLAlchemyError, StorageInternalError, RuntimeError) as error:
        reason = without_secret(one_line(error).partition("(Background on")[0].strip())
        raise UserError(f"--storage {name}: cannot be opened: {reason}") from error
