"""Time and peak memory of the whole path: the bundled clip at `preview`, and a 1080p clip of 270 frames at `draft`.

    python -m benchmarks.whole_path [--json FILE] [--frames N] [--only demo|large]

The large clip is drawn here: puffs that rise before a textured background, H.264. Times are those of a machine that may be
busy; memory does not depend on it.
"""

from __future__ import annotations

import argparse
import json
import os
import platform
import tempfile
from concurrent.futures import ProcessPoolExecutor
from dataclasses import asdict
from fractions import Fraction
from multiprocessing import get_context
from pathlib import Path

import av
import cv2
import numpy as np

from benchmarks.cost import CHECKOUT, run_backend

DEMO = CHECKOUT / "synthetic" / "samples" / "demo_plume.mp4"


def draw_large(path: Path, num_frames: int) -> None:
    """A 1920x1080 clip, 30 fps."""
    width, height = 1920, 1080
    random = np.random.default_rng(7)
    plate = cv2.GaussianBlur(random.random((height, width, 3)).astype(np.float32), (0, 0), 6.0)
    plate = 0.25 + 0.5 * (plate - plate.min()) / np.ptp(plate)
    y, x = np.mgrid[0 : height // 4, 0 : width // 4].astype(np.float32)
    with av.open(str(path), "w") as container:
        stream = container.add_stream("libx264", rate=Fraction(30), options={"preset": "ultrafast"})
        stream.width, stream.height, stream.pix_fmt = width, height, "yuv420p"
        for frame in range(num_frames):
            tau = np.zeros(x.shape, np.float32)
            for puff in range(0, frame + 1, 6):
                age = (frame - puff) / 30.0
                radius = 12.0 + 9.0 * age
                cx, cy = 240.0 + 18.0 * np.sin(1.3 * puff) + 14.0 * age, 255.0 - 45.0 * age
                if cy > -3 * radius:
                    tau += 0.8 * np.exp(-((x - cx) ** 2 + (y - cy) ** 2) / (2 * radius**2))
            opacity = cv2.resize(1 - np.exp(-tau), (width, height), interpolation=cv2.INTER_CUBIC).clip(0, 1)[..., None]
            image = ((plate * (1 - opacity) + 0.85 * opacity) * 255).astype(np.uint8)
            container.mux(stream.encode(av.VideoFrame.from_ndarray(image, format="rgb24")))
        container.mux(stream.encode())


def measure(clip: Path, job: Path, preset: str) -> dict:
    """Run one job in a process of its own and say what it took."""
    cost = run_backend("reconstruct", clip, "--job", job, "--preset", preset)
    return {"preset": preset, **asdict(cost)}


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--json", type=Path)
    parser.add_argument("--frames", type=int, default=270)
    parser.add_argument("--only", choices=("demo", "large"))
    options = parser.parse_args()
    figures: dict = {"machine": {"cores": os.cpu_count(), "system": platform.system(), "load": os.getloadavg()[0]}}
    with tempfile.TemporaryDirectory(prefix="wildsmoke_") as name:
        folder = Path(name)
        if options.only != "large":
            figures["demo"] = measure(DEMO, folder / "demo", "preview")
        if options.only != "demo":
            clip = folder / "large.mp4"
            with ProcessPoolExecutor(
                1, mp_context=get_context("spawn")
            ) as another:  # this one stays small, see benchmarks/cost.py
                another.submit(draw_large, clip, options.frames).result()
            figures["large"] = {"frames": options.frames, **measure(clip, folder / "large", "draft")}
    print(json.dumps(figures, indent=2))
    if options.json:
        options.json.write_text(json.dumps(figures, indent=2) + "\n")


if __name__ == "__main__":
    main()
