"""Is the forecast better than holding the last frame? Measured in the input view on frames that the fit never saw.

    python -m benchmarks.forecast_horizon [CLIP] [--held N] [--preset P] [--set section.field=value ...] [--json FILE]

The first frames of the clip are fitted and the last N forecast; what is scored against is the smoke layer of the whole
clip (sRGB, smoke on black). Beside the forecast stand the trivial answers: black, the frozen last smoke layer, and the
frozen last reconstruction.
"""

from __future__ import annotations

import argparse
import json
import os
import subprocess
import sys
import tempfile
from pathlib import Path

import numpy as np

from backend.contract.cameras import read_cameras
from backend.fit.scene import make_scene
from backend.io.frame_stack import FrameStack
from backend.io.job_folder import JobFolder
from backend.io.particles import read_particles
from backend.io.records import open_stage_file
from backend.render.picture import picture
from backend.score.measures import decibels, squared_errors

CHECKOUT = Path(__file__).resolve().parents[1]
DEMO = CHECKOUT / "synthetic" / "samples" / "demo_plume.mp4"


def reconstruct(clip: Path, job: Path, *arguments: str) -> JobFolder:
    command = [sys.executable, "-m", "backend", "reconstruct", str(clip), "--job", str(job), *arguments]
    environment = {**os.environ, "PYTHONPATH": str(CHECKOUT)}
    subprocess.run(command, check=True, stdout=subprocess.DEVNULL, env=environment, cwd=CHECKOUT)
    return JobFolder(job)


def read_layers(folder: JobFolder) -> list[np.ndarray]:
    with open_stage_file(folder.smoke) as file:
        return list(FrameStack(file, "smoke"))


def psnr(shown: np.ndarray, truth: np.ndarray) -> float:
    """dB of two linear premultiplied images [H, W, 4] over the full frame, compared as sRGB on black; at most 50."""
    return decibels(squared_errors(shown, truth)[0])


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("clip", nargs="?", type=Path, default=DEMO)
    parser.add_argument("--held", type=int, default=8)
    parser.add_argument("--preset", default="draft")
    parser.add_argument("--set", dest="settings", action="append", default=[])
    parser.add_argument("--json", type=Path)
    options = parser.parse_args()
    changes = [part for text in options.settings for part in ("--set", text)]
    with tempfile.TemporaryDirectory(prefix="wildsmoke_") as name:
        whole = reconstruct(
            options.clip, Path(name) / "whole", "--preset", options.preset, "--set", "visual.iterations=0", *changes
        )
        truth = read_layers(whole)
        fitted = len(truth) - options.held
        arguments = ("--preset", options.preset, "--frames", f"0:{fitted}", "--set", f"forecast.num_frames={options.held}")
        part = reconstruct(options.clip, Path(name) / "part", *arguments, *changes)
        seen = read_layers(part)
        view = make_scene(seen, read_cameras(part.cameras)).views[-1]
        with read_particles(part.particles) as particles:
            shown = [picture(particles.frame(index), view) for index in range(fitted - 1, len(truth))]
    answers = {
        "forecast": shown[1:],
        "frozen smoke layer": [seen[-1]] * options.held,
        "frozen reconstruction": [shown[0]] * options.held,
        "black": [np.zeros_like(seen[-1])] * options.held,
    }
    table = {
        title: [round(psnr(image, target), 2) for image, target in zip(pictures, truth[fitted:], strict=True)]
        for title, pictures in answers.items()
    }
    figures = {
        "clip": options.clip.name,
        "fitted": fitted,
        "mean_db": {title: round(float(np.mean(values)), 2) for title, values in table.items()},
        "by_horizon_db": table,
    }
    print(json.dumps(figures, indent=2))
    if options.json:
        options.json.write_text(json.dumps(figures, indent=2) + "\n")


if __name__ == "__main__":
    main()
