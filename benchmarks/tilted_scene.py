"""Does the fit find which way is up? Scenes whose world is turned: the learned buoyancy against the turned up.

    python -m benchmarks.tilted_scene --out DIR [--scenes a,b] [--degrees 30] [--preset preview] [--set section.field=value ...]
        [--json docs/results/tilted_scene.json]

Only the cameras are turned, about the world's x axis: the pictures are the same, and a fit that takes z for up is wrong by the
angle. A job that is there is not made again.
"""

from __future__ import annotations

import argparse
import json
from dataclasses import replace
from pathlib import Path

import numpy as np

from backend.contract.cameras import Cameras, read_cameras
from backend.contract.result import CAMERAS_FILE, RESULT_FILE, read_result
from backend.contract.truth import INPUT_FOLDER, SMOKE_VIDEO
from backend.io.atomic import write_text
from benchmarks.cost import run_backend
from benchmarks.reconstruction import SETS, UNTOUCHED, degrees_between


def main(arguments: list[str] | None = None) -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--out", type=Path, required=True)
    parser.add_argument("--from", dest="source", type=Path, default=SETS)
    parser.add_argument("--scenes", type=lambda text: text.split(","), help="all without it")
    parser.add_argument("--degrees", type=float, default=30.0)
    parser.add_argument("--preset", default="preview")
    parser.add_argument("--set", dest="settings", action="append", default=[], metavar="section.field=value")
    parser.add_argument("--json", type=Path)
    given = parser.parse_args(arguments)
    changes = [part for setting in given.settings for part in ("--set", setting)]
    rows = []
    for name in given.scenes or sorted(path.name for path in given.source.iterdir()):
        job = (given.out / f"{name}_{given.preset}_{given.degrees:g}").resolve()
        place = (given.source / name / INPUT_FOLDER).resolve()
        if not (job / RESULT_FILE).exists():
            job.mkdir(parents=True, exist_ok=True)
            write_text(job / "given_cameras.json", tilted(read_cameras(place / CAMERAS_FILE), given.degrees).to_json())
            options = ("--cameras", job / "given_cameras.json", "--preset", given.preset, *changes)
            run_backend("reconstruct", place / SMOKE_VIDEO, "--job", job, *options)
        found = np.array(read_result(job).buoyancy)
        row = {"scene": name, "untouched": name in UNTOUCHED, "preset": given.preset, "tilt_degrees": given.degrees}
        row |= {"strength": round(float(np.linalg.norm(found)), 4)}
        row |= {"degrees_from_up": degrees_between(found.tolist(), turn(given.degrees)[:3, 2].tolist())}
        rows.append(row)
        print(json.dumps(row), flush=True)
    if given.json:
        write_text(given.json, json.dumps({"rows": rows}, indent=1) + "\n")
    return 0


def turn(degrees: float) -> np.ndarray:
    """[4, 4]: about the x axis."""
    c, s = np.cos(np.radians(degrees)), np.sin(np.radians(degrees))
    return np.array([[1.0, 0.0, 0.0, 0.0], [0.0, c, -s, 0.0], [0.0, s, c, 0.0], [0.0, 0.0, 0.0, 1.0]])


def tilted(cameras: Cameras, degrees: float) -> Cameras:
    """The same cameras in a world that was turned with everything in it."""
    matrices = turn(degrees) @ np.array(cameras.camera_to_world)
    return replace(cameras, camera_to_world=tuple(tuple(map(tuple, matrix.tolist())) for matrix in matrices))


if __name__ == "__main__":
    raise SystemExit(main())
