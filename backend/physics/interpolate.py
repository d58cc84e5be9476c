"""Values between particles: velocity at any point, and averages over neighbours.

Symbols: W poly6 of support h, x_j and v_j of the particles, x the point.

Inside the support: v(x) = sum_j W_j v_j / sum_j W_j. Where the sum of W fades out, inverse-distance weights over the
nearest eight take over by degrees; they vanish at the ninth (Franke & Little), so that the velocity is continuous
wherever a point moves and sensible however far it is.
"""

from __future__ import annotations

import math

import numpy as np
from numba import njit, prange
from scipy.spatial import KDTree

from .neighbours import MAX_RANGES, build_grid, candidate_ranges
from .state import FluidState
from .threads import threads_for

SPARSE = 0.05  # weight below which the nearest particles begin to have a say; 1: a particle in the very place
_NEAREST = 8


@njit(cache=True, parallel=True, error_model="numpy")
def _average(points, cell_size, shape, starts, order, coordinates, values, smoothing_length, num_tasks, sums, weights):
    """sums [M, C]: sum_j W_j / W(0) of values [N, C]; weights [M]: sum_j W_j / W(0)."""
    num, num_channels = points.shape[0], values.shape[1]
    scale = 1.0 / (smoothing_length * smoothing_length)
    for task in prange(num_tasks):
        ranges = np.empty((MAX_RANGES, 2), np.int64)
        for i in range(task * num // num_tasks, (task + 1) * num // num_tasks):
            x, y, z = points[i, 0], points[i, 1], points[i, 2]
            total = 0.0
            for c in range(num_channels):
                sums[i, c] = 0.0
            for row in range(candidate_ranges(x, y, z, smoothing_length, cell_size, shape, starts, ranges)):
                for k in range(ranges[row, 0], ranges[row, 1]):
                    dx, dy, dz = coordinates[0, k] - x, coordinates[1, k] - y, coordinates[2, k] - z
                    share = 1.0 - (dx * dx + dy * dy + dz * dz) * scale
                    if share > 0.0:
                        weight = share * share * share
                        total += weight
                        for c in range(num_channels):
                            sums[i, c] += weight * values[order[k], c]
            weights[i] = total


def _kernel_sums(
    points: np.ndarray,  # [M, 3] m
    positions: np.ndarray,  # [N, 3] m
    values: np.ndarray,  # [N, C]
    smoothing_length: float,  # m
) -> tuple[np.ndarray, np.ndarray]:  # [M, C], [M]
    grid = build_grid(positions, smoothing_length, reach=float(np.abs(points).max(initial=0.0)))
    sums, weights = np.zeros((len(points), values.shape[1])), np.zeros(len(points))
    num_tasks = max(1, min(256, len(points) // 64))
    with threads_for(len(points)):
        _average(
            points, grid.cell_size, grid.shape, grid.starts, grid.order, grid.coordinates, values, smoothing_length,
            num_tasks, sums, weights,
        )  # fmt: skip
    return sums, weights


def _checked(name: str, values: np.ndarray, width: int | None = None) -> np.ndarray:
    """[N, width] float64 in rows. Raises ValueError."""
    values = np.ascontiguousarray(values, np.float64)
    if values.ndim != 2 or (width is not None and values.shape[1] != width) or not np.isfinite(values).all():
        raise ValueError(f"{name} of shape {values.shape} are not [N, {width or 'C'}] finite numbers")
    return values


def interpolate_velocity(
    points: np.ndarray,  # [M, 3] m
    state: FluidState,
    smoothing_length: float,  # m
) -> tuple[np.ndarray, np.ndarray]:  # [M, 3] m/s, [M]
    """Velocity of the fluid at the points, and how well the particles cover them: sum of W / W(0), 0 out of reach.

    No particles at all: velocity 0.
    """
    points = _checked("points", points, 3)
    positions = _checked("positions", state.positions, 3)
    velocities = _checked("velocities", state.velocities, 3)
    _check_length(smoothing_length)
    if len(positions) == 0:
        return np.zeros_like(points), np.zeros(len(points))
    sums, weights = _kernel_sums(points, positions, velocities, smoothing_length)
    lack = np.maximum(1.0 - weights / SPARSE, 0.0) ** 2  # how much the nearest are asked, continuous in value and slope
    is_sparse = lack > 0.0
    share = SPARSE * lack[is_sparse]
    far = _from_nearest(points[is_sparse], positions, velocities, smoothing_length)
    sums[is_sparse] += share[:, None] * far
    total = weights.copy()
    total[is_sparse] += share
    return sums / total[:, None], weights


def _from_nearest(
    points: np.ndarray,  # [M, 3] m
    positions: np.ndarray,  # [N, 3] m
    values: np.ndarray,  # [N, C]
    smoothing_length: float,  # m
) -> np.ndarray:  # [M, C]
    """Inverse-distance average over the nearest; weights ((R - r) / (R r))^2, R the distance of the ninth."""
    if len(points) == 0 or len(positions) == 1:
        return np.repeat(values[:1], len(points), axis=0)
    count = min(_NEAREST + 1, len(positions))
    distances, nearest = KDTree(positions).query(points, k=count)
    # Softened, so that a particle in the very place has a finite weight and nine that coincide do not cancel out.
    radii = np.sqrt(np.square(distances) + np.square(1e-3 * smoothing_length))
    if count <= _NEAREST:
        weights = (radii[:, :1] / radii) ** 2
    else:
        outermost = radii[:, -1:] * (1.0 + 1e-6)
        weights = ((outermost - radii) * radii[:, :1] / ((outermost - radii[:, :1]) * radii)) ** 2
    return (weights[:, :, None] * values[nearest]).sum(axis=1) / weights.sum(axis=1, keepdims=True)


def smooth(
    field: np.ndarray,  # [N, C]
    state: FluidState,
    smoothing_length: float,  # m
) -> np.ndarray:  # [N, C]
    """A value per particle averaged over its neighbours with poly6 weights; the particle itself always counts."""
    positions = _checked("positions", state.positions, 3)
    field = _checked("field", field)
    _check_length(smoothing_length)
    if len(field) != len(positions):
        raise ValueError(f"field has {len(field)} rows for {len(positions)} particles")
    if len(positions) == 0:
        return field.copy()
    sums, weights = _kernel_sums(positions, positions, field, smoothing_length)
    return sums / weights[:, None]


def _check_length(smoothing_length: float) -> None:
    if not (math.isfinite(smoothing_length) and smoothing_length > 0.0):
        raise ValueError(f"smoothing_length = {smoothing_length!r} is not positive")
