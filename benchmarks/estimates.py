"""How near the estimates before a job are to what it takes; and, with --fit, the coefficients that they are made with.

    python -m benchmarks.estimates --out DIR [--clips FILE ...] [--fit] [--json FILE] [--page]

Jobs on the bundled clip and on benchmark scenes are what the coefficients follow from; the clips that are named are only
compared with. What is there is not made again. Every job runs in a process of its own, after one that compiled the kernels.
Seconds are of the processor where the job may use one thread: what else the machine does is then not counted; else wall.
--fit writes backend/estimate/costs.json, --page docs/results/estimates.json and docs/decisions.md.
"""

from __future__ import annotations

from backend import kernel_setup  # noqa: F401 before numba loads

# isort: split
import argparse
import json
import os
import shutil
import subprocess
import sys
import time
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from scipy.optimize import nnls

from backend.contract.cameras import read_cameras
from backend.contract.estimates import FACTOR
from backend.contract.job import Job
from backend.contract.result import CAMERAS_FILE
from backend.contract.truth import INPUT_FOLDER, SMOKE_VIDEO
from backend.estimate.machine import this_machine
from backend.estimate.predict import COSTS_FILE
from backend.estimate.work import kinds_of, memory_terms, pixels_of, terms_of
from backend.events_out import StopRequest
from backend.io.atomic import write_text
from backend.io.job_folder import JobFolder
from backend.io.video import open_clip
from backend.pipeline import run_job
from backend.reporting import SilentReport
from backend.stages import inspect
from benchmarks.cost import CHECKOUT
from benchmarks.reconstruction import SETS, as_text, machine, run_module
from benchmarks.trade_cell import Meter

RESULTS = CHECKOUT / "docs" / "results" / "estimates.json"
DEMO = CHECKOUT / "synthetic" / "samples" / "demo_plume.mp4"


@dataclass(frozen=True, slots=True, kw_only=True)
class Trial:
    """One job. clip: as it is called in the results; cameras: a file, or none; settings: as for `--set`; is_fitted: the
    coefficients follow from it."""

    clip: str
    video: str
    preset: str
    frames: tuple[int, int]
    cameras: str | None = None
    settings: dict[str, str] = field(default_factory=dict)
    is_fitted: bool = True

    @property
    def name(self) -> str:
        ways = ("given" if self.cameras else "still", *self.settings.values())
        return f"{self.clip}_{self.preset}_{self.frames[0]}_{self.frames[1]}_{'_'.join(ways)}"


def fitted_trials() -> list[Trial]:
    """Each preset with the prior and without, on black and matted; the published methods; and forecasts."""
    found = [
        Trial(clip="demo_plume", video=str(DEMO), preset=preset, frames=(0, count))
        for preset, count in (("draft", 24), ("preview", 16), ("final", 8))
    ]
    scene = SETS / "steady_plume"
    video, cameras = (str(scene / INPUT_FOLDER / name) for name in (SMOKE_VIDEO, CAMERAS_FILE))
    # Numbers of frames. Of few frames the prior is asked about none or all, of many now and then.
    for preset, around, still in (("draft", 64, 16), ("preview", 40, 12), ("final", 14, 8)):
        found.append(Trial(clip=scene.name, video=video, preset=preset, frames=(40, 40 + around), cameras=cameras))
        for settings in ({}, {"volume.use_prior": "false"}):
            found.append(Trial(clip=scene.name, video=video, preset=preset, frames=(40, 40 + still), settings=settings))
    for preset, count, settings in (
        ("draft", 24, {"method": "as_published"}),
        ("draft", 12, {"method": "fluidnexus"}),
        ("preview", 12, {"method": "as_published"}),
        ("draft", 16, {"forecast.num_frames": "32"}),
        ("preview", 8, {"forecast.num_frames": "16"}),
    ):
        frames = (40, 40 + count)
        found.append(Trial(clip=scene.name, video=video, preset=preset, frames=frames, cameras=cameras, settings=settings))
    return found


