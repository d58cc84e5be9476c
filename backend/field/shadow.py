"""Optical depth between every voxel and a far light: how much of its own smoke stands in the way.

    depth(x) = h sum_k' rho(x + k h direction)                                             [1]

over k = 0, 1, .. until the grid ends, the first term at half weight; trilinear between voxel centres. Sweeping plane by plane
would be cheaper, but every bilinear step widens the shadow: by 13 % of its peak for a ball of ten voxels.
"""

from __future__ import annotations

import math

import numpy as np
from numba import njit, prange

from backend.field.lookup import among
from backend.geometry.lattice import Lattice


def depth_towards(density: np.ndarray, lattice: Lattice, direction: np.ndarray) -> np.ndarray:
    """[X, Y, Z] 1/m and the direction to the light [3] -> [X, Y, Z] float32. Raises ValueError on a direction without length."""
    length = float(np.linalg.norm(direction))
    if not (length > 0 and math.isfinite(length)) or density.shape != lattice.shape:
        raise ValueError(f"no light comes from {direction}, or a grid of {density.shape} does not fit {lattice.shape}")
    depth = np.empty(lattice.shape, np.float32)
    _march(np.pad(np.asarray(density, np.float32), 1), np.asarray(direction, np.float64) / length, depth)
    return depth * np.float32(lattice.voxel_size)


@njit(cache=True, parallel=True, error_model="numpy", fastmath={"reassoc", "contract"})
def _march(density, step, depth):  # density with a voxel of nothing on all sides: no sample has to ask
    nx, ny, nz = depth.shape
    for i in prange(nx):
        for j in range(ny):
            for k in range(nz):
                total = 0.5 * density[i + 1, j + 1, k + 1]
                x, y, z = i + step[0], j + step[1], k + step[2]
                while -1.0 < x < nx and -1.0 < y < ny and -1.0 < z < nz:
                    total += among(density, x + 1.0, y + 1.0, z + 1.0)
                    x, y, z = x + step[0], y + step[1], z + step[2]
                depth[i, j, k] = total
