"""A small job for tests: a plume drawn by hand on black, the backend as a user runs it, and a look at what it left."""

from __future__ import annotations

import hashlib
import json
import os
import subprocess
import sys
from pathlib import Path

import cv2
import h5py
import numpy as np

from backend.io.vdb import openvdb_module

CHECKOUT = Path(__file__).resolve().parents[2]
NOT_COMPARED = {"timing.json", "estimate.json", "log.txt", "job.json", "running.json"}
SMALL = {
    "volume.use_prior": "false",
    "frames.working_size": "64",
    "physical.num_particles": "150",
    "physical.correction_iterations": "1",
    "visual.num_particles": "400",
    "visual.iterations": "2",
    "visual.mass_iterations": "3",
    "forecast.num_frames": "2",
    "export.max_voxels": "24",
}


def draw_plume(folder: Path, *, num_frames: int = 10, size: tuple[int, int] = (48, 64)) -> Path:
    """PNG frames %04d.png of puffs that rise from the lower middle; grey on black."""
    folder.mkdir(parents=True, exist_ok=True)
    width, height = size
    y, x = np.mgrid[0:height, 0:width].astype(np.float32) + 0.5
    for frame in range(num_frames):
        tau = np.zeros((height, width), np.float32)
        for puff in range(-8, num_frames):
            age = frame - puff
            if age < 0:
                continue
            radius = 0.06 * width * (1 + 0.12 * age)
            cx = width * (0.5 + 0.05 * np.sin(1.7 * puff) + 0.008 * age)
            cy = height * 0.9 - 0.045 * height * age
            tau += 0.9 * np.exp(-((x - cx) ** 2 + (y - cy) ** 2) / (2 * radius**2)) / (1 + 0.08 * age)
        opacity = 1 - np.exp(-tau)
        opacity[opacity < 0.02] = 0
        cv2.imwrite(str(folder / f"{frame:04d}.png"), (opacity * 215).astype(np.uint8))
    return folder


def backend(*arguments: str | Path, **options) -> subprocess.CompletedProcess[str]:
    """Run a command of the backend to its end."""
    return subprocess.run(
        backend_command(*arguments), capture_output=True, text=True, env=environment(), check=False, timeout=300, **options
    )


def backend_command(*arguments: str | Path) -> list[str]:
    return [sys.executable, "-m", "backend", *map(str, arguments)]


def environment() -> dict[str, str]:
    return {**os.environ, "PYTHONPATH": str(CHECKOUT)}


def settings(**changes: str) -> list[str]:
    """`--set` arguments of a fit that takes seconds."""
    return [part for key, value in {**SMALL, **changes}.items() for part in ("--set", f"{key}={value}")]


def digest(job: Path) -> dict[str, str]:
    """The content of every file that a job leaves, but for times and the log."""
    files = (path for path in sorted(job.rglob("*")) if path.is_file() and path.name not in NOT_COMPARED)
    return {str(path.relative_to(job)): hashlib.sha256(path.read_bytes()).hexdigest() for path in files}


def assert_whole(job: Path) -> int:
    """Every file under its own name can be read to its end. Returns how many there are."""
    openvdb = openvdb_module()
    assert openvdb is not None
    count = 0
    for path in job.rglob("*"):
        if not path.is_file() or path.suffix == ".part":
            continue
        count += 1
        match path.suffix:
            case ".h5":
                with h5py.File(path, "r") as file:
                    assert "fingerprint" in file.attrs
                    file.visititems(lambda _, item: item[()] if isinstance(item, h5py.Dataset) else None)
            case ".npz":
                with np.load(path) as arrays:
                    assert all(arrays[name].dtype.kind in "fi" for name in arrays.files)
            case ".vdb":
                assert {grid.name for grid in openvdb.readAllGridMetadata(str(path))} >= {"density", "velocity"}
                openvdb.read(str(path), "density")
            case ".json":
                json.loads(path.read_text())
            case ".png":
                assert cv2.imread(str(path)) is not None
    return count
