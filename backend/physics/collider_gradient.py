"""Vector-Jacobian products of push_out and deflect in colliders.py.

A collider only tells distances and normals, so how these change with position is measured by central differences, and
only at the particles that touch: any collider will do, and a slope is good to about eight digits. Which particles touch
is held fixed.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from .colliders import Collider

_STEP = 1e-5  # smoothing lengths between the points of a difference and its centre


def _slopes(
    collider: Collider,
    positions: np.ndarray,  # [M, 3] m
    step: float,  # m
) -> tuple[np.ndarray, np.ndarray]:  # [M, 3], [M, 3, 3] 1/m
    """Gradient of the distance, and [:, a, b] of component a of the normal along axis b."""
    distance_slopes, normal_slopes = np.empty((len(positions), 3)), np.empty((len(positions), 3, 3))
    for axis in range(3):
        offset = np.zeros(3)
        offset[axis] = step
        beyond, before = collider.distances(positions + offset), collider.distances(positions - offset)
        distance_slopes[:, axis] = (beyond[0] - before[0]) / (2.0 * step)
        normal_slopes[:, :, axis] = (beyond[1] - before[1]) / (2.0 * step)
    return distance_slopes, normal_slopes


def push_out_gradient(
    positions: np.ndarray,  # [N, 3] m, before
    colliders: Sequence[Collider],
    bars: np.ndarray,  # [N, 3], by the positions after
    *,
    smoothing_length: float,  # m
) -> np.ndarray:  # [N, 3], by the positions before
    """p' = p - d(p) n(p) for those inside: bar = bar' - grad d (n . bar') - d (dn/dp)^T bar'."""
    reached = [positions]
    for collider in colliders:
        distances, normals = collider.distances(reached[-1])
        reached.append(reached[-1] - np.minimum(distances, 0.0)[:, None] * normals)
    for collider, before in zip(reversed(colliders), reversed(reached[:-1]), strict=True):
        distances, normals = collider.distances(before)
        hit = np.flatnonzero(distances < 0.0)
        if len(hit):
            to_distance, to_normal = _slopes(collider, before[hit], _STEP * smoothing_length)
            bar = bars[hit]
            along = np.einsum("mi,mi->m", normals[hit], bar)
            bars = bars.copy()
            bars[hit] = bar - along[:, None] * to_distance - distances[hit, None] * np.einsum("mab,ma->mb", to_normal, bar)
    return bars


def deflect_gradient(
    velocities: np.ndarray,  # [N, 3] m/s, before
    positions: np.ndarray,  # [N, 3] m
    colliders: Sequence[Collider],
    bars: np.ndarray,  # [N, 3], by the velocities after
    *,
    margin: float,  # m
    smoothing_length: float,  # m
) -> tuple[np.ndarray, np.ndarray]:  # [N, 3] by the velocities before, [N, 3] by the positions
    """v' = (1 - friction) (v - (v . n) n) for those that touch and lead in."""
    position_bars = np.zeros_like(positions)
    met: list[tuple[np.ndarray, np.ndarray]] = []  # rows that were hit, and their velocities before
    for collider in colliders:
        distances, normals = collider.distances(positions)
        inward = np.einsum("ni,ni->n", velocities, normals)
        hit = np.flatnonzero((distances <= margin) & (inward < 0.0))
        met.append((hit, velocities[hit]))
        velocities = velocities.copy()
        velocities[hit] = (1.0 - collider.friction) * (velocities[hit] - inward[hit, None] * normals[hit])
    for collider, (hit, before) in zip(reversed(colliders), reversed(met), strict=True):
        if len(hit):
            _, normals = collider.distances(positions[hit])
            _, to_normal = _slopes(collider, positions[hit], _STEP * smoothing_length)
            bar = (1.0 - collider.friction) * bars[hit]
            inward, asked = np.einsum("mi,mi->m", before, normals), np.einsum("mi,mi->m", bar, normals)
            normal_bar = -inward[:, None] * bar - asked[:, None] * before
            position_bars[hit] += np.einsum("mab,ma->mb", to_normal, normal_bar)
            bars = bars.copy()
            bars[hit] = bar - asked[:, None] * normals
    return bars, position_bars
