"""The pressure solve: makes the velocity free of divergence on the staggered grid.

Sides and lid are open (pressure 0 on the outer faces), the floor is a wall (no flow).
With these ends the seven-point Laplacian is diagonal in a DST-II along x and y and a DCT-IV along z: even about the
floor, odd about the other faces (Martucci 1994, table of symmetric convolutions). An obstacle breaks that; then the
same transform preconditions conjugate gradients.
"""

from __future__ import annotations

import functools

import numpy as np
from scipy import fft

_MAX_ITERATIONS = 200
_TOLERANCE = 1e-9  # of the norm of the right-hand side

Velocity = tuple[np.ndarray, np.ndarray, np.ndarray]


def project(velocity: Velocity, *, open_faces: Velocity | None = None) -> Velocity:
    """The nearest velocity without divergence: v - grad p with Laplace(p) = div(v), both in units of cells.

    open_faces: 1 where air may pass, 0 on the faces of an obstacle; None where there is none. Returns float32.
    """
    u, v, w = (component.astype(np.float64) for component in velocity)
    w[:, :, 0] = 0.0
    if open_faces is None:
        pressure = _solve_laplace(_divergence(u, v, w))
    else:
        u, v, w = u * open_faces[0], v * open_faces[1], w * open_faces[2]
        pressure = _solve_around(_divergence(u, v, w), open_faces)
    gu, gv, gw = _gradient(pressure)
    if open_faces is not None:
        gu, gv, gw = gu * open_faces[0], gv * open_faces[1], gw * open_faces[2]
    return (u - gu).astype(np.float32), (v - gv).astype(np.float32), (w - gw).astype(np.float32)


def open_faces_of(solid: np.ndarray) -> Velocity:  # [nx, ny, nz] bool
    """1 on the faces between two cells of air, 0 on the faces of solid cells; the outer sides stay open."""
    air = np.pad(~solid, 1, mode="edge").astype(np.float64)
    u = air[1:, 1:-1, 1:-1] * air[:-1, 1:-1, 1:-1]
    v = air[1:-1, 1:, 1:-1] * air[1:-1, :-1, 1:-1]
    w = air[1:-1, 1:-1, 1:] * air[1:-1, 1:-1, :-1]
    w[:, :, 0] = 0.0
    return u, v, w


def _divergence(u: np.ndarray, v: np.ndarray, w: np.ndarray) -> np.ndarray:
    return np.diff(u, axis=0) + np.diff(v, axis=1) + np.diff(w, axis=2)


def _gradient(p: np.ndarray) -> Velocity:
    """Differences across every face. Open faces: the pressure beyond is -p, so that it is 0 on the face; floor: 0."""
    u = np.diff(np.concatenate([-p[:1], p, -p[-1:]], axis=0), axis=0)
    v = np.diff(np.concatenate([-p[:, :1], p, -p[:, -1:]], axis=1), axis=1)
    w = np.diff(np.concatenate([p[:, :, :1], p, -p[:, :, -1:]], axis=2), axis=2)
    return u, v, w


def _solve_laplace(right: np.ndarray) -> np.ndarray:
    """Laplace(p) = right with the ends above, exact to rounding."""
    spectrum = fft.dct(fft.dstn(right, type=2, axes=(0, 1)), type=4, axis=2)
    spectrum /= _eigenvalues(right.shape)
    return fft.idstn(fft.idct(spectrum, type=4, axis=2), type=2, axes=(0, 1))


@functools.lru_cache(maxsize=2)
def _eigenvalues(shape: tuple[int, int, int]) -> np.ndarray:
    nx, ny, nz = shape
    x = 2 * np.cos(np.pi * np.arange(1, nx + 1) / nx) - 2
    y = 2 * np.cos(np.pi * np.arange(1, ny + 1) / ny) - 2
    z = 2 * np.cos(np.pi * (np.arange(nz) + 0.5) / nz) - 2
    return x[:, None, None] + y[None, :, None] + z[None, None, :]


def _solve_around(right: np.ndarray, open_faces: Velocity) -> np.ndarray:
    """Conjugate gradients on div(open grad p) = right, preconditioned with the solve for the empty box."""

    def apply(p: np.ndarray) -> np.ndarray:
        gu, gv, gw = _gradient(p)
        return _divergence(gu * open_faces[0], gv * open_faces[1], gw * open_faces[2])

    # np.sum, not np.dot: its order of summation does not depend on the number of threads.
    pressure = np.zeros_like(right)
    residual = right.copy()
    target = _TOLERANCE * np.sqrt(np.sum(right * right))
    direction = np.zeros_like(right)
    previous = 1.0
    for _ in range(_MAX_ITERATIONS):
        if np.sqrt(np.sum(residual * residual)) <= target:
            return pressure
        conditioned = _solve_laplace(residual)
        current = np.sum(residual * conditioned)
        direction = conditioned + (current / previous) * direction
        previous = current
        applied = apply(direction)
        length = current / np.sum(direction * applied)
        pressure += length * direction
        residual -= length * applied
    raise ArithmeticError(f"the pressure solve did not converge in {_MAX_ITERATIONS} iterations")
