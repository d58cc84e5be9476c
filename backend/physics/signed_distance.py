"""Signed distance of a closed triangle mesh on a lattice.

Near the surface, within BAND voxels, distances are exact; beyond, they are the distance to the band plus what the band
holds there, too large by up to a fifth, which only concerns what has got deep inside. The sign is the majority of three
parities, of the surfaces crossed along x, y and z: one small hole spoils at most the columns through it along one axis.
"""

from __future__ import annotations

import math

import numpy as np
from numba import njit, prange
from scipy.ndimage import distance_transform_edt

BAND = 2.0  # voxels on each side of the surface

# Columns are searched a little off the lattice, by shares of a voxel that no modelled edge has.
_OFF = (7.3148e-5, 4.1713e-5)


@njit(cache=True, inline="always")
def _minus(a, b):
    return a[0] - b[0], a[1] - b[1], a[2] - b[2]


@njit(cache=True, inline="always")
def _dot(a, b):
    return a[0] * b[0] + a[1] * b[1] + a[2] * b[2]


@njit(cache=True, inline="always")
def _cross(a, b):
    return a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]


@njit(cache=True)
def _segment_squared(p, a, b):
    """Squared distance of p from the segment a b."""
    d, e = _minus(b, a), _minus(p, a)
    length = _dot(d, d)
    t = min(max(_dot(e, d) / length, 0.0), 1.0) if length > 0.0 else 0.0
    rest = (e[0] - t * d[0], e[1] - t * d[1], e[2] - t * d[2])
    return _dot(rest, rest)


@njit(cache=True)
def triangle_squared(p, a, b, c):
    """Squared distance of p from a triangle: to its plane if p lies above it, else to its nearest edge. Tuples of 3."""
    ab, ac, ap = _minus(b, a), _minus(c, a), _minus(p, a)
    normal = _cross(ab, ac)
    area = _dot(normal, normal)
    if area > 0.0:
        v = _dot(_cross(ap, ac), normal) / area
        w = _dot(_cross(ab, ap), normal) / area
        if v >= 0.0 and w >= 0.0 and v + w <= 1.0:
            height = _dot(ap, normal)
            return height * height / area
    return min(_segment_squared(p, a, b), _segment_squared(p, b, c), _segment_squared(p, c, a))


@njit(cache=True, inline="always")
def _corner(vertices, index):
    return vertices[index, 0], vertices[index, 1], vertices[index, 2]


@njit(cache=True, parallel=True)
def _fill_band(vertices, triangles, squared):
    """squared [X, Y, Z] of nodes near each triangle is lowered to the squared distance, in voxels. A slab a thread."""
    for x in prange(squared.shape[0]):
        for t in range(triangles.shape[0]):
            a, b, c = _corner(vertices, triangles[t, 0]), _corner(vertices, triangles[t, 1]), _corner(vertices, triangles[t, 2])
            if min(a[0], b[0], c[0]) - BAND <= x <= max(a[0], b[0], c[0]) + BAND:
                low_y = max(math.ceil(min(a[1], b[1], c[1]) - BAND), 0)
                high_y = min(math.floor(max(a[1], b[1], c[1]) + BAND), squared.shape[1] - 1)
                low_z = max(math.ceil(min(a[2], b[2], c[2]) - BAND), 0)
                high_z = min(math.floor(max(a[2], b[2], c[2]) + BAND), squared.shape[2] - 1)
                for y in range(low_y, high_y + 1):
                    for z in range(low_z, high_z + 1):
                        found = triangle_squared((float(x), float(y), float(z)), a, b, c)
                        squared[x, y, z] = min(squared[x, y, z], found)


@njit(cache=True)
def _count_crossings(vertices, triangles, counts):
    """counts [X, Y, Z + 1]: surfaces that the column through (x, y) crosses just before node z."""
    for t in range(triangles.shape[0]):
        a, b, c = _corner(vertices, triangles[t, 0]), _corner(vertices, triangles[t, 1]), _corner(vertices, triangles[t, 2])
        area = (b[0] - a[0]) * (c[1] - a[1]) - (b[1] - a[1]) * (c[0] - a[0])
        if area != 0.0:
            for x in range(max(math.floor(min(a[0], b[0], c[0])), 0), min(math.ceil(max(a[0], b[0], c[0])) + 1, counts.shape[0])):
                for y in range(
                    max(math.floor(min(a[1], b[1], c[1])), 0), min(math.ceil(max(a[1], b[1], c[1])) + 1, counts.shape[1])
                ):
                    px, py = x + _OFF[0] - a[0], y + _OFF[1] - a[1]
                    v = (px * (c[1] - a[1]) - py * (c[0] - a[0])) / area
                    w = ((b[0] - a[0]) * py - (b[1] - a[1]) * px) / area
                    if v >= 0.0 and w >= 0.0 and v + w < 1.0:
                        height = a[2] + v * (b[2] - a[2]) + w * (c[2] - a[2])
                        counts[x, y, min(max(math.ceil(height), 0), counts.shape[2] - 1)] += 1


def _is_inside(vertices: np.ndarray, triangles: np.ndarray, shape: tuple[int, int, int]) -> np.ndarray:  # [X, Y, Z] bool
    """Majority of the three parities."""
    votes = np.zeros(shape, np.int8)
    for axis in range(3):
        order = [(axis + 1) % 3, (axis + 2) % 3, axis]
        counts = np.zeros((shape[order[0]], shape[order[1]], shape[axis] + 1), np.int32)
        _count_crossings(np.ascontiguousarray(vertices[:, order]), triangles, counts)
        parity = np.cumsum(counts, axis=2)[..., :-1] & 1
        votes += np.moveaxis(parity, [0, 1, 2], order).astype(np.int8)
    return votes >= 2


def signed_distance_grid(
    vertices: np.ndarray,  # [V, 3] voxels, within the lattice by BAND on each side
    triangles: np.ndarray,  # [T, 3] int64
    shape: tuple[int, int, int],
) -> np.ndarray:  # [X, Y, Z] voxels, negative inside
    """Signed distance of the mesh at each node."""
    squared = np.full(shape, np.inf)
    _fill_band(vertices, triangles, squared)
    beyond, nearest = distance_transform_edt(~np.isfinite(squared), return_indices=True)  # pyright: ignore
    distances = np.sqrt(squared[tuple(nearest)]) + beyond
    return np.where(_is_inside(vertices, triangles, shape), -distances, distances)
