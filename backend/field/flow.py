"""Air on a staggered grid, and what drifts in it: a step of an incompressible, buoyant fluid.

u, v, w stand on the faces of the voxels across x, y, z. A step of a plume is: forces, projection, transport of what drifts,
advection of the air itself, projection (Stam 1999; staggered after Harlow and Welch 1965).

The sides and the lid are open (pressure 0), the floor is closed if there is one. On such a box the Laplacian of the pressure
is diagonal under sine transforms of type II, and a cosine transform of type IV along z over a floor, so projection is exact
to rounding. Equal bytes for any number of threads: every face and voxel is computed by one thread from what was before.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
import scipy.fft
from numba import njit, prange

from backend.geometry.lattice import Lattice

_LARGEST_COURANT = 0.4  # of a stage of the transport; the sum over the axes stays below 1, so nothing becomes negative


@dataclass(frozen=True, slots=True, kw_only=True)
class Air:
    """u [X+1, Y, Z], v [X, Y+1, Z], w [X, Y, Z+1] m/s, float32, on faces."""

    u: np.ndarray
    v: np.ndarray
    w: np.ndarray


def uniform_air(lattice: Lattice, velocity: tuple[float, float, float] = (0.0, 0.0, 0.0)) -> Air:
    """Air that moves as one, m/s."""
    x, y, z = lattice.shape
    shapes = ((x + 1, y, z), (x, y + 1, z), (x, y, z + 1))
    u, v, w = (np.full(shape, speed, np.float32) for shape, speed in zip(shapes, velocity, strict=True))
    return Air(u=u, v=v, w=w)


def at_centres(air: Air) -> np.ndarray:
    """[X, Y, Z, 3] m/s at the voxels' centres."""
    return np.stack(
        [
            0.5 * (air.u[1:] + air.u[:-1]),
            0.5 * (air.v[:, 1:] + air.v[:, :-1]),
            0.5 * (air.w[:, :, 1:] + air.w[:, :, :-1]),
        ],
        axis=-1,
    )


def pushed(air: Air, change: np.ndarray) -> Air:
    """The air after its velocity at the centres changed by [X, Y, Z, 3] m/s; an outer face takes that of its only voxel."""
    faces = []
    for axis, face in enumerate((air.u, air.v, air.w)):
        width = [(1, 1) if other == axis else (0, 0) for other in range(3)]
        padded = np.pad(change[..., axis], width, mode="edge")
        low = tuple(slice(None, -1) if other == axis else slice(None) for other in range(3))
        high = tuple(slice(1, None) if other == axis else slice(None) for other in range(3))
        faces.append((face + 0.5 * (padded[low] + padded[high])).astype(np.float32))
    return Air(u=faces[0], v=faces[1], w=faces[2])


def divergence(air: Air, lattice: Lattice) -> np.ndarray:
    """[X, Y, Z] 1/s."""
    total = (air.u[1:] - air.u[:-1]) + (air.v[:, 1:] - air.v[:, :-1]) + (air.w[:, :, 1:] - air.w[:, :, :-1])
    return total / np.float32(lattice.voxel_size)


def projected(air: Air, lattice: Lattice, *, has_floor: bool) -> Air:
    """The nearest air without divergence (Chorin 1968)."""
    w = air.w
    if has_floor:
        w = w.copy()
        w[:, :, 0] = 0.0
    source = divergence(Air(u=air.u, v=air.v, w=w), lattice)
    pressure = _solve_poisson(source, lattice, has_floor=has_floor)
    h = np.float32(lattice.voxel_size)
    wide = np.pad(pressure, 1)
    # Half a voxel beyond an open side the pressure is 0: the value of the mirrored voxel is the negative.
    wide[0, 1:-1, 1:-1], wide[-1, 1:-1, 1:-1] = -pressure[0], -pressure[-1]
    wide[1:-1, 0, 1:-1], wide[1:-1, -1, 1:-1] = -pressure[:, 0], -pressure[:, -1]
    wide[1:-1, 1:-1, -1] = -pressure[:, :, -1]
    wide[1:-1, 1:-1, 0] = pressure[:, :, 0] if has_floor else -pressure[:, :, 0]
    return Air(
        u=air.u - np.diff(wide, axis=0)[:, 1:-1, 1:-1] / h,
        v=air.v - np.diff(wide, axis=1)[1:-1, :, 1:-1] / h,
        w=w - np.diff(wide, axis=2)[1:-1, 1:-1, :] / h,
    )


