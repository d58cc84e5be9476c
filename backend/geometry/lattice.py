"""Where the voxels of a grid are."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np


@dataclass(frozen=True, slots=True, kw_only=True)
class Lattice:
    """Cubes along the axes: voxel (i, j, k) has its centre at origin + voxel_size (i, j, k)."""

    origin: tuple[float, float, float]  # m
    voxel_size: float  # m
    shape: tuple[int, int, int]

    def axes(self) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Coordinates of the centres along x, y, z, m."""
        x, y, z = (start + self.voxel_size * np.arange(size) for start, size in zip(self.origin, self.shape, strict=True))
        return x, y, z

    def centres(self) -> np.ndarray:
        """[X, Y, Z, 3] m."""
        return np.stack(np.meshgrid(*self.axes(), indexing="ij"), axis=-1)
