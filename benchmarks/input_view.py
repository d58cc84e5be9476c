"""How well a finished job reproduces what it was made from: PSNR in the input view against its smoke layer.

    python -m benchmarks.input_view JOB [--json FILE]

sRGB on black; over the full frame, and over the smoke (opacity above 2 %). Frames without smoke are left out of the
second. A frame counts 50 dB at most.
"""

from __future__ import annotations

import argparse
import json
from pathlib import Path

import numpy as np

from backend.contract.cameras import read_cameras
from backend.contract.job import read_job
from backend.contract.result import read_result
from backend.fit.scene import make_scene
from backend.io.frame_stack import FrameStack
from backend.io.job_folder import JobFolder
from backend.io.particles import read_particles
from backend.io.records import open_stage_file
from backend.render.picture import picture
from backend.score.measures import SMOKE_OPACITY, coded, decibels


def measure(job: Path) -> dict:
    """The figures of one job."""
    folder, result, order = JobFolder(job), read_result(job), read_job(job / "job.json")
    full, inside = [], []
    with open_stage_file(folder.smoke) as file, read_particles(folder.particles) as particles:
        layers = FrameStack(file, "smoke")
        scene = make_scene(layers, read_cameras(folder.cameras))
        for frame in range(result.num_frames):
            shown = picture(particles.frame(frame), scene.views[frame])
            layer = layers[frame]
            squares = np.square(coded(shown) - coded(layer))
            full.append(decibels(float(squares.mean(dtype=np.float64))))
            is_smoke = layer[..., 3] > SMOKE_OPACITY
            if is_smoke.sum() > 20:
                inside.append(decibels(float(squares[is_smoke].mean(dtype=np.float64))))
        mode = str(file.attrs["mode"])
    return {
        "clip": Path(order.video).name,
        "preset": order.preset,
        "frames": result.num_frames,
        "extraction": mode,
        "warnings": [entry["code"] for entry in result.warnings],
        "full_db": round(float(np.mean(full)), 2),
        "smoke_db": round(float(np.mean(inside)), 2) if inside else None,
        "seconds": round(sum(json.loads(folder.timing.read_text()).values()), 1),
    }


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("job", type=Path)
    parser.add_argument("--json", type=Path)
    options = parser.parse_args()
    figures = measure(options.job)
    print(json.dumps(figures, indent=2))
    if options.json:
        options.json.write_text(json.dumps(figures, indent=2) + "\n")


if __name__ == "__main__":
    main()
