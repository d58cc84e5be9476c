"""Where events go: JSON lines in a pipe, a progress display in a terminal; and where a request to stop comes from."""

from __future__ import annotations

import os
import sys
import threading
import time
from pathlib import Path
from typing import IO, Protocol

from rich.console import Console
from rich.markup import escape
from rich.progress import BarColumn, Progress, TextColumn, TimeElapsedColumn

from backend.contract import events
from backend.contract.decisions import read_decisions
from backend.contract.errors import Cancelled
from backend.contract.estimates import read_estimate
from backend.estimate.time_left import TimeLeft

STOP_AFTER_ORPHANED = 0.8  # seconds a step may still take once Blender is gone; all must be over within two
STOP_AFTER_CANCEL = 5.0  # seconds a step may still take after a cancel


class EventSink(Protocol):
    """Takes the events of a run in order."""

    def send(self, event: events.Event) -> None: ...

    def close(self) -> None:
        """The command is over, whether or not it had a last event."""
        ...


class PipeSink:
    """JSON lines on what was standard output; everything else that prints goes to standard error from now on."""

    def __init__(self) -> None:
        sys.stdout.flush()
        self._stream: IO[str] = os.fdopen(os.dup(1), "w", encoding="utf-8", newline="\n")
        os.dup2(2, 1)
        self._lock = threading.Lock()
        self._is_closed = False

    def send(self, event: events.Event) -> None:
        with self._lock:
            if self._is_closed:
                return
            self._is_closed = isinstance(event, events.LAST_EVENTS)
            try:
                self._stream.write(events.encode(event) + "\n")
                self._stream.flush()
            except (BrokenPipeError, ValueError):
                self._is_closed = True  # nobody listens any more; the end of standard input will stop the work

    def close(self) -> None:
        """Every event was flushed when it was sent."""


class TerminalSink:
    """What was decided and how long it may take, then a line a stage with its bar and the time left, in it and in all.

    job: the folder whose files the events name, None where there is none.
    """

    def __init__(self, job: Path | None = None) -> None:
        self._job = job
        self._console = Console(stderr=True, highlight=False)
        self._progress = Progress(
            TextColumn("{task.description:<10}"),
            BarColumn(bar_width=30),
            TextColumn("{task.completed}/{task.total}"),
            TimeElapsedColumn(),
            TextColumn("{task.fields[left]}"),
            console=self._console,
        )
        self._task = None

    def send(self, event: events.Event) -> None:
        match event:
            case events.Hello():
                self._console.print(f"wildsmoke {event.version} on {event.device}")
            case events.Stage(skipped=True):
                self._console.print(f"{event.name:<10} there already")
            case events.Stage():
                self._progress.start()
                self._task = self._progress.add_task(event.name, total=None, left="")
            case events.Progress() if self._task is not None:
                left = "" if event.seconds_left is None else f"{event.seconds_left:.0f} s left"
                if event.job_seconds_left is not None:
                    left += f", {event.job_seconds_left:.0f} s in all"
                self._progress.update(self._task, completed=event.step, total=event.total, left=left)
            case events.Artifact(kind="decisions") if self._job is not None:
                self._console.print(escape(read_decisions(self._job).to_text()))
            case events.Artifact(kind="estimate") if self._job is not None:
                text = (self._job / event.path).read_text(encoding="utf-8")
                self._console.print(f"expected  {escape(read_estimate(text).to_text())}")
            case events.Warning():
                self._console.print(f"[yellow]warning:[/yellow] {escape(event.message)}")
            case events.Done():
                self._progress.stop()
                self._console.print(f"done in {event.seconds:.0f} s")
            case events.Error():
                self._progress.stop()
                self._console.print(f"[red]{escape(event.message)}[/red] {escape(event.hint)}")
            case events.CancelledEvent():
                self._progress.stop()
                self._console.print("cancelled; what was computed is kept, the next run resumes")
            case _:
                return

    def close(self) -> None:
        self._progress.stop()


class StopRequest:
    """Set when the user cancels, or when standard input ends because the parent died."""

    def __init__(self) -> None:
        self._event = threading.Event()

    def set(self) -> None:
        self._event.set()

    def check(self) -> None:
        """Raises Cancelled when a stop was asked for."""
        if self._event.is_set():
            raise Cancelled


def watch_standard_input(stop: StopRequest, sink: EventSink) -> None:
    """Follow the parent's commands in a thread.

    A step that does not end soon after a stop is abandoned: nothing half-written ever looks whole, so leaving at
    once is as safe as being killed.
    """

    def follow() -> None:
        patience = STOP_AFTER_ORPHANED
        for line in iter(sys.stdin.readline, ""):
            if events.is_cancel(line):
                patience = STOP_AFTER_CANCEL
                break
        stop.set()
        time.sleep(patience)
        sink.send(events.CancelledEvent())
        os._exit(0)

    if sys.stdin is not None and not sys.stdin.closed and not sys.stdin.isatty():
        threading.Thread(target=follow, name="standard-input", daemon=True).start()


class StageReport:
    """A stage's Report: turns steps into progress events with the time left, at most ten a second."""

    def __init__(self, stage: str, sink: EventSink, stop: StopRequest, *, time_left: TimeLeft | None = None) -> None:
        self._stage = stage
        self._sink = sink
        self._stop = stop
        self.warnings: list[dict[str, str]] = []
        if time_left is None:
            time_left = TimeLeft({})
            time_left.begin(stage, time.monotonic())
        self._time_left = time_left
        self._sent = 0.0

    def progress(self, step: int, total: int, **metrics: float) -> None:
        self._stop.check()
        now = time.monotonic()
        left, job_left = self._time_left.left(step, total, now)
        if step < total and now - self._sent < 1.0 / events.MAX_PROGRESS_PER_SECOND:
            return
        self._sent = now
        finite = {name: float(value) for name, value in metrics.items() if abs(float(value)) < float("inf")}
        self._sink.send(
            events.Progress(
                stage=self._stage, step=step, total=total, seconds_left=left, job_seconds_left=job_left, metrics=finite
            )
        )

    def warning(self, code: str, message: str) -> None:
        entry = {"code": code, "message": message}
        if entry not in self.warnings:
            self.warnings.append(entry)
            self._sink.send(events.Warning(code=code, message=message))
