"""Whether a backend is at work in a job folder: running.json names its process.

A process number alone is not enough, numbers are used again; where the system tells when a process began
(Linux: field 22 of /proc/PID/stat), that is kept beside it.
"""

from __future__ import annotations

import json
import os
import sys
from pathlib import Path

from .result import RUNNING_FILE


def process_start(pid: int) -> str | None:
    """When a process began, in the system's own unit; None where the system does not say."""
    try:
        text = Path(f"/proc/{pid}/stat").read_text(encoding="ascii", errors="replace")
    except OSError:
        return None
    return text.rpartition(")")[2].split()[19]


def is_alive(pid: int) -> bool:
    """Whether there is a process of this number (a zombie is none)."""
    if sys.platform == "win32":
        import ctypes

        handle = ctypes.windll.kernel32.OpenProcess(0x1000, False, pid)  # PROCESS_QUERY_LIMITED_INFORMATION
        if not handle:
            return False
        code = ctypes.c_ulong()
        ctypes.windll.kernel32.GetExitCodeProcess(handle, ctypes.byref(code))
        ctypes.windll.kernel32.CloseHandle(handle)
        return code.value == 259  # STILL_ACTIVE
    try:
        os.kill(pid, 0)
    except ProcessLookupError:
        return False
    except PermissionError:
        return True
    try:
        text = Path(f"/proc/{pid}/stat").read_text(encoding="ascii", errors="replace")
    except OSError:
        return True
    return text.rpartition(")")[2].split()[0] != "Z"


def mark_running(job_folder: str | os.PathLike[str]) -> None:
    """Write this process into the job folder."""
    data = {"pid": os.getpid(), "start": process_start(os.getpid())}
    path = Path(job_folder) / RUNNING_FILE
    part = path.with_name(path.name + ".part")
    part.write_text(json.dumps(data), encoding="utf-8")
    os.replace(part, path)


def unmark_running(job_folder: str | os.PathLike[str]) -> None:
    """Remove the mark."""
    (Path(job_folder) / RUNNING_FILE).unlink(missing_ok=True)


def running_pid(job_folder: str | os.PathLike[str]) -> int | None:
    """The process that works in the job folder now, None if there is none (a stale or damaged mark counts as none)."""
    try:
        data = json.loads((Path(job_folder) / RUNNING_FILE).read_text(encoding="utf-8"))
        pid, start = int(data["pid"]), data.get("start")
    except (OSError, ValueError, TypeError, KeyError, AttributeError, OverflowError, RecursionError):
        return None
    if not 0 < pid < 2**31 or not is_alive(pid):
        return None
    now = process_start(pid)
    return pid if start is None or now is None or start == now else None
