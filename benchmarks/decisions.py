"""What each decision of `inspect` is worth: the five scenes as decided, and with one decision at a time made the other way.

    python -m benchmarks.decisions --out DIR [--scenes a,b] [--frames A:B] [--preset draft] [--json FILE] [--page]

A cell is a scene and a variant; what is there is not made again. Figures are of a few frames of each view, processor seconds
of all stages (those that a variant shares with the scene as decided cost what they cost there). DIR/results.json gathers all
cells, `--json` writes it elsewhere, `--page` into docs/results and makes docs/decisions.md. Thresholds were chosen on the
scenes that are not marked as untouched.
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
from collections.abc import Iterator
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from backend.contract.decisions import read_decisions
from backend.contract.job import Job
from backend.contract.result import CAMERAS_FILE
from backend.contract.truth import INPUT_FOLDER, INPUT_VIEW, SMOKE_VIDEO, TRUTH_FILE, TRUTH_FOLDER
from backend.events_out import StopRequest
from backend.io.atomic import write_text
from backend.io.job_folder import JobFolder
from backend.io.particles import read_particles
from backend.pipeline import run_job
from backend.score import measures
from backend.score.particles import ParticlePrediction
from backend.score.truth_set import read_truth_set
from benchmarks.cost import CHECKOUT
from benchmarks.reconstruction import SETS, UNTOUCHED, as_text, code_digest, machine, run_module
from benchmarks.trade_cell import Meter
from benchmarks.trade_score import frames_of, true_pictures

RESULTS = CHECKOUT / "docs" / "results" / "decisions.json"
FRAMES = (60, 74)  # there is smoke in every scene, and the camera goes six degrees around it
COMMON = {"export.max_voxels": "48"}  # the scores are of particles, and no decision is about the export
VIEWS = (INPUT_VIEW, "nvs", "side")


@dataclass(frozen=True, slots=True, kw_only=True)
class Variant:
    """decision: that it is about; question: what is asked; changes: settings; on: those of the job that it is compared with;
    frames: of both, where they are others than all have.

    is_made: `inspect` makes this decision; else it was tried and found not to be worth making.
    """

    name: str
    decision: str
    question: str
    changes: dict[str, str]
    on: dict[str, str] = field(default_factory=dict)
    frames: tuple[int, int] | None = None
    is_made: bool = True

    @property
    def base(self) -> str:
        frames = [] if self.frames is None else [f"frames {self.frames[0]} to {self.frames[1] - 1}"]
        return ", ".join(["decided", *frames, *(f"{key}={value}" for key, value in self.on.items())])


SMALL = {"frames.working_size": "80", "visual.num_particles": "24000"}  # some twenty particles a pixel of smoke
GREAT = {"visual.iterations": "16", "visual.num_particles": "24000"}  # colours take the time that they take at `final`
VARIANTS = (
    Variant(
        name="matte",
        decision="extraction",
        question="smoke that is cut out already is matted",
        changes={"extraction.mode": "matte"},
    ),
    Variant(name="still", decision="camera", question="a moving camera is left out", changes={"cameras.mode": "still"}),
    Variant(
        name="silhouette",
        decision="depth",
        question="the prior is left out, six degrees around",
        changes={"volume.use_prior": "false"},
    ),
    Variant(name="half size", decision="resolution", question="half the size", changes={"frames.working_size": "96"}),
    Variant(
        name="one hue",
        decision="color",
        question="one channel for three, at the effort of `final`",
        changes={"visual.color": "one_hue"},
        on=GREAT,
    ),
    Variant(name="half of them", decision="particles", question="half as many", changes={"visual.num_particles": "2000"}),
    Variant(
        name="more mass updates",
        decision="density",
        question="three updates of the optical masses for one",
        changes={"visual.mass_iterations": "3"},
        is_made=False,
    ),
    Variant(
        name="more consistency",
        decision="change",
        question="three times the pull to the masses of the frame before",
        changes={"visual.consistency": "0.3"},
        is_made=False,
    ),
    Variant(
        name="silhouette, further around",
        decision="depth",
        question="the prior is left out, twice as far around",
        changes={"volume.use_prior": "false"},
        frames=(52, 82),
    ),
    Variant(
        name="few pixels",
        decision="particles",
        question="6 a pixel where the settings ask for 24",
        changes={"visual.num_particles": "6000"},
        on=SMALL,
    ),
)


@dataclass(frozen=True, slots=True, kw_only=True)
class Cell:
    """One job. name: of its variant, or of what variants are compared with."""

    root: Path
    scene: Path
    name: str
    preset: str
    frames: tuple[int, int]
    changes: dict[str, str]
    base: str | None

    @property
    def record(self) -> Path:
        return self.root / self.scene.name / f"{self.name.replace(' ', '_').replace('=', '_')}.json"

    @property
    def job(self) -> Path:
        return self.record.with_suffix("")


def main(arguments: list[str] | None = None) -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--out", type=Path)
    parser.add_argument("--from", dest="source", type=Path, default=SETS)
    parser.add_argument("--scenes", type=lambda text: text.split(","), help="all without it")
    parser.add_argument("--variants", type=lambda text: text.split(";"), metavar="A;B", help="all without it")
    parser.add_argument("--frames", type=lambda text: tuple(map(int, text.split(":"))), default=FRAMES, metavar="A:B")
    parser.add_argument("--preset", default="draft")
    parser.add_argument("--json", type=Path)
    parser.add_argument("--page", action="store_true", help="also docs/decisions.md")
    parser.add_argument("--cells", help=argparse.SUPPRESS)
    given = parser.parse_args(arguments)
    if given.cells:
        run_cells(json.loads(given.cells))
        return 0
    if given.out is None:
        parser.error("--out is missing")
    root, failures = given.out.resolve(), 0
    scenes = given.scenes or sorted(path.parents[1].name for path in given.source.glob(f"*/{TRUTH_FOLDER}/{TRUTH_FILE}"))
    for scene in scenes:
        folder = (given.source / scene).resolve()
        cells = cells_of(root, folder, preset=given.preset, frames=given.frames, names=given.variants)
        failures += not complete(list(cells))
    results = gather(root, scenes, preset=given.preset, frames=given.frames)
    text = as_text(results)
    write_text(root / "results.json", text)
    for path in (given.json, RESULTS if given.page else None):
        if path is not None:
            write_text(path, text)
    if given.page:
        run_module("tools.decisions_page")
    return 1 if failures else 0


def cells_of(root: Path, scene: Path, *, preset: str, frames: tuple[int, int], names: list[str] | None = None) -> Iterator[Cell]:
    """Of a scene, each after the one that it is compared with. names: of the variants, None for all."""
    common: dict[str, Any] = {"root": root, "scene": scene, "preset": preset}
    told: set[str] = set()
    for variant in VARIANTS:
        if names is not None and variant.name not in names:
            continue
        if variant.base not in told:
            told.add(variant.base)
            yield Cell(**common, frames=variant.frames or frames, name=variant.base, changes=dict(variant.on), base=None)
        changes = variant.on | variant.changes
        yield Cell(**common, frames=variant.frames or frames, name=variant.name, changes=changes, base=variant.base)


def complete(cells: list[Cell]) -> bool:
    """Make what is missing of a scene's cells, in one process of their own; whether all are there then."""
    if all(cell.record.exists() for cell in cells):
        return True
    order = [{name: str(value) if isinstance(value, Path) else value for name, value in _fields(cell).items()} for cell in cells]
    command = [sys.executable, "-m", "benchmarks.decisions", "--cells", json.dumps(order)]
    environment = {**os.environ, "PYTHONPATH": str(CHECKOUT)}
    done = subprocess.run(command, stderr=subprocess.PIPE, text=True, cwd=CHECKOUT, env=environment, check=False)
    if done.returncode != 0:
        words = (done.stderr.strip().splitlines() or [f"ended with code {done.returncode}"])[-1]
        print(f"{cells[0].scene.name}: {words}", file=sys.stderr, flush=True)
    return done.returncode == 0


