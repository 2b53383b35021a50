"""Who is at work on something, and whether that process is still there.

A number alone does not name a process: numbers are used again, after a reboot, in each container
and on each machine that shares a folder. On Linux, what names one is the number with the time it
began, in ticks since the machine booted, which no change of the clock moves; the identity of that
boot; and the namespace that the number belongs to. Elsewhere it is the number on that host, and a
process that was given it anew passes for the one before.
"""

from __future__ import annotations

import hashlib
import os
import platform
import sys
from collections.abc import Mapping
from pathlib import Path
from typing import Any

_BOOT = "/proc/sys/kernel/random/boot_id"
_MACHINES = ("/etc/machine-id", "/var/lib/dbus/machine-id")
_STATE, _BEGAN = 0, 19  # places in /proc/<pid>/stat, counted from behind the program's name
_ENDED = "ZXx"


def mark() -> dict[str, Any]:
    """What names this process, as JSON holds it; what the platform does not tell is None."""
    pid = os.getpid()
    return {
        "pid": pid,
        "host": platform.node(),
        "machine": _machine(),
        "boot": _first_line(_BOOT),
        "namespace": _pid_namespace(),
        "began": _ticks_at_begin(pid),
    }


def is_alive(record: object) -> bool | None:
    """Whether the process that a `mark` names is still there.

    Args:
        record: the mark, as it was read from a file: anything.

    Returns:
        None where one cannot tell: of another host, of another container, of what is no mark.
    """
    if not isinstance(record, Mapping):
        return None
    pid = record.get("pid")
    if not isinstance(pid, int) or isinstance(pid, bool) or not 0 < pid < 2**31:
        return None
    boot, is_same_host = _first_line(_BOOT), record.get("host") == platform.node()
    if boot is None or record.get("boot") is None:
        if boot is not None or record.get("boot") is not None or not is_same_host:
            return None
        return _has_process(pid)
    if record.get("boot") != boot:
        machine = _machine()
        is_same_machine = machine is not None and record.get("machine") == machine
        return False if is_same_host and is_same_machine else None
    if record.get("namespace") != _pid_namespace():
        return None
    began = _ticks_at_begin(pid)
    if began is None or record.get("began") is None:  # gone, or hidden from this user
        return _has_process(pid)
    return began == record.get("began")


def _first_line(*files: str) -> str | None:
    for file in files:
        try:
            line = Path(file).read_text(encoding="utf-8", errors="replace").partition("\n")[0]
        except OSError:
            continue
        if line.strip():
            return line.strip()
    return None


def _machine() -> str | None:
    """What the machine is told apart by: a digest, since the identity itself is not for others."""
    identity = _first_line(*_MACHINES)
    return identity and hashlib.sha256(f"yardstick {identity}".encode()).hexdigest()[:32]


def _pid_namespace() -> str | None:
    try:
        return os.readlink("/proc/self/ns/pid")  # noqa: PTH115  # it leads to no path
    except OSError:
        return None


def _ticks_at_begin(pid: int) -> int | None:
    """When the process began, by the kernel's ticks since the boot; -1 for one that has ended."""
    try:
        text = Path(f"/proc/{pid}/stat").read_text(encoding="utf-8", errors="replace")
    except OSError:
        return None
    # The program's name stands in brackets, and may hold some itself.
    fields = text.rpartition(")")[2].split()
    if len(fields) <= _BEGAN:
        return None
    return -1 if fields[_STATE] in _ENDED else int(fields[_BEGAN])


if sys.platform == "win32":
    import _winapi

    def _has_process(pid: int) -> bool:
        # Here `os.kill` would end the process or send Ctrl-C to it, whatever the signal.
        try:
            process = _winapi.OpenProcess(_winapi.SYNCHRONIZE, False, pid)
        except PermissionError:
            return True
        except OSError:
            return False
        try:
            return _winapi.WaitForSingleObject(process, 0) == _winapi.WAIT_TIMEOUT
        finally:
            _winapi.CloseHandle(process)
else:

    def _has_process(pid: int) -> bool:
        try:
            os.kill(pid, 0)
        except ProcessLookupError:
            return False
        except PermissionError:
            return True
        return True