def compared_trials(clips: list[Path], counts: dict[str, int]) -> list[Trial]:
    """Clips that nothing was fitted to, from their first frame on."""
    return [
        Trial(clip=path.name, video=str(path.resolve()), preset=preset, frames=(0, count), is_fitted=False)
        for path in clips
        for preset, count in counts.items()
    ]


def main(arguments: list[str] | None = None) -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--out", type=Path)
    parser.add_argument("--clips", type=Path, nargs="*", default=[])
    parser.add_argument("--frames", type=int, default=30, help="of each named clip at draft; two thirds at preview")
    parser.add_argument("--fit", action="store_true", help="also the coefficients")
    parser.add_argument("--json", type=Path)
    parser.add_argument("--page", action="store_true")
    parser.add_argument("--trial", help=argparse.SUPPRESS)
    given = parser.parse_args(arguments)
    if given.trial:
        run_trial(json.loads(given.trial))
        return 0
    if given.out is None:
        parser.error("--out is missing")
    root = given.out.resolve()
    counts = {"draft": given.frames, "preview": 2 * given.frames // 3}
    trials = [*fitted_trials(), *compared_trials(given.clips, counts)]
    failures = sum(not complete(root, trial) for trial in trials)
    records = [json.loads(path.read_text(encoding="utf-8")) for path in sorted(root.glob("*.json"))]
    if given.fit:
        write_text(COSTS_FILE, json.dumps(fitted([record for record in records if record["is_fitted"]]), indent=1) + "\n")
    costs = json.loads(COSTS_FILE.read_text(encoding="utf-8"))
    text = as_text({"machine": machine(), "factor": FACTOR, "pairs": [pair_of(record, costs) for record in records]}, "pairs")
    for path in (given.json, RESULTS if given.page else None):
        if path is not None:
            write_text(path, text)
    if given.page:
        run_module("tools.decisions_page")
    return 1 if failures else 0


def complete(root: Path, trial: Trial) -> bool:
    """Make the record of a trial if it is missing; whether it is there then."""
    record = root / f"{trial.name}.json"
    if record.exists():
        return True
    root.mkdir(parents=True, exist_ok=True)
    environment = {**os.environ, "PYTHONPATH": str(CHECKOUT)}
    order = {**asdict(trial), "record": str(record), "job": str(root / "job"), "began": time.monotonic()}
    command = [sys.executable, "-m", "benchmarks.estimates", "--trial", json.dumps(order)]
    shutil.rmtree(root / "job", ignore_errors=True)
    done = subprocess.run(command, capture_output=True, text=True, cwd=CHECKOUT, env=environment, check=False)
    shutil.rmtree(root / "job", ignore_errors=True)
    if done.returncode != 0:
        words = (done.stderr.strip().splitlines() or [f"ended with code {done.returncode}"])[-1]
        print(f"{trial.name}: {words}", file=sys.stderr, flush=True)
        return False
    print(trial.name, flush=True)
    return True


def run_trial(order: dict[str, Any]) -> None:
    """In a process of its own: the job, measured; then what there was to know of it before."""
    began, folder = order.pop("began"), JobFolder(Path(order.pop("job")))
    record, trial = Path(order.pop("record")), Trial(**order)
    job = Job(
        video=trial.video,
        preset=trial.preset,
        cameras=trial.cameras,
        overrides=trial.settings,
        frame_start=trial.frames[0],
        frame_stop=trial.frames[1],
    )
    folder.create()
    folder.write_job(job)
    meter = Meter(began)
    run_job(folder.path, meter, StopRequest())
    stages = meter.stages({})
    config, given = job.config(), None if trial.cameras is None else read_cameras(trial.cameras)
    with open_clip(trial.video) as clip:
        first, stop = trial.frames
        decisions, seen = inspect.run(clip, config, SilentReport(), chosen=trial.settings, start=first, stop=stop, given=given)
    followed = decisions.followed(config)
    speeds = this_machine(kinds_of(followed))
    terms = terms_of(seen, followed, threads=speeds.threads)
    found = {
        "clip": trial.clip,
        "preset": trial.preset,
        "settings": trial.settings,
        "num_frames": seen.num_frames,
        "size": seen.source_size,
        "has_prior": "volume" in terms,
        "is_fitted": trial.is_fitted,
        "threads": speeds.threads,
        "stages": {name: stage["cpu_seconds" if speeds.threads == 1 else "seconds"] for name, stage in stages.items()},
        "wall_seconds": round(sum(stage["seconds"] for stage in stages.values()), 2),
        "peak_gib": max(stage["peak_gib"] for stage in stages.values()),
        "surveyed": surveyed(seen, followed),
        "terms": {stage: [[term.name, term.amount * speeds.seconds[term.kind]] for term in of] for stage, of in terms.items()},
        "memory_terms": memory_terms(seen, followed),
    }
    write_text(record, json.dumps(found, allow_nan=False))


def surveyed(seen: Any, config: Any) -> dict[str, float]:
    """Seconds that the survey itself foretells, as backend/estimate/predict.py adds them."""
    larger = pixels_of(seen, config) / (seen.size[0] * seen.size[1])
    return {
        "inspect": seen.pace.whole,
        "frames": seen.num_frames * (seen.pace.decode + seen.pace.reduce),
        "smoke": larger * (seen.pace.prepare + seen.num_frames * seen.pace.extract),
    }


def fitted(records: list[dict[str, Any]]) -> dict[str, Any]:
    """Coefficients, none negative, that have the least relative error over all records: of each stage, and of the memory."""
    stages: dict[str, dict[str, float]] = {}
    for stage in dict.fromkeys(name for record in records for name in record["terms"]):
        rows = [
            (dict(record["terms"][stage]), record["stages"][stage] - record["surveyed"].get(stage, 0.0), record["stages"][stage])
            for record in records
            if stage in record["terms"] and stage in record["stages"]
        ]
        stages[stage] = _least_relative(rows)
    peaks = [(record["memory_terms"], record["peak_gib"], record["peak_gib"]) for record in records]
    return {"made_by": "python -m benchmarks.estimates --fit", "stages": stages, "memory_gib": _least_relative(peaks)}


def _least_relative(rows: list[tuple[dict[str, float], float, float]]) -> dict[str, float]:
    """rows: amounts by term, what they should add up to, and what an error is relative to."""
    names = list(dict.fromkeys(name for amounts, _, _ in rows for name in amounts))
    weights = np.array([1.0 / max(scale, 0.3) for _, _, scale in rows])
    matrix = np.array([[amounts.get(name, 0.0) for name in names] for amounts, _, _ in rows])
    found, _ = nnls(matrix * weights[:, None], np.maximum([value for _, value, _ in rows], 0.0) * weights)
    return {name: float(f"{value:.4g}") for name, value in zip(names, found, strict=True)}


def pair_of(record: dict[str, Any], costs: dict[str, Any]) -> dict[str, Any]:
    """What was estimated with these coefficients beside what was measured."""
    estimated = dict(record["surveyed"])
    for stage, terms in record["terms"].items():
        known = costs["stages"].get(stage, {})
        estimated[stage] = estimated.get(stage, 0.0) + sum(known.get(name, 0.0) * amount for name, amount in terms)
    memory = sum(costs["memory_gib"].get(name, 0.0) * amount for name, amount in record["memory_terms"].items())
    seconds, measured = sum(estimated.values()), sum(record["stages"].values())
    kept = {
        name: record[name] for name in ("clip", "preset", "settings", "num_frames", "size", "has_prior", "is_fitted", "threads")
    }
    return {
        **kept,
        "estimated_seconds": round(seconds, 2),
        "measured_seconds": round(measured, 2),
        "wall_seconds": record["wall_seconds"],
        "ratio": round(seconds / measured, 3),
        "estimated_gib": round(memory, 3),
        "measured_gib": record["peak_gib"],
        "estimated_stages": {name: round(value, 2) for name, value in estimated.items()},
        "measured_stages": record["stages"],
    }


if __name__ == "__main__":
    raise SystemExit(main())
