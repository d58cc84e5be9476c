"""Optical depth between every voxel and a far light: how much of its own smoke stands in the way.

    depth(x) = h sum_k' rho(x + k h direction)                                             [1]

over k = 0, 1, .. until the grid ends, the first term at half weight; trilinear between voxel centres. Sweeping plane by plane
would be cheaper, but every bilinear step widens the shadow: by 13 % of its peak for a ball of ten voxels.
"""

from __future__ import annotations

import math

import numpy as np
from numba import njit, prange

from backend.geometry.lattice import Lattice


def depth_towards(density: np.ndarray, lattice: Lattice, direction: np.ndarray) -> np.ndarray:
    """[X, Y, Z] 1/m and the direction to the light [3] -> [X, Y, Z] float32. Raises ValueError on a direction without length."""
    length = float(np.linalg.norm(direction))
    if not (length > 0 and math.isfinite(length)) or density.shape != lattice.shape:
        raise ValueError(f"no light comes from {direction}, or a grid of {density.shape} does not fit {lattice.shape}")
    depth = np.empty(lattice.shape, np.float32)
    _march(np.ascontiguousarray(density, np.float32), np.asarray(direction, np.float64) / length, depth)
    return depth * np.float32(lattice.voxel_size)


@njit(cache=True, parallel=True, error_model="numpy", fastmath={"reassoc", "contract"})
def _march(density, step, depth):
    nx, ny, nz = density.shape
    for i in prange(nx):
        for j in range(ny):
            for k in range(nz):
                total = 0.5 * density[i, j, k]
                x, y, z = i + step[0], j + step[1], k + step[2]
                while -1.0 < x < nx and -1.0 < y < ny and -1.0 < z < nz:
                    a, b, c = math.floor(x), math.floor(y), math.floor(z)
                    f, g, h = x - a, y - b, z - c
                    for corner in range(8):
                        p, q, r = a + corner // 4, b + corner // 2 % 2, c + corner % 2
                        if 0 <= p < nx and 0 <= q < ny and 0 <= r < nz:
                            weight = (f if corner // 4 else 1 - f) * (g if corner // 2 % 2 else 1 - g)
                            total += weight * (h if corner % 2 else 1 - h) * density[p, q, r]
                    x, y, z = x + step[0], y + step[1], z + step[2]
                depth[i, j, k] = total
