"""Poisson's equation with a weight of its own in each voxel."""

from __future__ import annotations

import numpy as np
from numba import njit, prange
from scipy import fft

_PRECISION = 0.002  # of the potential; with ten times that a rounding that ends it a step earlier can be seen in the pictures
_MOST_ITERATIONS = 60


def weighted_poisson(weight: np.ndarray, divergence: np.ndarray) -> np.ndarray:
    """p [X, Y, Z] with div(weight grad p) = divergence between closed walls, lengths in voxels; divergence must sum to zero.

    Conjugate gradients; the solution for an even weight, by cosines, is the preconditioner.
    """
    eigenvalues = np.zeros(weight.shape)
    for axis, size in enumerate(weight.shape):
        eigenvalues += np.reshape(2.0 - 2.0 * np.cos(np.pi * np.arange(size) / size), np.roll(np.array([size, 1, 1]), axis))
    eigenvalues.flat[0] = np.inf  # the mean is nobody's business
    eigenvalues *= float(weight.mean())

    def even(values: np.ndarray) -> np.ndarray:
        return np.asarray(fft.idctn(np.asarray(fft.dctn(values)) / eigenvalues))

    found, pushed = np.zeros(weight.shape), np.empty(weight.shape)
    weight = np.ascontiguousarray(weight, np.float64)
    residual = divergence.mean() - divergence
    step = guess = even(residual)
    slope = float((residual * guess).sum())
    goal = _PRECISION**2 * slope
    for _ in range(_MOST_ITERATIONS):
        if not slope > goal:
            break
        _push(weight, step, pushed)
        length = slope / float((step * pushed).sum())
        found += length * step
        residual = residual - length * pushed
        guess = even(residual)
        slope, before = float((residual * guess).sum()), slope
        step = guess + (slope / before) * step
    return found


@njit(cache=True, parallel=True)
def _push(weight, values, pushed):
    """pushed = -div(weight grad values): what flows out of each voxel through its six faces, none through a wall."""
    nx, ny, nz = values.shape
    for i in prange(nx):
        for j in range(ny):
            for k in range(nz):
                here, value, total = weight[i, j, k], values[i, j, k], 0.0
                if i > 0:
                    total += (here + weight[i - 1, j, k]) * (value - values[i - 1, j, k])
                if i + 1 < nx:
                    total += (here + weight[i + 1, j, k]) * (value - values[i + 1, j, k])
                if j > 0:
                    total += (here + weight[i, j - 1, k]) * (value - values[i, j - 1, k])
                if j + 1 < ny:
                    total += (here + weight[i, j + 1, k]) * (value - values[i, j + 1, k])
                if k > 0:
                    total += (here + weight[i, j, k - 1]) * (value - values[i, j, k - 1])
                if k + 1 < nz:
                    total += (here + weight[i, j, k + 1]) * (value - values[i, j, k + 1])
                pushed[i, j, k] = 0.5 * total