def _fields(cell: Cell) -> dict[str, Any]:
    return {name: getattr(cell, name) for name in Cell.__dataclass_fields__}


def run_cells(orders: list[dict[str, Any]]) -> None:
    """The cells of a scene that are missing, each after the one that it shares stages with."""
    cells = [Cell(**{**order, "root": Path(order["root"]), "scene": Path(order["scene"])}) for order in orders]
    bases = {cell.name: cell for cell in cells if cell.base is None}
    asked_for = {cell.base for cell in cells if not cell.record.exists()}
    for cell in cells:
        base = None if cell.base is None else bases[cell.base]
        is_whole = cell.record.exists() and (cell.job.is_dir() or cell.name not in asked_for)
        if is_whole:
            continue
        shutil.rmtree(cell.job, ignore_errors=True)
        cell.job.parent.mkdir(parents=True, exist_ok=True)
        donor: dict[str, Any] = {}
        if base is not None:
            shutil.copytree(base.job, cell.job)
            donor = json.loads(base.record.read_text(encoding="utf-8"))
        write_text(cell.record, json.dumps(run_cell(cell, donor), allow_nan=False))
        print(cell.record.read_text(encoding="utf-8"), flush=True)
        if base is not None:
            shutil.rmtree(cell.job)


def run_cell(cell: Cell, donor: dict[str, Any]) -> dict[str, Any]:
    """The job, then its scores. donor: the record of the job whose stages it holds already, which cost what they did there."""
    first, stop = cell.frames
    folder = JobFolder(cell.job)
    job = Job(
        video=str(cell.scene / INPUT_FOLDER / SMOKE_VIDEO),
        preset=cell.preset,
        cameras=str(cell.scene / INPUT_FOLDER / CAMERAS_FILE),
        frame_start=first,
        frame_stop=stop,
        overrides={**COMMON, **cell.changes},
    )
    folder.create()
    folder.write_job(job)
    meter = Meter(time.monotonic())
    run_job(folder.path, meter, StopRequest())
    known = {"stages": {name: {"cpu_seconds": seconds} for name, seconds in donor.get("stages", {}).items()}}
    stages = {name: stage["cpu_seconds"] for name, stage in meter.stages(known).items() if name != "start"}
    scores = scores_of(folder, cell.scene, cell.root / "pictures", scored=(first, stop))
    decided = {item.name: {"value": item.value, "measured": item.measured} for item in read_decisions(folder.path).decisions}
    return {
        "scene": cell.scene.name,
        "untouched": cell.scene.name in UNTOUCHED,
        "name": cell.name,
        "base": cell.base,
        "changes": cell.changes,
        "decisions": decided,
        "cpu_seconds": round(sum(stages.values()), 2),
        "stages": stages,
        "scores": scores,
        "code": code_digest(),
    }


