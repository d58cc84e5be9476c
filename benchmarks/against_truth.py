"""Reconstructs every scene of the benchmark set that ships, from smoke on black with its true cameras, and scores it.

    python -m benchmarks.against_truth --out DIR [--preset preview] [--method default] [--scenes a,b]
        [--set section.field=value ...] [--json FILE]

What is read: SCENE/input. What it is scored on: SCENE/truth. A scene whose report is in DIR is not made again: a folder
is for one preset and one method. The future frames are forecast. `divergence`: mean |div v| over the Gaussians of the
fitted frames within one smoothing length, 1/s, as published and corrected (backend/physics/divergence.py). Scenes marked
as untouched are never looked at while anything is tuned.
"""

from __future__ import annotations

import argparse
import json
import os
import subprocess
import sys
import time
from pathlib import Path
from typing import Any

import numpy as np

from backend.contract.job import METHODS
from backend.contract.result import PARTICLES_FILE
from backend.io.particles import read_particles
from backend.physics.divergence import divergence, divergence_as_published
from backend.score.evaluate import best_trivial
from backend.score.truth_set import read_truth_set

CHECKOUT = Path(__file__).resolve().parents[1]
SETS = CHECKOUT / "synthetic" / "bench"
UNTOUCHED = ("obstacle_plume", "wind_wisp")  # for figures; nothing is tuned on them


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--out", type=Path, required=True)
    parser.add_argument("--preset", default="preview")
    parser.add_argument("--method", choices=METHODS, default="default")
    parser.add_argument("--scenes", help="comma-separated; all without it")
    parser.add_argument("--set", dest="settings", action="append", default=[])
    parser.add_argument("--json", type=Path)
    given = parser.parse_args()
    names = given.scenes.split(",") if given.scenes else sorted(path.name for path in SETS.iterdir())
    rows = [scored(name, given) for name in names]
    for row in rows:
        print(json.dumps(row))
    if given.json:
        given.json.write_text(
            json.dumps({"preset": given.preset, "method": given.method, "scenes": rows}, indent=1) + "\n", encoding="utf-8"
        )
    return 0


def scored(name: str, given: argparse.Namespace) -> dict[str, Any]:
    """The figures of one scene, ours and the best trivial answer's."""
    truth = read_truth_set(SETS / name)
    job, report = given.out / name, given.out / f"{name}.json"
    if not report.exists():
        settings = [f"forecast.num_frames={truth.num_frames - truth.num_seen}", f"method={given.method}", *given.settings]
        changes = [part for setting in settings for part in ("--set", setting)]
        clip, cameras = truth.folder / "input" / "smoke.mkv", truth.folder / "input" / "cameras.json"
        begin = time.monotonic()
        backend("reconstruct", clip, "--job", job, "--cameras", cameras, "--preset", given.preset, *changes)
        seconds = time.monotonic() - begin
        backend("evaluate", "--job", job, "--truth", truth.folder, "--out", report.with_suffix(".part"))
        scores = json.loads(report.with_suffix(".part").read_text(encoding="utf-8"))
        scores |= {"seconds": round(seconds, 1), "divergence": divergences(job / PARTICLES_FILE)}
        report.write_text(json.dumps(scores), encoding="utf-8")
        report.with_suffix(".part").unlink()
    return summary(json.loads(report.read_text(encoding="utf-8")))


def summary(scores: dict[str, Any]) -> dict[str, Any]:
    """The figures that are compared, rounded."""
    row: dict[str, Any] = {"scene": scores["scene"], "untouched": scores["scene"] in UNTOUCHED, "seconds": scores["seconds"]}
    row["input_smoke_db"] = scores["input"]["ours"]["smoke_db"]
    for view in ("nvs", "side", "back", "future_input", "future_nvs"):
        figures = ("full_db", "first_db", "middle_db", "last_db") if view == "nvs" else ("full_db",)
        for figure in figures:
            name, value = best_trivial(scores[view], figure)
            row[f"{view}_{figure}"] = [scores[view]["ours"][figure], value, name]
    volume = scores["volume"]
    row |= {name: volume[name] for name in ("correlation", "relative_l2", "mass_ratio")}
    return row | volume.get("velocity", {}) | scores.get("divergence", {})


def divergences(path: Path) -> dict[str, float]:
    """Means over the fitted frames that hold enough particles."""
    published, corrected, coverage = [], [], []
    with read_particles(path) as particles:
        radius = particles.info.fluid["smoothing_length_m"]
        for index in range(particles.num_frames):
            frame = particles.frame(index)
            if frame.count:
                velocities = frame.velocities.astype(np.float64)
                published.append(divergence_as_published(frame.positions, velocities, radius).mean_absolute)
                found = divergence(frame.positions, velocities, radius)
                corrected.append(found.mean_absolute)
                coverage.append(found.coverage)
    rows = {"divergence_as_published": published, "divergence": corrected, "divergence_coverage": coverage}
    return {name: round(float(np.nanmean(values)), 4) for name, values in rows.items() if np.isfinite(values).any()}


def backend(*arguments: str | Path) -> None:
    command = [sys.executable, "-m", "backend", *(str(part) for part in arguments)]
    subprocess.run(command, check=True, stdout=subprocess.DEVNULL, env={**os.environ, "PYTHONPATH": str(CHECKOUT)}, cwd=CHECKOUT)


if __name__ == "__main__":
    raise SystemExit(main())
