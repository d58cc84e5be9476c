"""Advection of velocity: MacCormack with limits (Selle et al. 2008), over a staggered grid with open sides.

Positions are in cells, measured from the low corner of the box: cell (i, j, k) has its centre at (i, j, k) + 0.5.
What flows in through an open side brings the wind of its height; the floor (z = 0) is a wall.
"""

from __future__ import annotations

import numba
import numpy as np

_FACE = ((0.0, 0.5, 0.5), (0.5, 0.0, 0.5), (0.5, 0.5, 0.0))  # where a component's sample (0, 0, 0) lies, in cells


def advect_velocity(
    velocity: tuple[np.ndarray, np.ndarray, np.ndarray],  # u, v, w m/s
    wind: np.ndarray,  # [nz, 2] m/s
    *,
    cells: float,  # time step / voxel size, s/m
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """The velocity carried by itself over one step. Selle 2008 eqs. 7-9, limited to the values around its origin."""
    u, v, w = velocity
    calm = np.zeros(wind.shape[0], np.float32)
    moved = []
    for axis, component in enumerate(velocity):
        ambient = np.ascontiguousarray(wind[:, axis]) if axis < 2 else calm
        moved.append(maccormack(component, axis, u, v, w, ambient, np.float32(cells)))
    return moved[0], moved[1], moved[2]


def maccormack(
    field: np.ndarray,
    axis: int,
    u: np.ndarray,
    v: np.ndarray,
    w: np.ndarray,
    ambient: np.ndarray,  # [nz] the value that flows in from outside
    cells: np.float32,
) -> np.ndarray:
    """One component (axis 0, 1, 2) of a staggered field, carried by (u, v, w) over `cells` = dt / h."""
    offset = np.array(_FACE[axis], np.float32)
    forward, low, high = np.empty_like(field), np.empty_like(field), np.empty_like(field)
    _carry(field, offset, u, v, w, ambient, cells, forward, low, high)
    back, unused_low, unused_high = np.empty_like(field), np.empty_like(field), np.empty_like(field)
    _carry(forward, offset, u, v, w, ambient, np.float32(-cells), back, unused_low, unused_high)
    # Where a path left the box the limits are NaN: keep the first-order value there.
    corrected = forward + np.float32(0.5) * (field - back)
    is_inside = np.isfinite(low) & np.isfinite(unused_low)
    return np.where(is_inside, np.clip(corrected, low, high), forward)


@numba.njit(cache=True)
def _interpolate(field, x, y, z):
    """Trilinear at sample coordinates, clamped to the array. Also the least and largest of the eight values."""
    nx, ny, nz = field.shape
    x = min(max(x, 0.0), nx - 1.0)
    y = min(max(y, 0.0), ny - 1.0)
    z = min(max(z, 0.0), nz - 1.0)
    i, j, k = min(int(x), nx - 2), min(int(y), ny - 2), min(int(z), nz - 2)
    fx, fy, fz = x - i, y - j, z - k
    a, b, c, d = field[i, j, k], field[i, j, k + 1], field[i, j + 1, k], field[i, j + 1, k + 1]
    e, f, g, h = field[i + 1, j, k], field[i + 1, j, k + 1], field[i + 1, j + 1, k], field[i + 1, j + 1, k + 1]
    front = (a * (1 - fz) + b * fz) * (1 - fy) + (c * (1 - fz) + d * fz) * fy
    back = (e * (1 - fz) + f * fz) * (1 - fy) + (g * (1 - fz) + h * fz) * fy
    low = min(min(min(a, b), min(c, d)), min(min(e, f), min(g, h)))
    high = max(max(max(a, b), max(c, d)), max(max(e, f), max(g, h)))
    return front * (1 - fx) + back * fx, low, high


@numba.njit(cache=True)
def _velocity(u, v, w, x, y, z):
    """Velocity at a position in cells, m/s."""
    a, _, _ = _interpolate(u, x, y - 0.5, z - 0.5)
    b, _, _ = _interpolate(v, x - 0.5, y, z - 0.5)
    c, _, _ = _interpolate(w, x - 0.5, y - 0.5, z)
    return a, b, c


@numba.njit(cache=True, parallel=True)
def _carry(field, offset, u, v, w, ambient, cells, out, low, high):
    """Semi-Lagrangian step: each sample takes the value at the start of its path (midpoint rule). NaN limits: outside."""
    nx, ny, nz = u.shape[0] - 1, v.shape[1] - 1, w.shape[2] - 1
    ox, oy, oz = offset[0], offset[1], offset[2]
    for i in numba.prange(field.shape[0]):
        for j in range(field.shape[1]):
            for k in range(field.shape[2]):
                x, y, z = i + ox, j + oy, k + oz
                a, b, c = _velocity(u, v, w, x, y, z)
                a, b, c = _velocity(u, v, w, x - 0.5 * cells * a, y - 0.5 * cells * b, z - 0.5 * cells * c)
                px, py, pz = x - cells * a, y - cells * b, max(z - cells * c, 0.0)
                if px < 0.0 or py < 0.0 or px > nx or py > ny or pz > nz:
                    out[i, j, k] = ambient[min(max(int(pz), 0), nz - 1)]
                    low[i, j, k] = np.nan
                    high[i, j, k] = np.nan
                else:
                    out[i, j, k], low[i, j, k], high[i, j, k] = _interpolate(field, px - ox, py - oy, pz - oz)
