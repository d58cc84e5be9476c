"""Gaussian particles -> extinction on a grid, with mass-weighted velocity and colour.

Symbols: m_i optical mass [m^2], G_i unit Gaussian of covariance S_i, h voxel size [m], x_v voxel centre.

    sigma(x_v) = sum_i m_i w_iv / h^3,   w_iv = G_i(x_v) / sum_u G_i(x_u)        extinction [1/m]
    a(x_v)     = sum_i m_i w_iv a_i / sum_i m_i w_iv                             velocity, colour

The weights of a particle sum to one over the lattice, so that sum_v sigma h^3 = sum_i m_i whatever the voxel size.
Renderers interpolate linearly between voxels, which widens what they see by the variance h^2/6 of a triangle; the
Gaussians are narrowed by it beforehand. One that would be narrower than 0.6 voxels is widened to that: below, a
lattice cannot show where it is. Slabs of the grid along x are filled in parallel, each by one thread in the order of
the particles: no atomics, equal bytes for any number of threads.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numba
import numpy as np

from backend.geometry.lattice import Lattice
from backend.io.particles import ParticleFrame

CUTOFF = 3.0  # standard deviations; what lies beyond (0.8 % of a Gaussian) is shared out within
MIN_SCALE_VOXELS = 0.6

_INTERPOLATION_VARIANCE = 1.0 / 6.0  # voxels^2, of the triangle of width 2 that linear interpolation convolves with
_SLAB = 4  # voxels along x filled by one thread at a time
_WIDE_AXIS = 64.0  # voxels; a sum over the lattice equals the integral to 1e-4 from here on: one voxel at the cutoff
_WIDE = 8.0  # voxels, the same for an ellipsoid, whose surface averages over many voxels


def splat_extents(frame: ParticleFrame, voxel_size: float) -> np.ndarray:  # [N, 3] m
    """Half width along x, y, z of the box that a particle fills, before voxels are counted."""
    factors = _covariance_factors(frame, voxel_size)
    return CUTOFF * np.sqrt(np.sum(factors * factors, axis=2)) * voxel_size


def voxelize(frame: ParticleFrame, lattice: Lattice, *, with_color: bool = False) -> dict[str, np.ndarray]:
    """The frame's grids, float32: density [X, Y, Z] 1/m, velocity [X, Y, Z, 3] m/s, color [X, Y, Z, 3] on request.

    What a particle has outside the lattice is lost; velocity and colour are 0 where density is. Raises ValueError
    if a number is not finite or the lattice is not usable.
    """
    h = lattice.voxel_size
    if not (math.isfinite(h) and h > 0 and np.all(np.isfinite(lattice.origin)) and min(lattice.shape) >= 0):
        raise ValueError(f"{lattice} is no lattice")
    attributes = [frame.velocities, frame.colors] if with_color else [frame.velocities]
    payload = np.concatenate([np.asarray(a, np.float32) for a in attributes], axis=1)
    factors = _covariance_factors(frame, h)
    centers = (np.asarray(frame.positions, np.float64) - np.array(lattice.origin)) / h
    masses = np.asarray(frame.optical_masses, np.float64)
    if not (
        np.isfinite(centers).all() and np.isfinite(factors).all() and np.isfinite(masses).all() and np.isfinite(payload).all()
    ):
        raise ValueError("a particle holds NaN or infinity")
    grids = {"density": np.zeros(lattice.shape, np.float32), "velocity": np.zeros((*lattice.shape, 3), np.float32)}
    if with_color:
        grids["color"] = np.zeros((*lattice.shape, 3), np.float32)
    if len(centers) and min(lattice.shape) > 0:
        _splat(centers, factors, masses / h**3, payload, _are_round(frame), grids)
    return grids


def _covariance_factors(frame: ParticleFrame, voxel_size: float) -> np.ndarray:  # [N, 3, 3] voxels
    """M with covariance M M^T in voxels: narrowed for linear interpolation, its axes at least MIN_SCALE_VOXELS long."""
    scales = np.asarray(frame.scales, np.float64) / voxel_size
    if scales.ndim == 1:
        scales = np.repeat(scales[:, None], 3, axis=1)
    axes = np.sqrt(np.maximum(scales * scales - _INTERPOLATION_VARIANCE, MIN_SCALE_VOXELS**2))
    return rotation_matrices(frame.rotations, len(scales)) * axes[:, None, :]


def _are_round(frame: ParticleFrame) -> np.ndarray:  # [N] bool
    if frame.rotations is None:
        return np.ones(frame.count, bool)
    scales = np.asarray(frame.scales)
    return np.ascontiguousarray((scales[:, 0] == scales[:, 1]) & (scales[:, 0] == scales[:, 2]))


def rotation_matrices(quaternions: np.ndarray | None, count: int) -> np.ndarray:  # [N, 3, 3]
    """Quaternions [N, 4] w x y z -> matrices, particle axes in the columns; None: no rotation."""
    if quaternions is None:
        return np.broadcast_to(np.eye(3), (count, 3, 3))
    q = np.asarray(quaternions, np.float64)
    length = np.linalg.norm(q, axis=1, keepdims=True)
    if np.any(length < 1e-6):
        raise ValueError("a rotation is zero")
    w, x, y, z = (q / length).T
    rows = [
        [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
        [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
        [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
    ]
    return np.stack([np.stack(row, axis=-1) for row in rows], axis=-2)


class _Boxes(NamedTuple):
    """Which voxels each particle fills, and which particles touch each slab along x (starts, members)."""

    low: np.ndarray  # [N, 3] int32
    high: np.ndarray  # [N, 3] int32, one past the last
    starts: np.ndarray  # [S + 1]
    members: np.ndarray  # int32, ascending within a slab


class _Targets(NamedTuple):
    """What is filled; color is [0, 0, 0, 3] where it is not wanted."""

    density: np.ndarray  # [X, Y, Z]
    velocity: np.ndarray  # [X, Y, Z, 3]
    color: np.ndarray  # [X, Y, Z, 3]


def _splat(
    centers: np.ndarray,  # [N, 3] voxels
    factors: np.ndarray,  # [N, 3, 3] voxels
    weights: np.ndarray,  # [N] m_i / h^3
    payload: np.ndarray,  # [N, 3 or 6] velocity, colour
    is_round: np.ndarray,  # [N]
    grids: dict[str, np.ndarray],
) -> None:
    targets = _Targets(grids["density"], grids["velocity"], grids.get("color", np.zeros((0, 0, 0, 3), np.float32)))
    widths = CUTOFF * np.sqrt(np.sum(factors * factors, axis=2))  # [N, 3]
    # The bounds are clipped as floats: a particle far outside would overflow an integer.
    limits = np.array(targets.density.shape, np.float64)
    low = np.clip(np.ceil(centers - widths), 0.0, limits).astype(np.int32)
    high = np.clip(np.floor(centers + widths) + 1.0, 0.0, limits).astype(np.int32)
    boxes = _Boxes(low, high, *_members_of_slabs(low, high, targets.density.shape[0]))
    with numba.parallel_chunksize(1):
        others = ~is_round
        sigmas = np.sqrt(np.sum(factors[:, 0] ** 2, axis=1))  # of round ones along every axis
        precision = np.zeros_like(factors)
        precision[others] = np.linalg.inv(factors[others] @ np.swapaxes(factors[others], 1, 2))
        sums = np.empty(len(centers))
        sums[is_round] = _axis_sums(centers[is_round], sigmas[is_round])
        volumes = np.abs(np.linalg.det(factors[others]))
        sums[others] = _lattice_sums(centers[others], widths[others], precision[others], volumes)
        _fill(centers, sigmas, precision, is_round, weights / sums, payload, boxes, targets)


@numba.njit(cache=True)
def _members_of_slabs(low, high, num_x):  # -> starts [S + 1], members
    """Which particles touch which slab of _SLAB voxels along x, in the order of the particles."""
    num_slabs = (num_x + _SLAB - 1) // _SLAB
    starts = np.zeros(num_slabs + 1, np.int64)
    for i in range(low.shape[0]):
        if high[i, 0] > low[i, 0] and high[i, 1] > low[i, 1] and high[i, 2] > low[i, 2]:
            for slab in range(low[i, 0] // _SLAB, (high[i, 0] - 1) // _SLAB + 1):
                starts[slab + 1] += 1
    for slab in range(num_slabs):
        starts[slab + 1] += starts[slab]
    members = np.empty(starts[num_slabs], np.int32)
    fill = starts[:num_slabs].copy()
    for i in range(low.shape[0]):
        if high[i, 0] > low[i, 0] and high[i, 1] > low[i, 1] and high[i, 2] > low[i, 2]:
            for slab in range(low[i, 0] // _SLAB, (high[i, 0] - 1) // _SLAB + 1):
                members[fill[slab]] = i
                fill[slab] += 1
    return starts, members


@numba.njit(cache=True, parallel=True)
def _axis_sums(centers, sigmas):  # -> [N] product over the axes of sum_v exp(-(v - center)^2 / 2 sigma^2) within the cutoff
    sums = np.ones(centers.shape[0], np.float64)
    for p in numba.prange(centers.shape[0]):
        sigma = sigmas[p]
        inverse = -0.5 / (sigma * sigma)
        for axis in range(3):
            if sigma >= _WIDE_AXIS:
                sums[p] *= sigma * math.sqrt(2.0 * math.pi) * math.erf(CUTOFF / math.sqrt(2.0))
                continue
            center = centers[p, axis]
            total = 0.0
            for v in range(math.ceil(center - CUTOFF * sigma), math.floor(center + CUTOFF * sigma) + 1):
                total += math.exp(inverse * (v - center) ** 2)
            sums[p] *= total
    return sums


@numba.njit(cache=True, parallel=True, fastmath={"contract", "nsz"})
def _fill(centers, sigmas, precision, is_round, amplitudes, payload, boxes, targets):
    """Round ones are separable: three short tables of exponentials, then a product per voxel."""
    num_x, num_y, num_z = targets.density.shape
    for slab in numba.prange(boxes.starts.shape[0] - 1):
        first = slab * _SLAB
        last = min(first + _SLAB, num_x)
        moments = np.zeros((payload.shape[1], last - first, num_y, num_z), np.float32)
        row = np.empty(num_z, np.float32)
        table = np.empty(num_z, np.float32)
        for member in range(boxes.starts[slab], boxes.starts[slab + 1]):
            p = boxes.members[member]
            cx, cy, cz = centers[p, 0], centers[p, 1], centers[p, 2]
            z0, z1 = boxes.low[p, 2], boxes.high[p, 2]
            if not is_round[p]:
                for i in range(max(boxes.low[p, 0], first), min(boxes.high[p, 0], last)):
                    for j in range(boxes.low[p, 1], boxes.high[p, 1]):
                        _gaussian_row(row, precision[p], i - cx, j - cy, z0 - cz, z1 - z0)
                        for k in range(z1 - z0):
                            row[k] *= amplitudes[p]
                        _add_row(row, targets.density[i, j], moments[:, i - first, j], payload[p], z0, z1)
                continue
            sigma = sigmas[p]
            inverse = -0.5 / (sigma * sigma)
            for k in range(z0, z1):
                table[k - z0] = math.exp(inverse * (k - cz) ** 2)
            for i in range(max(boxes.low[p, 0], first), min(boxes.high[p, 0], last)):
                along_x = amplitudes[p] * math.exp(inverse * (i - cx) ** 2)
                for j in range(boxes.low[p, 1], boxes.high[p, 1]):
                    along_xy = np.float32(along_x * math.exp(inverse * (j - cy) ** 2))
                    for k in range(z1 - z0):
                        row[k] = along_xy * table[k]
                    _add_row(row, targets.density[i, j], moments[:, i - first, j], payload[p], z0, z1)
        _write_means(moments, targets, first)


@numba.njit(cache=True)
def _gaussian_row(row, precision, dx, dy, dz, count):  # exp(-d^T P d / 2) along z from dz on, 0 beyond the cutoff
    constant = precision[0, 0] * dx * dx + precision[1, 1] * dy * dy + 2.0 * precision[0, 1] * dx * dy
    linear = 2.0 * (precision[0, 2] * dx + precision[1, 2] * dy)
    for k in range(count):
        z = dz + k
        squared = constant + z * (linear + z * precision[2, 2])
        row[k] = math.exp(-0.5 * squared) if squared <= CUTOFF * CUTOFF else 0.0


@numba.njit(cache=True, parallel=True)
def _lattice_sums(centers, widths, precision, volumes):  # -> [N] sum of a particle's Gaussian over the whole lattice
    sums = np.empty(centers.shape[0], np.float64)
    inside = math.erf(CUTOFF / math.sqrt(2.0)) - math.sqrt(2.0 / math.pi) * CUTOFF * math.exp(-0.5 * CUTOFF * CUTOFF)
    for p in numba.prange(centers.shape[0]):
        # Wide ones: the integral over the ellipsoid, without walking through all of it.
        if widths[p].min() > _WIDE * CUTOFF:
            sums[p] = volumes[p] * (2.0 * math.pi) ** 1.5 * inside
            continue
        z0 = math.ceil(centers[p, 2] - widths[p, 2])
        row = np.empty(math.floor(centers[p, 2] + widths[p, 2]) + 1 - z0, np.float32)
        total = 0.0
        for i in range(math.ceil(centers[p, 0] - widths[p, 0]), math.floor(centers[p, 0] + widths[p, 0]) + 1):
            for j in range(math.ceil(centers[p, 1] - widths[p, 1]), math.floor(centers[p, 1] + widths[p, 1]) + 1):
                _gaussian_row(row, precision[p], i - centers[p, 0], j - centers[p, 1], z0 - centers[p, 2], row.shape[0])
                for k in range(row.shape[0]):
                    total += row[k]
        sums[p] = total
    return sums


@numba.njit(cache=True, inline="always")
def _add_row(row, density, moments, payload, start, stop):
    for k in range(stop - start):
        density[start + k] += row[k]
    for c in range(moments.shape[0]):
        factor = payload[c]
        target = moments[c]
        for k in range(stop - start):
            target[start + k] += row[k] * factor


@numba.njit(cache=True)
def _write_means(moments, targets, first):
    """Divide a slab's moments [C, x, Y, Z] by its density, the component last as VDB wants it."""
    for i in range(moments.shape[1]):
        for j in range(moments.shape[2]):
            for k in range(moments.shape[3]):
                weight = targets.density[first + i, j, k]
                if weight > 0.0:
                    for c in range(3):
                        targets.velocity[first + i, j, k, c] = moments[c, i, j, k] / weight
                    for c in range(moments.shape[0] - 3):
                        targets.color[first + i, j, k, c] = moments[3 + c, i, j, k] / weight
