"""The state of the smoke on a staggered (MAC) grid, Harlow and Welch 1965.

Scalars sit in cell centres, each velocity component on the cell faces it crosses. Arrays are [x, y, z], float32.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np


@dataclass(frozen=True, slots=True, kw_only=True)
class Grid:
    """nx x ny x nz cubic cells of edge voxel_size m; origin is the low corner of the box, m."""

    nx: int
    ny: int
    nz: int
    voxel_size: float
    origin: tuple[float, float, float]

    def __post_init__(self) -> None:
        if min(self.nx, self.ny, self.nz) < 4 or not self.voxel_size > 0:
            raise ValueError(f"a grid needs at least 4 cells a side and a positive voxel size, got {self}")

    @property
    def shape(self) -> tuple[int, int, int]:
        return self.nx, self.ny, self.nz

    @property
    def first_centre(self) -> tuple[float, float, float]:
        """Centre of cell (0, 0, 0), m."""
        return tuple(corner + 0.5 * self.voxel_size for corner in self.origin)  # type: ignore[return-value]

    def centres(self) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Coordinates of the cell centres along each axis, m: [nx], [ny], [nz]."""
        x, y, z = (start + self.voxel_size * np.arange(count) for start, count in zip(self.first_centre, self.shape, strict=True))
        return x, y, z


@dataclass(frozen=True, slots=True, kw_only=True)
class SmokeState:
    """One moment. density: extinction 1/m; temperature: excess over the air around, K; emitted and left: optical
    mass that the sources made and that crossed the open sides since the start, m^2."""

    time: float
    density: np.ndarray  # [nx, ny, nz] 1/m
    temperature: np.ndarray  # [nx, ny, nz] K
    u: np.ndarray  # [nx + 1, ny, nz] m/s
    v: np.ndarray  # [nx, ny + 1, nz] m/s
    w: np.ndarray  # [nx, ny, nz + 1] m/s
    emitted: float
    left: float


def centred_velocity(state: SmokeState) -> np.ndarray:
    """Velocity in the cell centres [nx, ny, nz, 3], m/s: the mean of opposite faces."""
    u, v, w = state.u, state.v, state.w
    return np.stack([0.5 * (u[1:] + u[:-1]), 0.5 * (v[:, 1:] + v[:, :-1]), 0.5 * (w[:, :, 1:] + w[:, :, :-1])], axis=-1)


def divergence(u: np.ndarray, v: np.ndarray, w: np.ndarray, *, voxel_size: float) -> np.ndarray:
    """Net outflow of each cell by volume [nx, ny, nz], 1/s, in float64."""
    u, v, w = (component.astype(np.float64) for component in (u, v, w))
    return (np.diff(u, axis=0) + np.diff(v, axis=1) + np.diff(w, axis=2)) / voxel_size


def optical_mass(density: np.ndarray, *, voxel_size: float) -> float:
    """Extinction integrated over space, m^2."""
    return float(density.sum(dtype=np.float64)) * voxel_size**3