def scores_of(folder: JobFolder, scene: Path, pictures: Path, *, scored: tuple[int, int]) -> dict[str, float]:
    """Decibels of a few frames of each view; pictures: a folder for the true ones, made once."""
    truth = read_truth_set(scene)
    found: dict[str, float] = {}
    with read_particles(folder.particles) as particles:
        prediction = ParticlePrediction(particles)
        for view in VIEWS:
            targets = true_pictures(truth, view, pictures)
            pairs = [
                measures.squared_errors(
                    prediction.picture(truth.view(view, frame), frame), targets[truth.frames[view].index(frame)]
                )
                for frame in frames_of(truth, view, scored)
                if frame < scored[1]
            ]
            found[f"{view}_db"] = float(np.mean([measures.decibels(full) for full, _ in pairs]))
            if view == INPUT_VIEW:
                found["input_smoke_db"] = float(np.nanmean([measures.decibels(smoke) for _, smoke in pairs]))
    return {name: round(value, 3) for name, value in found.items()}


def gather(root: Path, scenes: list[str], *, preset: str, frames: tuple[int, int]) -> dict[str, Any]:
    """All cells that are there, and what the variants are."""
    cells = [json.loads(path.read_text(encoding="utf-8")) for scene in scenes for path in sorted((root / scene).glob("*.json"))]
    threads = int(os.environ.get("NUMBA_NUM_THREADS", len(os.sched_getaffinity(0))))
    variants = [{**asdict(variant), "base": variant.base} for variant in VARIANTS]
    return {"machine": machine(), "threads": threads, "preset": preset, "frames": frames, "variants": variants, "cells": cells}


if __name__ == "__main__":
    raise SystemExit(main())
