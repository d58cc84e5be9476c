"""The jobs of one Blender: at most one runs, others are known by their folders. Without bpy.

Everything here is called on Blender's main thread, from operators and from one timer.
"""

from __future__ import annotations

import os
import time
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

from ..backend.contract import events, result
from ..backend.contract.decisions import Decisions, read_decisions
from ..backend.contract.errors import BackendError
from ..backend.contract.job import Job
from .job_runner import Backend, JobRunner
from .job_state import JobState, read_tail
from .status import JobStatus, Phase, after, ended, found

LOG_LINES = 8  # shown in the panel
LOG_SECONDS = 0.5  # between two looks at the log of a running job
LOOK_SECONDS = 1.0  # between two looks at a folder where somebody else works


class Supervisor:
    """Starts, follows and ends the one run, and remembers what was found in job folders."""

    def __init__(self) -> None:
        self.runner: JobRunner | None = None
        self._statuses: dict[Path, JobStatus] = {}
        self._logs: dict[Path, list[str]] = {}
        self._decisions: dict[Path, Decisions] = {}
        self._finished: list[Path] = []
        self._next_log = 0.0
        self._next_look = 0.0

    @property
    def running_folder(self) -> Path | None:
        """Where our backend is at work."""
        return self.runner.folder if self.runner is not None and not self.runner.state.is_final else None

    @property
    def needs_ticks(self) -> bool:
        """Whether there is something to follow."""
        return self.running_folder is not None or any(status.phase is Phase.BUSY for status in self._statuses.values())

    def status(self, folder: Path | None) -> JobStatus:
        return self._statuses.get(folder, JobStatus()) if folder else JobStatus()

    def log_lines(self, folder: Path | None) -> list[str]:
        return self._logs.get(folder, []) if folder else []

    def decisions(self, folder: Path | None) -> Decisions | None:
        """What a job follows; None where it has none yet."""
        return self._decisions.get(folder) if folder else None

    def _read_decisions(self, folder: Path) -> None:
        try:
            self._decisions[folder] = read_decisions(folder)
        except BackendError:
            self._decisions.pop(folder, None)  # none yet, or damaged: the job then makes them anew

    def shown(self) -> tuple[dict[Path, JobStatus], dict[Path, list[str]]]:
        """All that a panel may show, to compare with what it was."""
        return dict(self._statuses), dict(self._logs)

    def look(self, folder: Path) -> JobStatus:
        """See what a job folder holds. What our own run says of its folder is better, and stays."""
        if folder != self.running_folder:
            self._statuses[folder] = found(JobState.find(folder))
            self._logs[folder] = read_tail(folder / result.LOG_FILE, max_lines=LOG_LINES)
            self._read_decisions(folder)
        return self._statuses[folder]

    def start(self, backend: Backend, folder: Path, job: Job) -> None:
        """Begin a job. Raises BackendError, which the panel then shows, too."""
        if self.running_folder is not None:
            raise BackendError(
                "job_running", f"A job is running in {self.running_folder}.", hint="Wait for it to end, or cancel it."
            )
        runner = JobRunner(backend, folder)
        try:
            runner.start(job)
        except BackendError as error:
            self._statuses[folder] = JobStatus(phase=Phase.FAILED, code=error.code, message=error.message, hint=error.hint)
            raise
        self.runner = runner
        self._statuses[folder] = JobStatus(phase=Phase.STARTING)
        self._logs[folder] = []

    def tick(self) -> list[events.Event]:
        """Take in what happened since the last tick."""
        taken = self._follow(self.runner) if self.running_folder is not None and self.runner is not None else []
        now = time.monotonic()
        if now >= self._next_look:
            self._next_look = now + LOOK_SECONDS
            for folder in [folder for folder, status in self._statuses.items() if status.phase is Phase.BUSY]:
                self.look(folder)
        return taken

    def _follow(self, runner: JobRunner) -> list[events.Event]:
        folder = runner.folder
        taken = runner.poll()
        status = self._statuses[folder]
        for event in taken:
            status = after(status, event)
            if isinstance(event, events.Artifact) and event.kind == "decisions":
                self._read_decisions(folder)
        now = time.monotonic()
        if runner.state.is_final or now >= self._next_log:
            self._next_log = now + LOG_SECONDS
            self._logs[folder] = read_tail(runner.log, max_lines=LOG_LINES, start=runner.log_start)
        if runner.state.is_final:
            status = ended(status, runner.state, log_tail=self._logs[folder], log=str(runner.log), exit_code=runner.exit_code)
            if status.phase is Phase.DONE:
                self._finished.append(folder)
        self._statuses[folder] = status
        return taken

    def run_to_end(self, on_event: Callable[[events.Event], None]) -> JobStatus:
        """Follow the run until it ends, for Blender in background mode. An interrupt ends the child."""
        assert self.runner is not None
        runner = self.runner
        try:
            while not runner.state.is_final:
                for event in self.tick():
                    on_event(event)
                time.sleep(0.02)
        finally:
            runner.close()
        return self._statuses[runner.folder]

    def take_finished(self) -> list[Path]:
        """Folders of runs that succeeded since the last call, to import."""
        taken, self._finished = self._finished, []
        return taken

    def note(self, folder: Path, error: BackendError) -> None:
        """Show an error beside what else is known of a folder."""
        self._statuses[folder] = replace(self.status(folder), code=error.code, message=error.message, hint=error.hint)

    def cancel(self) -> bool:
        """Ask the run to stop; whether there was one."""
        folder = self.running_folder
        if folder is None or self.runner is None:
            return False
        self.runner.cancel()
        self._statuses[folder] = replace(self._statuses[folder], phase=Phase.CANCELLING)
        return True

    def close(self) -> None:
        """End the run, because Blender or the add-on goes."""
        if self.runner is not None:
            self.runner.close()
            self.runner = None
        self._statuses.clear()
        self._logs.clear()
        self._decisions.clear()
        self._finished.clear()


def as_folder(path: str | os.PathLike[str]) -> Path:
    """One spelling for each folder, so that it can be compared."""
    return Path(os.path.abspath(os.path.expanduser(path)))
