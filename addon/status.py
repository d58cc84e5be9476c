"""What the panel says about a job: a value that each event turns into the next one. Without bpy."""

from __future__ import annotations

import enum
import math
from dataclasses import dataclass, replace

from ..backend.contract import events
from .job_runner import NOISE_PREFIX, RunState
from .job_state import JobKind, JobState

STAGE_LABELS = {
    "inspect": "Looking at the clip",
    "frames": "Reading the clip",
    "smoke": "Finding the smoke",
    "cameras": "Placing the camera",
    "volume": "Judging the depth",
    "physical": "Fitting the motion",
    "visual": "Fitting the look",
    "forecast": "Forecasting",
    "export": "Writing the volume",
}
RESUMING = "Resume goes on where it stopped."
MAX_SECONDS = 1e7  # nobody waits longer; also keeps absurd numbers out of the arithmetic


class Phase(enum.Enum):
    """Of a job, as the user sees it. BUSY: a process that is not ours works in the folder."""

    NONE = "none"
    STARTING = "starting"
    RUNNING = "running"
    CANCELLING = "cancelling"
    DONE = "done"
    FAILED = "failed"
    CANCELLED = "cancelled"
    CRASHED = "crashed"
    INTERRUPTED = "interrupted"
    BUSY = "busy"

    @property
    def is_active(self) -> bool:
        return self in (Phase.STARTING, Phase.RUNNING, Phase.CANCELLING)


@dataclass(frozen=True, slots=True, kw_only=True)
class JobStatus:
    """fraction: of the whole job, 0 to 1; seconds_left: of the stage, job_seconds_left: of all of it, None while unknown."""

    phase: Phase = Phase.NONE
    device: str = ""
    stage: str = ""
    stage_index: int = 0
    stage_count: int = 0
    fraction: float = 0.0
    seconds_left: float | None = None
    job_seconds_left: float | None = None
    code: str = ""
    message: str = ""
    hint: str = ""
    warnings: tuple[str, ...] = ()


def after(status: JobStatus, event: events.Event) -> JobStatus:
    """The status once an event has come."""
    match event:
        case events.Hello():
            return replace(status, device=event.device)
        case events.Stage():
            count = max(event.count, 1)
            index = min(max(event.index, 0), count)
            done = min(index + event.skipped, count)
            return replace(
                _moving(status),
                stage=event.name,
                stage_index=index,
                stage_count=count,
                fraction=_share(done, count),
                seconds_left=None,
                job_seconds_left=_seconds(event.job_seconds_left),
            )
        case events.Progress():
            count = max(status.stage_count, 1)
            within = _share(event.step, event.total)
            return replace(
                _moving(status),
                stage=event.stage,
                fraction=min((_share(status.stage_index, count)) + within * _share(1, count), 1.0),
                seconds_left=_seconds(event.seconds_left),
                job_seconds_left=_seconds(event.job_seconds_left),
            )
        case events.Warning():
            if event.message in status.warnings:
                return status
            return replace(status, warnings=(*status.warnings, event.message))
        case events.Done():
            return replace(status, fraction=1.0, seconds_left=None, job_seconds_left=None)
        case events.Error():
            return replace(
                status, code=event.code, message=event.message, hint=event.hint, seconds_left=None, job_seconds_left=None
            )
        case _:
            return status


def _moving(status: JobStatus) -> JobStatus:
    return replace(status, phase=Phase.RUNNING) if status.phase is Phase.STARTING else status


def _share(part: int, whole: int) -> float:
    """part / whole in 0 to 1, whatever the numbers."""
    if whole <= 0 or part <= 0:
        return 0.0
    return 1.0 if part >= whole else part / whole


def _seconds(value: float | None) -> float | None:
    return None if value is None else float(min(max(value, 0), MAX_SECONDS))


def ended(status: JobStatus, state: RunState, *, log_tail: list[str], log: str, exit_code: int | None) -> JobStatus:
    """The status of a run that came to its end."""
    match state:
        case RunState.DONE:
            return replace(status, phase=Phase.DONE, message="", hint="")
        case RunState.FAILED:
            return replace(status, phase=Phase.FAILED)
        case RunState.CANCELLED:
            return replace(status, phase=Phase.CANCELLED, message="", hint=RESUMING, seconds_left=None, job_seconds_left=None)
        case _:
            words = [line for line in log_tail if not line.startswith(NOISE_PREFIX)]
            reason = f" Its last words: {words[-1]}" if words else ""
            return replace(
                status,
                phase=Phase.CRASHED,
                message=f"The backend ended without a word (exit code {exit_code}).{reason}",
                hint=f"{RESUMING} The whole log: {log}",
                seconds_left=None,
                job_seconds_left=None,
            )


def found(state: JobState) -> JobStatus:
    """The status of a job folder that nobody here is working on."""
    match state.kind:
        case JobKind.FINISHED:
            return JobStatus(phase=Phase.DONE, fraction=1.0)
        case JobKind.RUNNING:
            return JobStatus(
                phase=Phase.BUSY,
                message=f"Process {state.pid} works in this folder.",
                hint="It was started elsewhere; this panel notices when it ends.",
            )
        case JobKind.INTERRUPTED:
            return JobStatus(
                phase=Phase.INTERRUPTED,
                message=state.problem or "The job stopped before its end.",
                hint="" if state.problem else RESUMING,
            )
        case _:
            return JobStatus()


_HEADLINES = {
    Phase.NONE: "Ready",
    Phase.STARTING: "Starting the backend",
    Phase.RUNNING: "Running",
    Phase.CANCELLING: "Stopping",
    Phase.DONE: "Finished",
    Phase.FAILED: "Failed",
    Phase.CANCELLED: "Cancelled",
    Phase.CRASHED: "The backend crashed",
    Phase.INTERRUPTED: "Interrupted",
    Phase.BUSY: "Busy",
}


def headline(status: JobStatus) -> str:
    """A few words on where the job stands."""
    if status.phase is Phase.RUNNING and status.stage:
        label = STAGE_LABELS.get(status.stage, status.stage.replace("_", " ").capitalize())
        return f"{label} ({status.stage_index + 1} of {status.stage_count})"
    return _HEADLINES[status.phase]


def progress_text(status: JobStatus) -> str:
    """For the bar: per cent, and the time that the job still takes, or at least the stage."""
    text = f"{math.floor(status.fraction * 100)} %"
    if status.job_seconds_left is not None:
        return f"{text}, {duration(status.job_seconds_left)} left"
    return text if status.seconds_left is None else f"{text}, {duration(status.seconds_left)} left in this stage"


def duration(seconds: float) -> str:
    """A time as a person says it."""
    whole = round(seconds)
    if whole < 60:
        return f"{whole} s"
    if whole < 3600:
        return f"{whole // 60} min {whole % 60:02d} s"
    return f"{whole // 3600} h {whole % 3600 // 60:02d} min"
