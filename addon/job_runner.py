"""One run of the backend as a child process: start it, take its events, stop it. Without bpy.

A thread reads the child's standard output into a queue, so that poll() never waits. The child's standard error goes to
log.txt in the job folder. Its standard input stays open as long as Blender lives: the end of it tells the backend that
Blender died, however it died.
"""

from __future__ import annotations

import contextlib
import enum
import os
import queue
import signal
import subprocess
import sys
import threading
import time
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field
from datetime import datetime
from pathlib import Path
from typing import IO, Any

from ..backend.contract import events, result
from ..backend.contract.errors import BackendError
from ..backend.contract.job import Job, checked_job
from ..backend.contract.running import running_pid

MAX_EVENTS_PER_POLL = 500  # decoded already; more would hold up Blender's redraw
MAX_WAITING_EVENTS = 2000  # beyond it the pipe fills and the backend waits
MAX_NOISE_BYTES = 1 << 20  # of lines that are no events, kept in the log
NOISE_PREFIX = "[stdout] "
PATIENCE_AFTER_CANCEL = 8.0  # s until a backend that ignores a cancel is ended
PATIENCE_AFTER_LAST = 3.0  # s until a backend that said its last word, or closed its output, is ended
PATIENCE_AFTER_EXIT = 1.0  # s to wait for output that a grandchild still holds open
TERMINATE_SECONDS = 0.8  # between asking and killing, when Blender closes
_FOREIGN_VARIABLES = ("PYTHONHOME", "PYTHONPATH", "PYTHONSTARTUP", "PYTHONEXECUTABLE", "__PYVENV_LAUNCHER__")


class RunState(enum.Enum):
    """Where a run stands. The last four are final: then the child is gone."""

    IDLE = "idle"
    RUNNING = "running"
    CANCELLING = "cancelling"
    DONE = "done"
    FAILED = "failed"
    CANCELLED = "cancelled"
    CRASHED = "crashed"

    @property
    def is_final(self) -> bool:
        return self in (RunState.DONE, RunState.FAILED, RunState.CANCELLED, RunState.CRASHED)


@dataclass(frozen=True, slots=True, kw_only=True)
class Backend:
    """Which Python runs which backend. root: the folder that holds `backend/`, so that both versions always match.

    variables: of the environment, that it gets besides.
    """

    python: str
    root: Path
    variables: Mapping[str, str] = field(default_factory=dict)

    def command(self, job_folder: Path) -> list[str]:
        return [self.python, "-m", "backend", "run", "--job", str(job_folder)]

    def environment(self) -> dict[str, str]:
        """Of the child. What a studio sets for Blender's own Python must not reach another Python."""
        kept = {name: value for name, value in os.environ.items() if name not in _FOREIGN_VARIABLES}
        return kept | {
            "PYTHONPATH": str(self.root),
            "PYTHONUTF8": "1",
            "PYTHONUNBUFFERED": "1",
            **self.variables,
        }


