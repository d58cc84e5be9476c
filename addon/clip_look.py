"""What does a clip require, and what would each preset cost? Asks the backend in a process of its own. Without bpy."""

from __future__ import annotations

from dataclasses import dataclass

from ..backend.contract.estimates import Outlook, read_outlook
from ..backend.contract.job import Job
from .job_runner import Backend
from .question import Question

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


class ClipLook(Question[Look]):
    """One look at a clip."""

    def __init__(self, backend: Backend, job: Job, *, seconds: float = LOOK_SECONDS) -> None:
        self.job = job
        super().__init__(backend, inspect_command(backend, job), seconds=seconds, read=self._looked, failed=self._unseen)

    def _looked(self, output: bytes, errors: bytes) -> Look:
        try:
            return Look(job=self.job, outlook=read_outlook(output.decode(errors="replace")))
        except (ValueError, TypeError, KeyError, AttributeError, RecursionError):
            words = " ".join(errors.decode(errors="replace").split())
            return self._unseen(words[-MAX_WORDS:] or "The backend said nothing.")

    def _unseen(self, sentence: str) -> Look:
        return Look(job=self.job, outlook=None, problem=sentence)
