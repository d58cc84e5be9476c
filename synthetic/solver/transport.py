"""Advection of density and temperature: conservative, limited third-order upwind fluxes, so that no smoke is lost.

Face values by Koren 1993 (kappa = 1/3 with his limiter), time by the three-stage SSP Runge-Kutta of Shu and Osher 1988.
Mass leaves only through the open sides, and what leaves is counted. Nothing flows in from outside.
"""

from __future__ import annotations

import math

import numba
import numpy as np

MAX_COURANT = 0.6  # largest sum over the axes of |velocity| dt / h in one substep


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


@numba.njit(cache=True)
def _flux(speed, a, b, c, d):
    """Flux through the face between cells b and c, with a and d beyond them. Koren 1993 eq. 22: b + phi(r) (b - a) / 2."""
    if speed < 0.0:
        a, b, c, d = d, c, b, a
    behind = b - a
    ahead = c - b
    if behind * ahead <= 0.0:
        return speed * b
    r = ahead / behind
    limited = min(min(2.0 * r, (1.0 + 2.0 * r) / 3.0), 2.0)
    return speed * (b + np.float32(0.5) * np.float32(limited) * behind)


@numba.njit(cache=True)
def _net(before, after, far_a, a, c, b, far_b, is_first, is_last):
    """Net outflow of cell c along one axis; a and b are its neighbours. Open ends let smoke out and clean air in."""
    zero = np.float32(0.0)
    right = max(after, zero) * c if is_last else _flux(after, a, c, b, far_b)
    left = min(before, zero) * c if is_first else _flux(before, far_a, a, c, b)
    return right - left


@numba.njit(cache=True, parallel=True)
def _fill_rate(q, u, v, w, step, rate):
    # Beyond an end the edge cell is repeated, so that both cells beside a face see the same four values there.
    nx, ny, nz = q.shape
    for i in numba.prange(nx):
        i0, i1, i2, i3 = max(i - 2, 0), max(i - 1, 0), min(i + 1, nx - 1), min(i + 2, nx - 1)
        for j in range(ny):
            j0, j1, j2, j3 = max(j - 2, 0), max(j - 1, 0), min(j + 1, ny - 1), min(j + 2, ny - 1)
            for k in range(nz):
                k0, k1, k2, k3 = max(k - 2, 0), max(k - 1, 0), min(k + 1, nz - 1), min(k + 2, nz - 1)
                c = q[i, j, k]
                total = _net(
                    u[i, j, k], u[i + 1, j, k], q[i0, j, k], q[i1, j, k], c, q[i2, j, k], q[i3, j, k], i == 0, i == nx - 1
                )
                total += _net(
                    v[i, j, k], v[i, j + 1, k], q[i, j0, k], q[i, j1, k], c, q[i, j2, k], q[i, j3, k], j == 0, j == ny - 1
                )
                total += _net(
                    w[i, j, k], w[i, j, k + 1], q[i, j, k0], q[i, j, k1], c, q[i, j, k2], q[i, j, k3], k == 0, k == nz - 1
                )
                rate[i, j, k] = -step * total