class JobRunner:
    """Runs one job once. poll() from a timer; close() when Blender or the add-on goes."""

    def __init__(self, backend: Backend, folder: Path) -> None:
        self.backend = backend
        self.folder = folder
        self.log = folder / result.LOG_FILE
        self.log_start = 0  # bytes of earlier runs in the log
        self.state = RunState.IDLE
        self.last_event: events.Event | None = None
        self._process: subprocess.Popen[bytes] | None = None
        self._reader: threading.Thread | None = None
        self._queue: queue.Queue[events.Event] = queue.Queue(MAX_WAITING_EVENTS)
        self._stop_reading = threading.Event()
        self._deadline: float | None = None
        self._exit_seen: float | None = None

    @property
    def pid(self) -> int | None:
        return self._process.pid if self._process else None

    @property
    def exit_code(self) -> int | None:
        return self._process.returncode if self._process else None

    def start(self, job: Job) -> None:
        """Write job.json and launch the backend on it. Raises BackendError if that cannot be."""
        if self.state is not RunState.IDLE:
            raise RuntimeError("a JobRunner runs once")
        checked_job(job)
        other = running_pid(self.folder)
        if other is not None:
            raise BackendError(
                "job_busy",
                f"Process {other} is at work in {self.folder}.",
                hint="Wait until it ends, or choose another output folder.",
            )
        try:
            write_job(self.folder, job)
            with open(self.log, "ab") as log:
                self.log_start = log.tell()
                command = self.backend.command(self.folder)
                log.write(f"--- {datetime.now():%Y-%m-%d %H:%M:%S} {' '.join(command)}\n".encode())
        except OSError as error:
            raise BackendError(
                "folder_unwritable",
                f"{self.folder} cannot be written to: {error.strerror or error}.",
                hint="Choose an output folder on a disk with room, where you may write.",
            ) from error
        self._launch(command)

    def _launch(self, command: list[str]) -> None:
        with open(self.log, "ab") as log:
            try:
                self._process = subprocess.Popen(
                    command,
                    stdin=subprocess.PIPE,
                    stdout=subprocess.PIPE,
                    stderr=log,
                    cwd=self.backend.root,
                    env=self.backend.environment(),
                    **group_options(),
                )
            except OSError as error:
                raise BackendError(
                    "backend_python_missing",
                    f"The backend's Python, {self.backend.python}, cannot be started: {error.strerror or error}.",
                    hint="Set its path in the add-on's preferences and press Check Backend.",
                ) from error
        self.state = RunState.RUNNING
        self._reader = threading.Thread(target=self._read, args=(self._process.stdout,), name="wildsmoke-events", daemon=True)
        self._reader.start()

    def poll(self) -> list[events.Event]:
        """The events since the last call, in order. Never waits; also finds out that the child ended."""
        if self._process is None or self.state.is_final:
            return []
        taken = [self._accept(event) for event in self._take()]
        self._settle(self._process)
        return [event for event in taken if event is not None]

    def _take(self) -> Iterator[events.Event]:
        for _ in range(MAX_EVENTS_PER_POLL):
            try:
                yield self._queue.get_nowait()
            except queue.Empty:
                return

    def _accept(self, event: events.Event) -> events.Event | None:
        """Note a last event; whatever follows it does not count. A backend of another protocol is an error."""
        if self.last_event is not None:
            return None
        if isinstance(event, events.Hello) and event.protocol != events.PROTOCOL_VERSION:
            self._give_until(0.0)  # no cancel: it speaks another language
            event = events.Error(
                code="protocol",
                message=f"The backend speaks protocol {event.protocol}, the add-on {events.PROTOCOL_VERSION}.",
                hint="Install the add-on again; it brings its own backend.",
            )
        if isinstance(event, events.LAST_EVENTS):
            self.last_event = event
            self._give_until(PATIENCE_AFTER_LAST)
        return event

    def _settle(self, process: subprocess.Popen[bytes]) -> None:
        """Move to a final state once the child is gone; end it where its time is up."""
        now = time.monotonic()
        has_all_output = self._reader is None or not self._reader.is_alive()
        if process.poll() is None:
            if has_all_output:
                self._give_until(PATIENCE_AFTER_LAST)
            if self._deadline is not None and now >= self._deadline:
                signal_group(process, force=True)
            return
        self._exit_seen = self._exit_seen or now
        if not self._queue.empty() or not (has_all_output or now - self._exit_seen > PATIENCE_AFTER_EXIT):
            return
        was_cancelling = self.state is RunState.CANCELLING
        self._end_process()
        self.state = final_state(self.last_event, was_cancelling)

    def _give_until(self, seconds: float) -> None:
        deadline = time.monotonic() + seconds
        self._deadline = deadline if self._deadline is None else min(self._deadline, deadline)

    def cancel(self) -> None:
        """Ask the backend to stop; what it computed is kept. It is ended if it does not."""
        if self.state is not RunState.RUNNING or self._process is None or self._process.stdin is None:
            return
        self.state = RunState.CANCELLING
        self._give_until(PATIENCE_AFTER_CANCEL)
        with contextlib.suppress(OSError):  # it has just ended by itself
            self._process.stdin.write(events.CANCEL_LINE.encode() + b"\n")
            self._process.stdin.flush()

    def close(self) -> None:
        """End the child and all that it started, within 2 s. At any time, more than once."""
        if self._process is None or self.state.is_final:
            return
        for event in self._take():
            self._accept(event)
        self._end_process()
        self.state = final_state(self.last_event, was_cancelling=True)

    def _end_process(self) -> None:
        """Close its input, terminate the group, kill the group, reap it."""
        process = self._process
        assert process is not None
        self._stop_reading.set()
        with contextlib.suppress(OSError):
            process.stdin.close()
        if process.poll() is None:
            signal_group(process, force=False)
            with contextlib.suppress(subprocess.TimeoutExpired):
                process.wait(TERMINATE_SECONDS)
        signal_group(process, force=True)  # also what it started itself and left behind
        with contextlib.suppress(subprocess.TimeoutExpired):
            process.wait(TERMINATE_SECONDS)
        if self._reader is not None:
            self._reader.join(0.2)
            if not self._reader.is_alive():
                process.stdout.close()

    def _read(self, stream: IO[bytes]) -> None:
        """In the thread: lines to events; what is no event goes to the log."""
        noise_left = MAX_NOISE_BYTES
        for line in bounded_lines(stream):
            try:
                event = events.decode(line)
            except events.ProtocolError:
                if line.strip() and noise_left > 0:
                    noise_left -= len(line)
                    self._log_noise(line)
                continue
            while not self._stop_reading.is_set():
                try:
                    self._queue.put(event, timeout=0.1)
                    break
                except queue.Full:
                    continue

    def _log_noise(self, line: bytes) -> None:
        with contextlib.suppress(OSError), open(self.log, "ab") as log:
            log.write(NOISE_PREFIX.encode() + line[:4096].rstrip(b"\r\n") + b"\n")