def _solve_poisson(source: np.ndarray, lattice: Lattice, *, has_floor: bool) -> np.ndarray:
    """Laplacian of the result is `source` [X, Y, Z] float32, with the sides' and the floor's conditions."""
    x, y, z = source.shape
    spectrum = scipy.fft.dstn(source, type=2, axes=(0, 1), norm="ortho")
    spectrum = (
        scipy.fft.dct(spectrum, type=4, axis=2, norm="ortho") if has_floor else scipy.fft.dst(spectrum, axis=2, norm="ortho")
    )
    angles = [np.pi * (np.arange(size) + 1) / size for size in (x, y)]
    angles.append(np.pi * ((np.arange(z) + 0.5) if has_floor else (np.arange(z) + 1)) / z)
    waves = [(2.0 - 2.0 * np.cos(angle)) / lattice.voxel_size**2 for angle in angles]
    spectrum /= -(waves[0][:, None, None] + waves[1][None, :, None] + waves[2]).astype(np.float32)
    if has_floor:
        spectrum = scipy.fft.dct(spectrum, type=4, axis=2, norm="ortho")  # its own inverse
        return np.asarray(scipy.fft.idstn(spectrum, type=2, axes=(0, 1), norm="ortho"), np.float32)
    return np.asarray(scipy.fft.idstn(spectrum, type=2, norm="ortho"), np.float32)


def transported(amounts: np.ndarray, air: Air, lattice: Lattice, *, seconds: float) -> np.ndarray:
    """[..., X, Y, Z] of what drifts with the air, later; nothing comes in from outside, what leaves is gone.

    Upwind fluxes with van Leer's limiter (1974) and Heun's two stages: the sum over the voxels changes by what leaves, to
    rounding, and nothing becomes negative. Long steps are cut into short ones.
    """
    fastest = sum(float(np.abs(face).max(initial=0.0)) for face in (air.u, air.v, air.w))
    steps = max(1, math.ceil(fastest * seconds / lattice.voxel_size / _LARGEST_COURANT))
    share = np.float32(seconds / steps / lattice.voxel_size)
    stack = np.ascontiguousarray(amounts.reshape(-1, *amounts.shape[-3:]), np.float32)
    found = np.empty_like(stack)
    for layer in range(len(stack)):
        now = stack[layer]
        for _ in range(steps):
            first, second = np.empty_like(now), np.empty_like(now)
            _outflow(now, air.u, air.v, air.w, share, first)
            _outflow(first, air.u, air.v, air.w, share, second)
            now = 0.5 * (now + second)
        found[layer] = now
    return found.reshape(amounts.shape)


def advected(air: Air, lattice: Lattice, *, seconds: float, outside: tuple[float, float, float] = (0.0, 0.0, 0.0)) -> Air:
    """The air carried along by itself, back along the flow by the midpoint rule, with MacCormack's correction limited to the
    values around (Selle 2008). Air that comes in moves with `outside`, m/s."""
    share = np.float32(seconds / lattice.voxel_size)
    faces = []
    for axis, face in enumerate((air.u, air.v, air.w)):
        ahead, low, high = np.empty_like(face), np.empty_like(face), np.empty_like(face)
        back, nothing = np.empty_like(face), np.empty_like(face)
        speed = np.float32(outside[axis])
        _follow(face, air.u, air.v, air.w, axis, share, speed, ahead, low, high)
        _follow(ahead, air.u, air.v, air.w, axis, -share, speed, back, nothing, nothing)
        faces.append(np.clip(ahead + 0.5 * (face - back), low, high))
    return Air(u=faces[0], v=faces[1], w=faces[2])


@njit(cache=True, inline="always")
def _limited(before, here, after):  # half the slope between neighbours by van Leer, 0 at an extremum
    a, b = here - before, after - here
    return a * b / (a + b) if a * b > 0.0 else np.float32(0.0)


@njit(cache=True, inline="always")
def _flux(speed, q0, q1, q2, q3):  # through the face between q1 and q2, q0 and q3 beyond
    if speed > 0.0:
        return speed * (q1 + _limited(q0, q1, q2))
    return speed * (q2 - _limited(q1, q2, q3))


