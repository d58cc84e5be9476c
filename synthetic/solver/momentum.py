"""Advection of velocity: MacCormack with limits (Selle et al. 2008), over a staggered grid with open sides.

Positions are in cells, measured from the low corner of the box: cell (i, j, k) has its centre at (i, j, k) + 0.5.
What flows in through an open side brings the wind of its height; the floor (z = 0) is a wall.
"""

from __future__ import annotations

import numba
import numpy as np


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
    forward, low, high = np.empty_like(field), np.empty_like(field), np.empty_like(field)
    _carry(field, axis, u, v, w, ambient, cells, forward, low, high)
    back, unused_low, unused_high = np.empty_like(field), np.empty_like(field), np.empty_like(field)
    _carry(forward, axis, u, v, w, ambient, np.float32(-cells), back, unused_low, unused_high)
    # Where a path left the box the limits are NaN: keep the first-order value there.
    corrected = forward + np.float32(0.5) * (field - back)
    is_inside = np.isfinite(low) & np.isfinite(unused_low)
    return np.where(is_inside, np.clip(corrected, low, high), forward)


@numba.njit(cache=True, forceinline=True)
def _place(shape, x, y, z):
    """Sample coordinates -> the lower corner of the eight samples around and the shares of the upper ones, clamped."""
    x = min(max(x, 0.0), shape[0] - 1.0)
    y = min(max(y, 0.0), shape[1] - 1.0)
    z = min(max(z, 0.0), shape[2] - 1.0)
    i, j, k = min(int(x), shape[0] - 2), min(int(y), shape[1] - 2), min(int(z), shape[2] - 2)
    return i, j, k, x - i, y - j, z - k


@numba.njit(cache=True, forceinline=True)
def _value(field, x, y, z):
    """Trilinear at sample coordinates."""
    i, j, k, fx, fy, fz = _place(field.shape, x, y, z)
    a, b, c, d = field[i, j, k], field[i, j, k + 1], field[i, j + 1, k], field[i, j + 1, k + 1]
    e, f, g, h = field[i + 1, j, k], field[i + 1, j, k + 1], field[i + 1, j + 1, k], field[i + 1, j + 1, k + 1]
    front = (a * (1 - fz) + b * fz) * (1 - fy) + (c * (1 - fz) + d * fz) * fy
    back = (e * (1 - fz) + f * fz) * (1 - fy) + (g * (1 - fz) + h * fz) * fy
    return front * (1 - fx) + back * fx


@numba.njit(cache=True, forceinline=True)
def _bounds(field, x, y, z):
    """The least and largest of the eight samples around sample coordinates."""
    i, j, k, _, _, _ = _place(field.shape, x, y, z)
    a, b, c, d = field[i, j, k], field[i, j, k + 1], field[i, j + 1, k], field[i, j + 1, k + 1]
    e, f, g, h = field[i + 1, j, k], field[i + 1, j, k + 1], field[i + 1, j + 1, k], field[i + 1, j + 1, k + 1]
    low = min(min(min(a, b), min(c, d)), min(min(e, f), min(g, h)))
    return low, max(max(max(a, b), max(c, d)), max(max(e, f), max(g, h)))


@numba.njit(cache=True, forceinline=True)
def _mean(field, i, j, k, p, q, r):
    """Of the two or four samples from (i, j, k) on that lie p, q, r (0 or 1) further along the axes, clamped, in float64."""
    nx, ny, nz = field.shape
    i0, j0, k0 = min(max(i, 0), nx - 1), min(max(j, 0), ny - 1), min(max(k, 0), nz - 1)
    i1, j1, k1 = min(i + p, nx - 1), min(j + q, ny - 1), min(k + r, nz - 1)
    low = 0.5 * (0.5 * field[i0, j0, k0] + 0.5 * field[i0, j0, k1]) + 0.5 * (0.5 * field[i0, j1, k0] + 0.5 * field[i0, j1, k1])
    high = 0.5 * (0.5 * field[i1, j0, k0] + 0.5 * field[i1, j0, k1]) + 0.5 * (0.5 * field[i1, j1, k0] + 0.5 * field[i1, j1, k1])
    return 0.5 * low + 0.5 * high


@numba.njit(cache=True, forceinline=True)
def _face_velocity(u, v, w, axis, i, j, k):
    """Velocity at a sample of the component that crosses faces of an axis, m/s: the means of the faces around."""
    if axis == 0:
        return 1.0 * u[i, j, k], _mean(v, i - 1, j, k, 1, 1, 0), _mean(w, i - 1, j, k, 1, 0, 1)
    if axis == 1:
        return _mean(u, i, j - 1, k, 1, 1, 0), 1.0 * v[i, j, k], _mean(w, i, j - 1, k, 0, 1, 1)
    return _mean(u, i, j, k - 1, 1, 0, 1), _mean(v, i, j, k - 1, 0, 1, 1), 1.0 * w[i, j, k]


@numba.njit(cache=True, parallel=True)
def _carry(field, axis, u, v, w, ambient, cells, out, low, high):
    """Semi-Lagrangian step: each sample takes the value at the start of its path (midpoint rule). NaN limits: outside."""
    nx, ny, nz = u.shape[0] - 1, v.shape[1] - 1, w.shape[2] - 1
    ox, oy, oz = 0.5 * (axis != 0), 0.5 * (axis != 1), 0.5 * (axis != 2)
    for plane in numba.prange(field.shape[0]):
        i = np.int64(plane)  # a prange counts without sign: i - 1 would not be an integer
        for j in range(field.shape[1]):
            for k in range(field.shape[2]):
                x, y, z = i + ox, j + oy, k + oz
                a, b, c = _face_velocity(u, v, w, axis, i, j, k)
                mx, my, mz = x - 0.5 * cells * a, y - 0.5 * cells * b, z - 0.5 * cells * c
                a = _value(u, mx, my - 0.5, mz - 0.5)
                b = _value(v, mx - 0.5, my, mz - 0.5)
                c = _value(w, mx - 0.5, my - 0.5, mz)
                px, py, pz = x - cells * a, y - cells * b, max(z - cells * c, 0.0)
                if px < 0.0 or py < 0.0 or px > nx or py > ny or pz > nz:
                    out[i, j, k] = ambient[min(max(int(pz), 0), nz - 1)]
                    low[i, j, k] = np.nan
                    high[i, j, k] = np.nan
                else:
                    out[i, j, k] = _value(field, px - ox, py - oy, pz - oz)
                    low[i, j, k], high[i, j, k] = _bounds(field, px - ox, py - oy, pz - oz)