def final_state(last_event: events.Event | None, was_cancelling: bool) -> RunState:
    """What a stream that ended so amounts to."""
    match last_event:
        case events.Done():
            return RunState.DONE
        case events.Error():
            return RunState.FAILED
        case events.CancelledEvent():
            return RunState.CANCELLED
        case _:
            return RunState.CANCELLED if was_cancelling else RunState.CRASHED


def write_job(folder: Path, job: Job) -> None:
    """job.json, complete or not at all. The result of another job in the same folder ceases to be one."""
    folder.mkdir(parents=True, exist_ok=True)
    path, text = folder / result.JOB_FILE, job.to_json()
    if path.is_file() and path.read_text(encoding="utf-8", errors="replace") == text:
        return
    (folder / result.RESULT_FILE).unlink(missing_ok=True)
    part = path.with_name(path.name + ".part")
    with open(part, "w", encoding="utf-8", newline="\n") as handle:
        handle.write(text)
        handle.flush()
        os.fsync(handle.fileno())
    os.replace(part, path)


def bounded_lines(stream: IO[bytes]) -> Iterator[bytes]:
    """The lines of a stream; of one that is longer than an event may be, only the beginning (which is no event)."""
    limit = events.MAX_LINE_BYTES + 1
    is_continued = False
    while line := stream.readline(limit):
        if not is_continued:
            yield line
        is_continued = not line.endswith(b"\n")


def group_options(platform: str = sys.platform) -> dict[str, Any]:
    """Popen's arguments for a child that leads a group of its own, and opens no console window."""
    if platform == "win32":
        return {"creationflags": 0x00000200 | 0x08000000}  # CREATE_NEW_PROCESS_GROUP | CREATE_NO_WINDOW
    return {"start_new_session": True}


def signal_group(process: subprocess.Popen[bytes], *, force: bool) -> None:
    """Terminate or kill a child made with group_options, and its descendants. One that is gone is no error."""
    if sys.platform == "win32":
        if process.poll() is None:
            command = ["taskkill", "/PID", str(process.pid), "/T", "/F"]
            with contextlib.suppress(OSError, subprocess.TimeoutExpired):
                subprocess.run(command, capture_output=True, timeout=1.0, check=False, creationflags=0x08000000)
            if force and process.poll() is None:
                process.kill()
        return
    with contextlib.suppress(ProcessLookupError, PermissionError):  # macOS says EPERM of a group of zombies
        os.killpg(process.pid, signal.SIGKILL if force else signal.SIGTERM)
