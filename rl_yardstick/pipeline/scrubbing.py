"""Removes private data from packs: paths of this machine, with names in them, and secrets."""

from __future__ import annotations

import base64
import gzip
import io
import json
import re
import zipfile
import zlib
from collections.abc import Iterable, Mapping
from pathlib import Path, PurePosixPath, PureWindowsPath
from typing import Any

from rl_yardstick.pipeline.errors import UserError
from rl_yardstick.pipeline.runs import Run
from rl_yardstick.safe_files.archives import read_members

# Fields of a spec with paths or code of the run's machine.
_PLACES: Mapping[str, Any] = {
    "log_folder": "logs",
    "tensorboard_log": None,
    "trained_agent": None,
    "watch_learning": None,
    "user_modules": [],
}
# Fields of ``run.json`` with results, but without paths.
_TOLD_OF_RUN = ("state", "record_version", "env_name", "versions", "n_timesteps", "final")
_TOLD_OF_BEST = ("best_mean_return", "best_timesteps", "best_episodes")
_TOLD = (*_TOLD_OF_RUN, *_TOLD_OF_BEST, "engine", "regret", "pulls")
_DATE = (1980, 1, 1, 0, 0, 0)
_SERIALIZED = re.compile(rb'":serialized:": "([A-Za-z0-9+/=]*)"')
_SCRIPT = re.compile(rb"(<script\b.*?</script>)", re.DOTALL)
# The data of a page: gzip in base64.
_SIGN = rb"[A-Za-z0-9+/]"
_PACKED = re.compile(rb">(H4sI(?:%b{4})*(?:%b{3}=|%b{2}==)?)<" % (_SIGN, _SIGN, _SIGN))
_LARGEST = 64 << 20  # bytes
_SECRET = re.compile(r"passw|secret|token|credential|api_?key", re.IGNORECASE)
_SHORTEST = 4  # characters of a path to search for; "/" alone is everywhere


def without_places(value: Any) -> Any:
    """Settings with absolute paths and paths from a home folder shortened to the file's name."""
    if isinstance(value, str):
        windows = PureWindowsPath(value)
        if windows.is_absolute() or windows.drive or value.startswith("~"):
            return windows.name
        return PurePosixPath(value).name if value.startswith("/") else value
    if isinstance(value, dict):
        return {key: without_places(item) for key, item in value.items()}
    return [*map(without_places, value)] if isinstance(value, list | tuple) else value


def record_to_tell(info: Mapping[str, Any]) -> dict[str, Any]:
    """A ``run.json`` without private data, still without digests."""
    spec = info["spec"]
    told = {name: info[name] for name in _TOLD if name in info}
    hyperparams = without_places(spec["hyperparams"])
    known = {name: value for name, value in _PLACES.items() if name in spec}
    return {**told, "spec": {**spec, **known, "hyperparams": hyperparams}}


def check_secrets(settings: Any, place: str = "hyperparams") -> None:
    """Refuse settings that look like secrets."""
    if isinstance(settings, dict):
        for key, value in settings.items():
            if isinstance(value, str) and value and _SECRET.search(str(key)):
                what = f"{place}.{key} looks like a secret, and a pack holds all settings"
                how = "train without it (environment variables are not recorded)"
                raise UserError(f"{what}: {how}")
            check_secrets(value, f"{place}.{key}")
    elif isinstance(settings, list | tuple):
        for item in settings:
            check_secrets(item, place)


def zip_to_tell(content: bytes) -> bytes:
    """A model's zip without the folder of its TensorBoard log; unchanged if it has none."""
    members = dict(read_members(content))
    data = json.loads(members["data"])
    if not data.get("tensorboard_log"):
        return content
    members["data"] = json.dumps({**data, "tensorboard_log": None}, indent=4).encode()
    return zipped(members)


def zipped(members: Mapping[str, bytes]) -> bytes:
    """A zip of these members, with reproducible bytes."""
    stream = io.BytesIO()
    with zipfile.ZipFile(stream, "w") as archive:
        for name, content in members.items():
            archive.writestr(member_of(name), content)
    return stream.getvalue()


def member_of(name: str) -> zipfile.ZipInfo:
    """A member of a zip, without time and system of its creation."""
    return zipfile.ZipInfo(name, _DATE)


def names_alone(name: str, content: bytes, run: Run) -> bytes:
    """A page or table with this machine's paths shortened to file names."""
    if not name.endswith(".html"):
        return _without_paths(content, run)
    parts = _SCRIPT.split(content)
    for place, part in enumerate(parts):
        if place % 2 == 0:
            parts[place] = _without_paths(part, run)
        else:  # the page's own script, or packed data
            parts[place] = _PACKED.sub(lambda found: _packed_anew(found[1], run), part)
    return b"".join(parts)


def _packed_anew(packed: bytes, run: Run) -> bytes:
    text = _unpacked(base64.b64decode(packed))
    told = text if len(text) == _LARGEST else _without_paths(text, run)
    return b">%b<" % (packed if told == text else base64.b64encode(gzip.compress(told, mtime=0)))


def _unpacked(content: bytes) -> bytes:
    """Unpack gzip data up to a limit; empty if it is not gzip."""
    try:
        return zlib.decompressobj(zlib.MAX_WBITS | 16).decompress(content, _LARGEST)
    except zlib.error:
        return b""


def _without_paths(text: bytes, run: Run) -> bytes:
    for place in _places_of(run):
        for way in {place, place.replace(b"_", rb"\_")}:  # the escaped form in Markdown and LaTeX
            path = rb"(?<![\w.])%b(?:[/\\]+[^\s\"'<>&|,;:/\\]*)*(?![\w.-])" % re.escape(way)
            text = re.sub(path, lambda found: re.split(rb"[/\\](?!_)", found[0])[-1], text)
    return text


def check_untold(files: Mapping[str, bytes], run: Run) -> None:
    """Search all files, including models and pages, for paths of this machine."""
    places = _places_of(run)
    for name, content in files.items():
        for piece in _pieces(name, content):
            if found := next((place for place in places if place in piece), None):
                what = f"{found.decode(errors='replace')!r}, a place on this machine"
                raise UserError(f"{name} names {what}: nothing was packed")


def _places_of(run: Run) -> list[bytes]:
    """Folders specific to this machine: the user's home, the run's folder, and modules."""
    spec = run.recorded_spec()
    named = [spec.get(name) for name in ("log_folder", "tensorboard_log", "trained_agent")]
    named += [m.get("path") for m in spec.get("user_modules") or () if isinstance(m, dict)]
    paths = [Path.home(), Path.cwd(), run.path.resolve().parent]
    paths += [Path(text) for text in named if isinstance(text, str)]
    texts = {str(path) for path in paths if path.is_absolute()}
    return sorted((text.encode() for text in texts if len(text) >= _SHORTEST), key=len)[::-1]


def _pieces(name: str, content: bytes) -> Iterable[bytes]:
    yield content
    if name.endswith(".zip"):
        for member in read_members(content).values():
            yield member
            yield from (base64.b64decode(text) for text in _SERIALIZED.findall(member))
    if name.endswith(".gz"):
        yield _unpacked(content)
    for text in _PACKED.findall(content) if name.endswith(".html") else ():
        yield _unpacked(base64.b64decode(text))
