"""What a job folder holds, for a .blend that is opened again. Without bpy."""

from __future__ import annotations

import enum
import os
from dataclasses import dataclass
from pathlib import Path

from ..backend.contract import result
from ..backend.contract.errors import BackendError
from ..backend.contract.job import read_job
from ..backend.contract.running import running_pid

MAX_TAIL_BYTES = 16 << 10


class JobKind(enum.Enum):
    """none: no job; running: a process is at work; finished: there is a result; interrupted: neither."""

    NONE = "none"
    RUNNING = "running"
    FINISHED = "finished"
    INTERRUPTED = "interrupted"


@dataclass(frozen=True, slots=True, kw_only=True)
class JobState:
    """A job folder as it was found. pid: of the process at work; problem: what is damaged, and what to do."""

    kind: JobKind
    pid: int | None = None
    problem: str = ""

    @classmethod
    def find(cls, job_folder: str | os.PathLike[str]) -> JobState:
        """Look. A process that an earlier Blender started saw the end of its input and is stopping, or has stopped:
        it counts as running only as long as it lives, under the same number and with the same beginning."""
        folder = Path(job_folder)
        if not (folder / result.JOB_FILE).is_file():
            return cls(kind=JobKind.NONE)
        pid = running_pid(folder)
        if pid is not None:
            return cls(kind=JobKind.RUNNING, pid=pid)
        try:
            read_job(folder / result.JOB_FILE)
            if not (folder / result.RESULT_FILE).is_file():
                return cls(kind=JobKind.INTERRUPTED)
            result.read_result(folder)
        except BackendError as error:
            return cls(kind=JobKind.INTERRUPTED, problem=str(error))
        return cls(kind=JobKind.FINISHED)


def read_tail(path: str | os.PathLike[str], *, max_lines: int, start: int = 0) -> list[str]:
    """The last lines of a log, none from before byte `start`; no lines if there is no such file."""
    try:
        with open(path, "rb") as handle:
            size = handle.seek(0, os.SEEK_END)
            start = start if start <= size else 0  # someone emptied the log
            begin = handle.seek(max(start, size - MAX_TAIL_BYTES))
            data = handle.read(MAX_TAIL_BYTES)
    except OSError:
        return []
    lines = data.decode("utf-8", errors="replace").splitlines()
    if begin > start and len(lines) > 1:
        lines = lines[1:]  # the first one was cut
    return [line.rstrip() for line in lines if line.strip()][-max_lines:]
