"""Records SHA-256 digests of a run's files in ``run.json`` (``files``), and checks them.

The entry of ``run.json`` itself is the digest of its other contents, as JSON without spaces and
with sorted keys. Files without a digest are the user's own. Runs of earlier versions have neither
this field nor ``record_version``, which is written at the start: their files are not checked.
"""

from __future__ import annotations

import hashlib
import io
import json
import warnings
import zipfile
from collections.abc import Collection, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass
from fnmatch import fnmatchcase
from functools import cache
from pathlib import Path
from typing import TYPE_CHECKING, Any

from rl_yardstick.pipeline.errors import UserError, one_line
from rl_yardstick.pipeline.files import files_below, plain
from rl_yardstick.safe_files.files import NO_LIMIT, Budget, UnsafeFileError, opened, read_file

if TYPE_CHECKING:
    from numpy.typing import NDArray

RECORD = "run.json"
FIELD = "files"
LOCK = ".lock"  # of the running process
STATE_FOLDER = "state"  # saved states, which are not part of a run's results
VERSION_FIELD = "record_version"
VERSION = 2  # of records with digests; earlier records had no such field
# States of a run without digests.
_UNDER_WAY = ("running", "failed")
LARGEST_RECORD = 64 << 20  # bytes
LARGEST_READ = 2 << 30  # bytes, of a file that is read as a whole
_PIECE = 1 << 20  # bytes
_DEEPEST_RECORD = 100  # nested lists and objects

MOST_ARRAYS = 1000  # in an archive
_KINDS = "biuf"  # booleans, integers, floats
_METHODS = (zipfile.ZIP_STORED, zipfile.ZIP_DEFLATED)


class DamagedFileError(UserError):
    """The file at ``path`` is missing, or differs from the file that the run wrote."""

    def __init__(self, path: Path, reason: str) -> None:
        super().__init__(f"{path} {reason}")
        self.path = path


@dataclass(frozen=True)
class RecordedFiles:
    """Reads the files of a run, checked against the recorded digests."""

    folder: Path  # the run folder
    # by name relative to the folder; None if the run recorded no digests
    digests: Mapping[str, str] | None

    def matching(self, pattern: str) -> list[Path]:
        """The run's files in the folder itself whose names match a pattern of `fnmatch`."""
        if self.digests is None:
            return sorted(self.folder.glob(pattern))
        names = (name for name in self.digests if "/" not in name and fnmatchcase(name, pattern))
        return [self.folder / name for name in sorted(names)]

    def read(self, path: Path, limit: int = LARGEST_READ) -> bytes:
        """Read a whole file of at most ``limit`` bytes, and check its digest."""
        with _as_damage(path):
            content = read_file(path, limit)
        recorded = self._recorded(path)
        if recorded is not None and hashlib.sha256(content).hexdigest() != recorded:
            raise DamagedFileError(path, "has changed since the run wrote it")
        return content

    def check(self, path: Path) -> None:
        """Check the digest of a file that may be larger than memory."""
        recorded = self._recorded(path)
        with _as_damage(path):
            if recorded is not None and digest_of(path) != recorded:
                raise DamagedFileError(path, "has changed since the run wrote it")

    def _recorded(self, path: Path) -> str | None:
        """The recorded digest of a file; None if there is none, or the file is not the run's."""
        # Resolves only the folder, because the file itself may be somebody's link.
        if self.digests is None:
            return None
        if path.is_relative_to(self.folder):
            return self.digests.get(path.relative_to(self.folder).as_posix())
        place = path.parent.resolve() / path.name
        folder = self.folder.resolve()
        if not place.is_relative_to(folder):
            return None
        return self.digests.get(place.relative_to(folder).as_posix())


def digests_of(folder: Path) -> dict[str, str]:
    """The digests of all files of a run folder except ``run.json``, by relative name."""
    paths = [path for path in sorted(files_below(folder)) if path.parent != folder / STATE_FOLDER]
    names = {path.relative_to(folder).as_posix(): path for path in paths}
    return {
        name: digest_of(path)
        for name, path in names.items()
        if name not in (RECORD, LOCK) and not (path.name.startswith(".") and path.suffix == ".tmp")
    }


def digest_of(path: Path) -> str:
    """The digest of a regular file."""
    digest = hashlib.sha256()
    with opened(path, NO_LIMIT) as file:
        while piece := file.read(_PIECE):
            digest.update(piece)
    return digest.hexdigest()


def sealed(record: Mapping[str, Any]) -> dict[str, Any]:
    """The record with its own digest, if it contains digests of the run's files."""
    if FIELD not in record:
        return dict(record)
    whole: dict[str, Any] = plain(record)
    return {**whole, FIELD: {**whole[FIELD], RECORD: _seal(whole)}}


