"""Values of a grid's voxels at points between them, trilinear; and back: what lies at points, shared among voxels."""

from __future__ import annotations

import math

import numpy as np
from numba import njit, prange


def trilinear(values: np.ndarray, places: np.ndarray, *, outside: str) -> np.ndarray:
    """[X, Y, Z] or [X, Y, Z, C] at places [N, 3], in voxels from the first one's centre -> [N] or [N, C] of the values' type.

    outside: "grid-constant" for zero one voxel beyond the outermost and further, "nearest" for the nearest voxel's. A place that
    is no number has zeros.
    """
    channels = np.ascontiguousarray(values.reshape(*values.shape[:3], math.prod(values.shape[3:])))
    found = np.zeros((len(places), channels.shape[3]), channels.dtype)
    if channels.size:
        _look_up(channels, np.ascontiguousarray(places, np.float64), outside == "nearest", found)
    return found.reshape(len(places), *values.shape[3:])


def deposited(places: np.ndarray, masses: np.ndarray, shape: tuple[int, int, int]) -> np.ndarray:
    """Masses [N] at places [N, 3], as for trilinear, shared among the eight voxels around each -> [X, Y, Z] float64; what is
    outside is lost."""
    total = np.zeros(shape)
    _deposit(np.ascontiguousarray(places, np.float64), np.asarray(masses, np.float64), total)
    return total


@njit(cache=True, inline="always")
def among(values, x, y, z):  # trilinear at a place in voxels, none negative, whose eight voxels all exist
    i, j, k = int(x), int(y), int(z)
    fx, fy, fz = x - i, y - j, z - k
    near = (1.0 - fz) * values[i, j, k] + fz * values[i, j, k + 1]
    far = (1.0 - fz) * values[i, j + 1, k] + fz * values[i, j + 1, k + 1]
    here = (1.0 - fy) * near + fy * far
    near = (1.0 - fz) * values[i + 1, j, k] + fz * values[i + 1, j, k + 1]
    far = (1.0 - fz) * values[i + 1, j + 1, k] + fz * values[i + 1, j + 1, k + 1]
    return (1.0 - fx) * here + fx * ((1.0 - fy) * near + fy * far)


@njit(cache=True, inline="always")
def _cell(place, count, is_nearest):  # -> voxel before the place, how far behind it
    place = min(max(place, 0.0), count - 1.0) if is_nearest else min(max(place, -2.0), count + 1.0)
    before = math.floor(place)
    return before, place - before


@njit(cache=True, parallel=True, error_model="numpy")
def _look_up(values, places, is_nearest, found):
    nx, ny, nz, num = values.shape
    for n in prange(len(places)):
        px, py, pz = places[n, 0], places[n, 1], places[n, 2]
        if not (px == px and py == py and pz == pz):
            continue
        (i, fx), (j, fy), (k, fz) = _cell(px, nx, is_nearest), _cell(py, ny, is_nearest), _cell(pz, nz, is_nearest)
        total = np.zeros(num)
        for a in range(2):
            wx = fx if a else 1.0 - fx
            if wx == 0.0 or not 0 <= i + a < nx:
                continue
            for b in range(2):
                wy = wx * (fy if b else 1.0 - fy)
                if wy == 0.0 or not 0 <= j + b < ny:
                    continue
                for c in range(2):
                    w = wy * (fz if c else 1.0 - fz)
                    if w == 0.0 or not 0 <= k + c < nz:
                        continue
                    for m in range(num):
                        total[m] += w * values[i + a, j + b, k + c, m]
        for m in range(num):
            found[n, m] = total[m]


@njit(cache=True, error_model="numpy")
def _deposit(places, masses, total):
    nx, ny, nz = total.shape
    for n in range(len(masses)):
        px, py, pz = places[n, 0], places[n, 1], places[n, 2]
        if not (px == px and py == py and pz == pz):
            continue
        (i, fx), (j, fy), (k, fz) = _cell(px, nx, False), _cell(py, ny, False), _cell(pz, nz, False)
        for a in range(2):
            if not 0 <= i + a < nx:
                continue
            wx = masses[n] * (fx if a else 1.0 - fx)
            for b in range(2):
                if not 0 <= j + b < ny:
                    continue
                wy = wx * (fy if b else 1.0 - fy)
                for c in range(2):
                    if 0 <= k + c < nz:
                        total[i + a, j + b, k + c] += wy * (fz if c else 1.0 - fz)
