"""Advection of density and temperature: conservative, limited third-order upwind fluxes, so that no smoke is lost.

Face values by Koren 1993 (kappa = 1/3 with his limiter), time by the three-stage SSP Runge-Kutta of Shu and Osher 1988.
Mass leaves only through the open sides, and what leaves is counted. Nothing flows in from outside.
"""

from __future__ import annotations

import math

import numba
import numpy as np

MAX_COURANT = 0.6  # largest sum over the axes of |velocity| dt / h in one substep
_ZERO = np.float32(0.0)


def transport(
    field: np.ndarray,  # [nx, ny, nz]
    velocity: tuple[np.ndarray, np.ndarray, np.ndarray],  # u, v, w m/s, free of divergence
    *,
    time_step: float,  # s
    voxel_size: float,  # m
) -> tuple[np.ndarray, float]:
    """The field after one step, and the integral of it that left through the sides (field unit x m^3)."""
    u, v, w = velocity
    cells = time_step / voxel_size
    num_substeps = max(1, math.ceil(courant_number(u, v, w) * cells / MAX_COURANT))
    step = np.float32(cells / num_substeps)
    left = 0.0
    rate = np.empty_like(field)
    for _ in range(num_substeps):
        out0 = _rate(field, u, v, w, step, rate)
        first = field + rate
        out1 = _rate(first, u, v, w, step, rate)
        second = np.float32(0.75) * field + np.float32(0.25) * (first + rate)
        out2 = _rate(second, u, v, w, step, rate)
        field = np.float32(1 / 3) * field + np.float32(2 / 3) * (second + rate)
        left += (out0 + out1) / 6 + out2 * 2 / 3
    return field, left * voxel_size**3


def courant_number(u: np.ndarray, v: np.ndarray, w: np.ndarray) -> float:
    """Largest sum over the axes of the face speeds of a cell, m/s."""
    fastest = np.maximum(np.abs(u[1:]), np.abs(u[:-1]))
    fastest = fastest + np.maximum(np.abs(v[:, 1:]), np.abs(v[:, :-1]))
    fastest += np.maximum(np.abs(w[:, :, 1:]), np.abs(w[:, :, :-1]))
    return float(fastest.max())


def _rate(field: np.ndarray, u: np.ndarray, v: np.ndarray, w: np.ndarray, step: np.float32, rate: np.ndarray) -> float:
    """Fill `rate` with the change over `step`; returns the sum over the sides of what leaves."""
    _fill_rate(field, u, v, w, step, rate)
    out = 0.0
    for axis, component in enumerate((u, v, w)):
        first, last = np.take(component, 0, axis), np.take(component, -1, axis)
        out += float((np.maximum(-first, 0) * np.take(field, 0, axis)).sum(dtype=np.float64))
        out += float((np.maximum(last, 0) * np.take(field, -1, axis)).sum(dtype=np.float64))
    return out * float(step)


@numba.njit(cache=True, error_model="numpy", inline="always")
def _flux(speed, a, b, c, d):
    """Flux through the face between cells b and c, with a and d beyond them. Koren 1993 eq. 22: b + phi(r) (b - a) / 2.

    Values are chosen between without a branch, so that a processor computes several faces of a row at once."""
    is_back = speed < _ZERO
    far, near, beyond = (d if is_back else a), (c if is_back else b), (b if is_back else c)
    behind, ahead = near - far, beyond - near
    r = ahead / behind
    limited = min(min(2.0 * r, (1.0 + 2.0 * r) / 3.0), 2.0)
    value = near + np.float32(0.5) * np.float32(limited) * behind
    return speed * (value if behind * ahead > _ZERO else near)


@numba.njit(cache=True, error_model="numpy", inline="always")
def _net_across(left, right, a, b, c, d, e, is_first, is_last, net):
    """Fill `net` [nz] with the outflow of a row of cells c through the faces to its left and right, where these are the speeds.
    a, b, d, e: the rows beside it. Open ends let smoke out and clean air in."""
    if is_last:
        for k in range(len(c)):
            net[k] = max(right[k], _ZERO) * c[k]
    else:
        for k in range(len(c)):
            net[k] = _flux(right[k], b[k], c[k], d[k], e[k])
    if is_first:
        for k in range(len(c)):
            net[k] -= min(left[k], _ZERO) * c[k]
    else:
        for k in range(len(c)):
            net[k] -= _flux(left[k], a[k], b[k], c[k], d[k])


@numba.njit(cache=True, parallel=True, error_model="numpy")
def _fill_rate(q, u, v, w, step, rate):
    # Beyond an end the edge cell is repeated, so that both cells beside a face see the same four values there.
    nx, ny, nz = q.shape
    for i in numba.prange(nx):
        i0, i1, i2, i3 = max(i - 2, 0), max(i - 1, 0), min(i + 1, nx - 1), min(i + 2, nx - 1)
        net_x, net_y = np.empty(nz, np.float32), np.empty(nz, np.float32)
        column, through = np.empty(nz + 4, np.float32), np.empty(nz + 1, np.float32)
        for j in range(ny):
            j0, j1, j2, j3 = max(j - 2, 0), max(j - 1, 0), min(j + 1, ny - 1), min(j + 2, ny - 1)
            row = q[i, j]
            _net_across(u[i, j], u[i + 1, j], q[i0, j], q[i1, j], row, q[i2, j], q[i3, j], i == 0, i == nx - 1, net_x)
            _net_across(v[i, j], v[i, j + 1], q[i, j0], q[i, j1], row, q[i, j2], q[i, j3], j == 0, j == ny - 1, net_y)
            column[2 : nz + 2] = row
            column[:2], column[nz + 2 :] = row[0], row[nz - 1]
            speed = w[i, j]
            for k in range(nz + 1):
                through[k] = _flux(speed[k], column[k], column[k + 1], column[k + 2], column[k + 3])
            through[0], through[nz] = min(speed[0], _ZERO) * row[0], max(speed[nz], _ZERO) * row[nz - 1]
            for k in range(nz):
                rate[i, j, k] = -step * (net_x[k] + net_y[k] + (through[k + 1] - through[k]))
