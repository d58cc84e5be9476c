"""How the cost of a job grows with the number of frames: the same steady plume on black, seen for longer and longer.

    python -m benchmarks.clip_length [--frames 60,135,270] [--preset draft] [--json docs/results/clip_length.json]

The clip is drawn here, 180x320: puffs that rise and widen, as many at the start as at the end, so that every frame is as much
work as any other; the camera goes around them by the benchmark's angle a frame. Processor seconds say what the work is,
whatever else the machine does meanwhile.
"""

from __future__ import annotations

import argparse
import json
import tempfile
from concurrent.futures import ProcessPoolExecutor
from dataclasses import asdict
from fractions import Fraction
from multiprocessing import get_context
from pathlib import Path
from typing import Any

import av
import numpy as np

from backend.geometry.camera import View, view_at
from backend.io.atomic import write_text
from benchmarks.cost import run_backend
from benchmarks.reconstruction import machine
from synthetic.sweep import Orbit, orbit_cameras

WIDTH, HEIGHT, FPS = 180, 320, 24
DEGREES = 60.0 / 270.0  # a frame
EVERY, AGE = 0.2, 7.0  # s: between puffs, and how old they become
RISE, WIDENS = 2.2, 0.22  # m/s


def draw(folder: Path, num_frames: int) -> None:
    """clip.mkv and cameras.json."""
    stop = -105.0 + DEGREES * num_frames
    cameras = orbit_cameras(Orbit(azimuth_stop=stop), width=WIDTH, height=HEIGHT, fps=FPS, num_frames=num_frames)
    (folder / "cameras.json").write_text(cameras.to_json(), encoding="utf-8")
    with av.open(str(folder / "clip.mkv"), "w") as container:
        stream = container.add_stream("ffv1", rate=Fraction(FPS))
        stream.width, stream.height, stream.pix_fmt = WIDTH, HEIGHT, "bgr0"
        for frame in range(num_frames):
            gray = (255 * picture(view_at(cameras, frame), frame / FPS)).astype(np.uint8)
            container.mux(stream.encode(av.VideoFrame.from_ndarray(np.repeat(gray[..., None], 3, axis=2), format="rgb24")))
        container.mux(stream.encode())


def picture(view: View, seconds: float) -> np.ndarray:
    """[H, W] opacity of the puffs that there are."""
    numbers = np.arange(np.ceil((seconds - AGE) / EVERY), seconds / EVERY)
    ages = seconds - EVERY * numbers
    ways = 0.35 * np.sqrt(ages)[:, None] * np.stack([np.cos(2.4 * numbers), np.sin(2.4 * numbers)], axis=1)
    places = np.column_stack([ways, 0.6 + RISE * ages])
    pixels, depths = view.project(places)
    sizes = (0.35 + WIDENS * ages) * view.fx / depths
    y, x = np.mgrid[0:HEIGHT, 0:WIDTH] + 0.5
    depth = np.zeros((HEIGHT, WIDTH))
    for (column, row), size, age in zip(pixels, sizes, ages, strict=True):
        fading = min(1.0, 2.0 * age) * max(0.0, 1.0 - age / AGE)
        depth += 0.6 * fading * np.exp(-((x - column) ** 2 + (y - row) ** 2) / (2 * size**2))
    return 1.0 - np.exp(-depth)


def measure(folder: Path, num_frames: int, preset: str) -> dict[str, Any]:
    """Draw a clip in a process of its own, fit it in another, and say what that took."""
    with ProcessPoolExecutor(1, mp_context=get_context("spawn")) as another:  # this one stays small, see benchmarks/cost.py
        another.submit(draw, folder, num_frames).result()
    options = ("--cameras", folder / "cameras.json", "--job", folder / "job", "--preset", preset)
    cost = run_backend("reconstruct", folder / "clip.mkv", *options)
    return {
        "frames": num_frames,
        "preset": preset,
        **asdict(cost),
        "cpu_seconds_a_frame": round(cost.cpu_seconds / num_frames, 4),
    }


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--frames", type=lambda text: [int(part) for part in text.split(",")], default=[60, 135, 270])
    parser.add_argument("--preset", default="draft")
    parser.add_argument("--json", type=Path)
    given = parser.parse_args()
    rows = []
    for num_frames in given.frames:
        with tempfile.TemporaryDirectory(prefix="wildsmoke_") as name:
            rows.append(measure(Path(name), num_frames, given.preset))
        print(json.dumps(rows[-1]), flush=True)
    if given.json:
        write_text(given.json, json.dumps({"machine": machine(), "rows": rows}, indent=1) + "\n")


if __name__ == "__main__":
    main()