def read_record(path: Path) -> dict[str, Any]:
    """Read a ``run.json``, and check its digest."""
    try:
        content = read_file(path, LARGEST_RECORD)
        Budget(len(content)).charge_json(content)
        record = json.loads(content)
    except FileNotFoundError:
        raise
    except (OSError, UnsafeFileError):
        with _as_damage(path):
            raise
    except (ValueError, RecursionError) as error:
        raise DamagedFileError(path, f"is damaged: {one_line(error)}") from error
    if not isinstance(record, dict):
        raise DamagedFileError(path, "is damaged: it must map names to values")
    if _is_too_deep(record):
        raise DamagedFileError(path, "is damaged: it is nested too deeply")
    has_ended = record.get("state") not in _UNDER_WAY
    if VERSION_FIELD in record and FIELD not in record and has_ended:
        raise DamagedFileError(path, "is damaged: it has lost the digests of the run's files")
    if FIELD in record:
        files = record[FIELD]
        has_digests = isinstance(files, dict) and all(isinstance(d, str) for d in files.values())
        if not has_digests or files.get(RECORD) != _seal(record):
            raise DamagedFileError(path, "is damaged: it has changed since the run wrote it")
    return record


@contextmanager
def _as_damage(path: Path) -> Iterator[None]:
    try:
        yield
    except FileNotFoundError as error:
        raise DamagedFileError(path, "is missing") from error
    except OSError as error:
        raise DamagedFileError(path, f"cannot be read: {error.strerror}") from error
    except UnsafeFileError as error:
        raise DamagedFileError(path, str(error).removeprefix(f"{path} ")) from error


# The packages that define the objects and records of a training.
OF_TRAINING = ("safe_files", "machine_code", "mdp", "envs", "agents", "pipeline")


@cache
def source_digest(*more: str) -> str:
    """The digest of the sources of `OF_TRAINING` and ``more``; cached at the first call."""
    from rl_yardstick.machine_code.sources import content_lines, source_paths
    from rl_yardstick.machine_code.sources import digest_of as digest_of_lines

    return digest_of_lines(content_lines(source_paths({*OF_TRAINING, *more})))


def _seal(record: Mapping[str, Any]) -> str:
    files = {name: digest for name, digest in record[FIELD].items() if name != RECORD}
    text = json.dumps({**record, FIELD: files}, sort_keys=True, separators=(",", ":"))
    return hashlib.sha256(text.encode()).hexdigest()


def _is_too_deep(value: Any) -> bool:
    level = [value]
    for _ in range(_DEEPEST_RECORD):
        inner = [item.values() if isinstance(item, dict) else item for item in level]
        level = [child for items in inner for child in items if isinstance(child, dict | list)]
        if not level:
            return False
    return True


def read_arrays(path: Path, content: bytes) -> dict[str, NDArray[Any]]:
    """Read the arrays of numbers in a NumPy archive, by name."""
    import numpy as np
    from numpy.lib.npyio import NpzFile

    try:
        with (
            warnings.catch_warnings(action="error"),
            NpzFile(io.BytesIO(content), allow_pickle=False) as archive,
        ):
            assert archive.zip is not None  # it is open
            infos = archive.zip.infolist()
            if len({info.filename for info in infos}) != len(infos) or len(infos) > MOST_ARRAYS:
                raise ValueError("it holds an array twice, or too many of them")
            if not all(info.compress_type in _METHODS for info in infos):
                raise ValueError("it is compressed in a way that is not read here")
            # Charged: the bytes, the bytes without the header, and the array.
            Budget(len(content)).charge(3 * sum(info.file_size for info in infos))
            arrays = {name: archive[name] for name in archive.files}
            for array in arrays.values():
                if not isinstance(array, np.ndarray):
                    raise ValueError("it holds something that is not an array")
                if array.dtype.kind not in _KINDS:
                    raise ValueError(f"it holds {array.dtype} where numbers belong")
            return arrays
    except Exception as error:  # for damaged files, zipfile and NumPy may raise anything
        raise DamagedFileError(path, f"is damaged: {one_line(error)}") from error


def read_shaped(
    path: Path, content: bytes, shapes: Mapping[str, str], optional: Collection[str] = ()
) -> dict[str, NDArray[Any]]:
    """Like `read_arrays`, with checked shapes: axes of the same name have the same length."""
    arrays = read_arrays(path, content)
    lengths: dict[str, int] = {}
    for name, shape in shapes.items():
        if name not in arrays:
            if name in optional:
                continue
            raise DamagedFileError(path, f"is damaged: it lacks {name}")
        axes, found = shape.split(), arrays[name].shape
        wanted = [
            int(axis) if axis.isdigit() else lengths.setdefault(axis, n)
            for axis, n in zip(axes, found, strict=False)
        ]
        if len(axes) != len(found) or tuple(wanted) != found:
            raise DamagedFileError(path, "is damaged: its arrays do not fit each other")
    return arrays
