"""One cell of `bench`: a job run by itself in this process, what each of its stages cost, and how good it is.

    python -m benchmarks.trade_cell '{"scene": DIR, "job": DIR, "record": FILE, "pictures": DIR, "trial": {...}, "donor": FILE}'

The process is as small as a job's own. Stages that the job folder holds already cost what the donor's record says they did.
"""

from __future__ import annotations

from backend import kernel_setup  # noqa: F401 before numba loads

# isort: split
import json
import resource
import sys
import time
from pathlib import Path
from typing import Any

from backend.contract import events
from backend.contract.job import Job
from backend.contract.result import CAMERAS_FILE
from backend.contract.truth import INPUT_FOLDER, SMOKE_VIDEO
from backend.events_out import StopRequest
from backend.io.atomic import write_text
from backend.io.job_folder import JobFolder
from backend.pipeline import run_job
from benchmarks.trade_front import totals
from benchmarks.trade_plan import AHEAD


class Meter:
    """Takes a job's events and notes at each stage what the process has used so far."""

    def __init__(self, began: float) -> None:
        """began: of the process, on the clock that all processes share."""
        self._began = began
        self.marks: list[tuple[str, bool, tuple[float, float, float]]] = [("start", False, (0.0, 0.0, 0.0))]

    def send(self, event: events.Event) -> None:
        if isinstance(event, events.Stage):
            self.marks.append((event.name, event.skipped, self.used()))

    def close(self) -> None:
        """Nothing is held."""

    def stages(self, donor: dict[str, Any]) -> dict[str, dict[str, Any]]:
        """Of each stage its wall and processor seconds, the peak memory up to its end in GiB, and whose they are."""
        ends = [found for _, _, found in self.marks[1:]] + [self.used()]
        found: dict[str, dict[str, Any]] = {}
        for (name, is_skipped, before), after in zip(self.marks, ends, strict=True):
            if is_skipped:
                found[name] = {**donor["stages"][name], "is_taken_over": True}
            else:
                seconds, cpu_seconds = (round(b - a, 3) for a, b in zip(before[:2], after[:2], strict=True))
                peak = round(after[2], 3)
                found[name] = {"seconds": seconds, "cpu_seconds": cpu_seconds, "peak_gib": peak, "is_taken_over": False}
        return found

    def used(self) -> tuple[float, float, float]:
        """Wall seconds, processor seconds and peak memory, GiB, of this process and those it waited for."""
        own, others = (resource.getrusage(who) for who in (resource.RUSAGE_SELF, resource.RUSAGE_CHILDREN))
        processor = own.ru_utime + own.ru_stime + others.ru_utime + others.ru_stime
        unit = 1024**3 if sys.platform == "darwin" else 1024**2
        return time.monotonic() - self._began, processor, max(own.ru_maxrss, others.ru_maxrss) / unit


def run_cell(order: dict[str, Any]) -> dict[str, Any]:
    """The record of a cell. order: as on the command line."""
    trial, scene, folder = order["trial"], Path(order["scene"]), JobFolder(Path(order["job"]))
    first, stop = trial["frames"]
    job = Job(
        video=str(scene / INPUT_FOLDER / SMOKE_VIDEO),
        preset=trial["preset"],
        cameras=str(scene / INPUT_FOLDER / CAMERAS_FILE),
        frame_start=first,
        frame_stop=stop,
        device="cpu",
        overrides={"forecast.num_frames": AHEAD, "seed": trial["seed"], "follow_clip": False, **dict(trial["changes"])},
    )
    folder.create()
    folder.write_job(job)
    donor = json.loads(Path(order["donor"]).read_text(encoding="utf-8")) if order.get("donor") else {}
    meter = Meter(order["began"])
    run_job(folder.path, meter, StopRequest())
    stages = meter.stages(donor)

    from benchmarks.trade_score import score_window  # after the measurement: it is no part of the job

    scores = score_window(folder, scene, Path(order["pictures"]), scored=(trial["scored_from"], stop))
    return {"stages": stages, **totals(stages), "scores": scores}


if __name__ == "__main__":
    given = json.loads(sys.argv[1])
    write_text(Path(given["record"]), json.dumps({**given["facts"], **run_cell(given)}, allow_nan=False))