@njit(cache=True, inline="always")
def _value(q, i, j, k):  # 0 outside
    if i < 0 or j < 0 or k < 0 or i >= q.shape[0] or j >= q.shape[1] or k >= q.shape[2]:
        return np.float32(0.0)
    return q[i, j, k]


@njit(cache=True, parallel=True, error_model="numpy")
def _outflow(q, u, v, w, share, out):
    nx, ny, nz = q.shape
    for i in prange(nx):
        for j in range(ny):
            for k in range(nz):
                here = q[i, j, k]
                x1, x2 = _value(q, i - 1, j, k), _value(q, i + 1, j, k)
                y1, y2 = _value(q, i, j - 1, k), _value(q, i, j + 1, k)
                z1, z2 = _value(q, i, j, k - 1), _value(q, i, j, k + 1)
                total = _flux(u[i + 1, j, k], x1, here, x2, _value(q, i + 2, j, k))
                total -= _flux(u[i, j, k], _value(q, i - 2, j, k), x1, here, x2)
                total += _flux(v[i, j + 1, k], y1, here, y2, _value(q, i, j + 2, k))
                total -= _flux(v[i, j, k], _value(q, i, j - 2, k), y1, here, y2)
                total += _flux(w[i, j, k + 1], z1, here, z2, _value(q, i, j, k + 2))
                total -= _flux(w[i, j, k], _value(q, i, j, k - 2), z1, here, z2)
                out[i, j, k] = here - share * total


@njit(cache=True, inline="always")
def _sample(q, x, y, z):  # trilinear between the entries of q, held at its edges
    x = min(max(x, 0.0), q.shape[0] - 1.0)
    y = min(max(y, 0.0), q.shape[1] - 1.0)
    z = min(max(z, 0.0), q.shape[2] - 1.0)
    i, j, k = min(int(x), q.shape[0] - 2), min(int(y), q.shape[1] - 2), min(int(z), q.shape[2] - 2)
    a, b, c = x - i, y - j, z - k
    low = (1 - b) * ((1 - c) * q[i, j, k] + c * q[i, j, k + 1]) + b * ((1 - c) * q[i, j + 1, k] + c * q[i, j + 1, k + 1])
    i += 1
    high = (1 - b) * ((1 - c) * q[i, j, k] + c * q[i, j, k + 1]) + b * ((1 - c) * q[i, j + 1, k] + c * q[i, j + 1, k + 1])
    return (1 - a) * low + a * high


@njit(cache=True, parallel=True, error_model="numpy")
def _follow(q, u, v, w, axis, share, outside, out, low, high):
    """out: q where the flow comes from (share > 0) or goes to; low, high: of the eight values that it lies between."""
    nx, ny, nz = q.shape
    ox, oy, oz = (0.0 if axis == 0 else 0.5), (0.0 if axis == 1 else 0.5), (0.0 if axis == 2 else 0.5)
    for i in prange(nx):
        for j in range(ny):
            for k in range(nz):
                # In voxels, the corner of the grid at 0: faces of u at whole x and half y, z.
                x, y, z = i + ox, j + oy, k + oz
                for stage in range(2):
                    part = share * (0.5 if stage == 0 else 1.0)
                    a = _sample(u, x, y - 0.5, z - 0.5)
                    b = _sample(v, x - 0.5, y, z - 0.5)
                    c = _sample(w, x - 0.5, y - 0.5, z)
                    x, y, z = i + ox - part * a, j + oy - part * b, k + oz - part * c
                x, y, z = x - ox, y - oy, z - oz
                if x < -0.5 or y < -0.5 or z < -0.5 or x > nx - 0.5 or y > ny - 0.5 or z > nz - 0.5:
                    out[i, j, k], low[i, j, k], high[i, j, k] = outside, outside, outside
                    continue
                out[i, j, k] = _sample(q, x, y, z)
                least, most = np.float32(np.inf), np.float32(-np.inf)
                for a in range(2):
                    for b in range(2):
                        for c in range(2):
                            ii = min(max(math.floor(x) + a, 0), nx - 1)
                            jj = min(max(math.floor(y) + b, 0), ny - 1)
                            kk = min(max(math.floor(z) + c, 0), nz - 1)
                            least, most = min(least, q[ii, jj, kk]), max(most, q[ii, jj, kk])
                low[i, j, k], high[i, j, k] = least, most
