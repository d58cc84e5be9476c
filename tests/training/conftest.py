"""A plume to draw lessons from."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from training.library import NUM_FRAMES, VELOCITY_EVERY, VOXEL_SIZE, Plume, read_plume
from training.plumes import SIZE

SHAPE_OF_PLUME = tuple(round(size / VOXEL_SIZE) for size in SIZE)


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A column of smoke that leans, rises and spreads from where it is dense and narrow, as the library keeps plumes."""
    path = tmp_path_factory.mktemp("plumes") / "0003"
    path.mkdir()
    x, y, z = np.meshgrid(*(np.arange(size) for size in SHAPE_OF_PLUME), indexing="ij")
    spread = 1 + z / 20
    column = 120 / spread * np.exp(-((x - 18 - 0.1 * z) ** 2 + (y - 18) ** 2) / (12 * spread))
    density = np.stack([column * (z < 15 + 0.3 * frame) for frame in range(NUM_FRAMES)]).astype(np.uint8)
    shape = (NUM_FRAMES // VELOCITY_EVERY, *SHAPE_OF_PLUME, 3)
    np.save(path / "density.npy", density)
    np.save(path / "velocity.npy", np.broadcast_to(np.array([0.2, 0.0, 1.5], np.float16), shape))
    (path / "plume.json").write_text('{"seed": 3, "origin": [-5.83, -5.83, 0.17]}', encoding="utf-8")
    return path


@pytest.fixture(scope="module")
def recorded(folder: Path) -> Plume:
    return read_plume(folder)
