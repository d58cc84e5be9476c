"""A small plume drawn by hand, as PNG frames on black: rising, swaying puffs. And the backend as a user runs it."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

import cv2
import numpy as np
import pytest

CHECKOUT = Path(__file__).resolve().parents[2]
SMALL = {
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


@pytest.fixture(scope="session")
def plume(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return draw_plume(tmp_path_factory.mktemp("clip") / "plume")


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
