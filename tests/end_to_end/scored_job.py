"""A job folder that can be scored, made without a fit: the particles that a small scene was drawn with."""

from __future__ import annotations

import shutil
from pathlib import Path

import numpy as np
from tiny_bench import FPS, NUM_FRAMES, NUM_SEEN, cameras, drawn, puffs

from backend.contract.result import PARTICLES_FILE, RESULT_FILE, Result
from backend.io.frame_stack import FrameStackWriter
from backend.io.hdf5_file import whole_hdf5
from backend.io.images import decode_srgb
from backend.io.job_folder import JobFolder
from backend.io.particles import ParticlesInfo, ParticlesWriter
from backend.io.records import stamp


def make_job(path: Path, *, wind: float, num_seen: int = NUM_SEEN) -> JobFolder:
    """As if puffs with this wind, m/s, had been found; the frames behind the seen ones are the forecast."""
    shutil.rmtree(path, ignore_errors=True)
    folder = JobFolder(path)
    folder.create()
    folder.cameras.write_text(cameras("input").to_json())
    shown = [decode_srgb(drawn(puffs(frame, wind), cameras("input"), frame)[..., [2, 1, 0, 3]]) for frame in range(num_seen)]
    with whole_hdf5(folder.smoke) as file:
        writer = FrameStackWriter(file, "smoke", num_seen, shown[0].shape)
        for layer in shown:
            writer.append(layer)
        stamp(file, "drawn")
    with ParticlesWriter(folder.particles) as writer:
        for frame in range(NUM_FRAMES):
            writer.append(puffs(frame, wind), is_forecast=frame >= num_seen)
        info = ParticlesInfo(
            cameras=cameras("input"),
            gravity=(0.0, 0.0, -9.81),
            fluid={"smoothing_length_m": 0.5},
            provenance={"program": "wildsmoke 0", "preset": "draft", "settings": {"method": "default"}},
        )
        writer.finish(info)
    folder.timing.write_text('{"frames": 1.5, "visual": 20.25}')
    result = Result(
        particles=PARTICLES_FILE, cameras="cameras.json", vdb_folder="vdb", num_frames=num_seen,
        num_forecast=NUM_FRAMES - num_seen, frame_start=0, fps=FPS, voxel_size=0.1, has_color=False,
        smoke_color=(0.6, 0.6, 0.6), bounds=((-1.0, -1.0, 0.0), (1.0, 1.0, 3.0)), buoyancy=(0.0, 0.0, 0.0),
        fingerprint=f"{wind}",
    )  # fmt: skip
    (path / RESULT_FILE).write_text(result.to_json())
    return folder


def layer(frame: int, wind: float) -> np.ndarray:
    """[H, W, 4] float32 linear premultiplied: what a perfect Cycles would draw."""
    return decode_srgb(drawn(puffs(frame, wind), cameras("input"), frame)[..., [2, 1, 0, 3]])
