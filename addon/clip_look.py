"""What does a clip require, and what would each preset cost? Asks the backend in a process of its own. Without bpy."""

from __future__ import annotations

import contextlib
import subprocess
import threading
from dataclasses import dataclass

from ..backend.contract.estimates import Outlook, read_outlook
from ..backend.contract.job import Job
from .job_runner import Backend, group_options, signal_group

LOOK_SECONDS = 600.0  # a first run compiles its kernels and measures the machine
MAX_WORDS = 400  # characters of what a backend that failed said


@dataclass(frozen=True, slots=True, kw_only=True)
class Look:
    """What a look found. job: the one that it is true for; outlook: None where there is a problem."""

    job: Job
    outlook: Outlook | None
    problem: str = ""


def inspect_command(backend: Backend, job: Job) -> list[str]:
    """`inspect` with all that it depends on."""
    command = [backend.python, "-m", "backend", "inspect", job.video, "--json", "--preset", job.preset]
    if job.cameras is not None:
        command += ["--cameras", job.cameras]
    if job.frame_start is not None or job.frame_stop is not None:
        command += ["--frames", f"{job.frame_start or 0}:{'' if job.frame_stop is None else job.frame_stop}"]
    for key, value in job.overrides.items():
        command += ["--set", f"{key}={value}"]
    return command


class ClipLook:
    """One look in a thread. poll() gives what was found once it is there; close() ends it early."""

    def __init__(self, backend: Backend, job: Job, *, seconds: float = LOOK_SECONDS) -> None:
        self.job = job
        self._backend = backend
        self._seconds = seconds
        self._process: subprocess.Popen[bytes] | None = None
        self._found: Look | None = None
        self._thread = threading.Thread(target=self._work, name="wildsmoke-look", daemon=True)
        self._launch()

    def _launch(self) -> None:
        try:
            self._process = subprocess.Popen(
                inspect_command(self._backend, self.job),
                stdin=subprocess.DEVNULL,
                stdout=subprocess.PIPE,
                stderr=subprocess.PIPE,
                cwd=self._backend.root,
                env=self._backend.environment(),
                **group_options(),
            )
        except OSError as error:
            self._found = self._failed(f"{self._backend.python} cannot be started: {error.strerror or error}")
            return
        self._thread.start()

    def _work(self) -> None:
        process = self._process
        assert process is not None
        try:
            output, errors = process.communicate(timeout=self._seconds)
        except subprocess.TimeoutExpired:
            signal_group(process, force=True)
            process.communicate()
            self._found = self._failed(f"The backend gave no answer within {self._seconds:.0f} s.")
            return
        self._found = self._read(output, errors)

    def _read(self, output: bytes, errors: bytes) -> Look:
        try:
            return Look(job=self.job, outlook=read_outlook(output.decode(errors="replace")))
        except (ValueError, TypeError, KeyError, AttributeError, RecursionError):
            words = " ".join(errors.decode(errors="replace").split())
            return self._failed(words[-MAX_WORDS:] or "The backend said nothing.")

    def _failed(self, sentence: str) -> Look:
        return Look(job=self.job, outlook=None, problem=sentence)

    def poll(self) -> Look | None:
        """What was found, None while the look is at work. Never waits."""
        return self._found

    def wait(self) -> Look:
        """What was found, waited for: for Blender in background mode."""
        if self._thread.is_alive():
            self._thread.join()
        assert self._found is not None
        return self._found

    def close(self) -> None:
        """End the look."""
        if self._process is not None and self._process.poll() is None:
            signal_group(self._process, force=True)
            with contextlib.suppress(subprocess.TimeoutExpired):
                self._process.wait(1.0)
