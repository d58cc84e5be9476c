"""Gaussians to splats: perspective projection of position, covariance and optical mass. All float64.

Zwicker et al. 2002 (EWA splatting, eq. 24): the projection is replaced by its first-order expansion at the centre, with
the 2x3 Jacobian J of (fx x/z, fy y/z). M = J W R S (W world to camera) holds the covariance as M M^T; its determinant is
the squared cross product of M's rows, which keeps its digits where a c - b^2 loses all of them (thin splats).
The optical mass becomes an area in px^2: the integral over the image of the optical depth along rays is
fx fy E[ sqrt(1 + X^2 + Y^2) / z^2 ] m with X = x/z, Y = y/z, taken at the centre.

A splat is stored as its distribution in y and the one of x given y, which suits drawing it row by row:
exp(-b dy^2 / 2 - a (dx - s dy)^2 / 2), C = variance in y = 1/b, s = covariance / C, 1/a = determinant / C.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from numba import njit, prange

from backend.geometry.camera import View

NEAR = 0.01  # m, at most; splats fade in from the near plane to twice its depth
NEAR_SHARE = 0.02  # of the distance of particles nearer than half a metre: a small scene has its near plane nearer too
TANGENT_LIMIT = 1.3  # of the tangent of half the field of view: where the Jacobian is held
DILATION = 0.3  # px^2 added to both variances: no splat is thinner than the sampling can show
CUT = 12.5  # splats end where their exponent is -CUT; the share of mass outside is exp(-CUT) = 3.7e-6
KERNEL_VARIANCE = 1.3  # of the up-sampling kernel, in squared cells of the coarser level
LEVEL_VARIANCE = 3.4  # least variance of a splat on a coarse level, squared cells; aliasing there is 2e-6 of its peak
MARGIN = 12  # cells around coarse levels: the kernel's reach, through all levels
SPLAT_FIELDS = 7  # u, v [cells, from the corner of the padded level], a, b [1/cells^2], s, amplitude per px^2, mass to px^2


class Lens(NamedTuple):  # a tuple, because numba takes those
    """A camera as the kernels need it: intrinsics in px, the range of x/z and y/z in which the Jacobian follows."""

    rotation: np.ndarray  # [3, 3] world to camera
    position: np.ndarray  # [3] m
    fx: float
    fy: float
    cx: float
    cy: float
    width: int
    height: int
    low_x: float
    high_x: float
    low_y: float
    high_y: float
    near: float  # m


def near_plane(
    positions: np.ndarray,  # [N, 3] m
    view: View,
) -> float:  # m
    """NEAR, or less before a small scene: NEAR_SHARE of the root mean square distance, so that a scene may have any scale."""
    distances = view.to_camera(positions)
    with np.errstate(over="ignore"):
        mean_square = float(np.einsum("ni,ni->", distances, distances)) / max(len(distances), 1)
    return min(NEAR, NEAR_SHARE * math.sqrt(mean_square)) if mean_square > 0.0 else NEAR


def make_lens(view: View, near: float) -> Lens:
    """Tangents are held where the image, widened by TANGENT_LIMIT, ends."""
    fx, fy, cx, cy, width, height = view.fx, view.fy, view.cx, view.cy, view.width, view.height
    beyond_x, beyond_y = (TANGENT_LIMIT - 1) * 0.5 * width / fx, (TANGENT_LIMIT - 1) * 0.5 * height / fy
    return Lens(
        rotation=np.ascontiguousarray(view.rotation_world_to_camera, np.float64),
        position=np.array(view.position, np.float64),
        fx=float(fx),
        fy=float(fy),
        cx=float(cx),
        cy=float(cy),
        width=int(width),
        height=int(height),
        low_x=-cx / fx - beyond_x,
        high_x=(width - cx) / fx + beyond_x,
        low_y=-cy / fy - beyond_y,
        high_y=(height - cy) / fy + beyond_y,
        near=float(near),
    )


@njit(cache=True, forceinline=True)
def narrowing(level: int) -> float:
    """Variance [px^2] that up-sampling from a level down to the image adds: kernel variance times 4^1 + ... + 4^level."""
    return KERNEL_VARIANCE * 4.0 * ((1 << 2 * level) - 1.0) / 3.0


@njit(cache=True, forceinline=True)
def _rotate(q, rotation, local):
    """local [9] = camera-from-world rotation [3, 3] times the rotation of the quaternion q [4] / |q|, row by row."""
    n = 1.0 / math.sqrt(q[0] * q[0] + q[1] * q[1] + q[2] * q[2] + q[3] * q[3])
    w, x, y, z = q[0] * n, q[1] * n, q[2] * n, q[3] * n
    for r in range(3):
        r0, r1, r2 = rotation[r, 0], rotation[r, 1], rotation[r, 2]
        local[3 * r] = r0 * (1 - 2 * (y * y + z * z)) + r1 * 2 * (x * y + w * z) + r2 * 2 * (x * z - w * y)
        local[3 * r + 1] = r0 * 2 * (x * y - w * z) + r1 * (1 - 2 * (x * x + z * z)) + r2 * 2 * (y * z + w * x)
        local[3 * r + 2] = r0 * 2 * (x * z + w * y) + r1 * 2 * (y * z - w * x) + r2 * (1 - 2 * (x * x + y * y))


@njit(cache=True, forceinline=True)
def fade_in(z, near):
    """Smooth step from 0 at near to 1 at twice near, and its derivative [1/m]."""
    t = (z - near) / near
    if t >= 1.0:
        return 1.0, 0.0
    return t * t * (3.0 - 2.0 * t), 6.0 * t * (1.0 - t) / near


@njit(cache=True, forceinline=True)
def project_one(position, quaternion, scales, lens, local, m):
    """One Gaussian: camera-axes position, tangents held in range; fills local [9] and, if it is seen, m [6] = J local S."""
    w = lens.rotation
    dx, dy, dz = position[0] - lens.position[0], position[1] - lens.position[1], position[2] - lens.position[2]
    x = w[0, 0] * dx + w[0, 1] * dy + w[0, 2] * dz
    y = w[1, 0] * dx + w[1, 1] * dy + w[1, 2] * dz
    z = w[2, 0] * dx + w[2, 1] * dy + w[2, 2] * dz
    if not z > lens.near:
        return x, y, z, 0.0, 0.0
    tx = min(max(x / z, lens.low_x), lens.high_x)
    ty = min(max(y / z, lens.low_y), lens.high_y)
    _rotate(quaternion, w, local)
    for k in range(3):
        m[k] = (local[k] - tx * local[6 + k]) * scales[k] * lens.fx / z
        m[3 + k] = (local[3 + k] - ty * local[6 + k]) * scales[k] * lens.fy / z
    return x, y, z, tx, ty


@njit(cache=True, forceinline=True)
def determinant_of(m):
    """Squared cross product of the two rows of m [6], and the cross product."""
    n0 = m[1] * m[5] - m[2] * m[4]
    n1 = m[2] * m[3] - m[0] * m[5]
    n2 = m[0] * m[4] - m[1] * m[3]
    return n0 * n0 + n1 * n1 + n2 * n2, n0, n1, n2


@njit(cache=True, forceinline=True)
def _level(m, num_levels):
    """The level whose cells are as coarse as the smaller variance of the dilated splat allows."""
    top, side = m[0] * m[0] + m[1] * m[1] + m[2] * m[2], m[3] * m[3] + m[4] * m[4] + m[5] * m[5]
    across = m[0] * m[3] + m[1] * m[4] + m[2] * m[5]
    dilated = determinant_of(m)[0] + DILATION * (top + side) + DILATION * DILATION
    smallest = dilated / (0.5 * (top + side) + DILATION + math.hypot(0.5 * (top - side), across))
    level = 0
    while level + 1 < num_levels and smallest >= LEVEL_VARIANCE * (4 << 2 * level):
        level += 1
    return level


@njit(cache=True, forceinline=True)
def _reach(centre, variance, cell, count):
    """First and last of `count` cells within the cut of a Gaussian with this variance [px^2]."""
    reach = math.sqrt(2 * CUT * variance) / cell
    return math.ceil(min(max(centre - reach, 0.0), float(count))), math.floor(max(min(centre + reach, count - 1.0), -1.0))


@njit(cache=True, forceinline=True)
def _splat_one(u, v, level, m, lens, splat, box):
    """Fills one splat but for its mass; False where it touches no cell of its level."""
    det = determinant_of(m)[0]
    top, side = m[0] * m[0] + m[1] * m[1] + m[2] * m[2], m[3] * m[3] + m[4] * m[4] + m[5] * m[5]
    across = m[0] * m[3] + m[1] * m[4] + m[2] * m[5]
    added = DILATION - narrowing(level)
    det, variance_x, variance_y = det + added * (top + side) + added * added, top + added, side + added
    cell = float(1 << level)
    margin = MARGIN if level else 0
    centre_x, centre_y = u / cell - 0.5 + margin, v / cell - 0.5 + margin
    box[0], box[1] = _reach(centre_y, variance_y, cell, math.ceil(lens.height / cell) + 2 * margin)
    box[2], box[3] = _reach(centre_x, variance_x, cell, math.ceil(lens.width / cell) + 2 * margin)
    splat[0], splat[1] = centre_x, centre_y
    splat[2], splat[3] = variance_y / det * cell * cell, cell * cell / variance_y
    splat[4] = across / variance_y
    splat[5] = 1.0 / (2 * math.pi * math.sqrt(det))
    return box[0] <= box[1] and box[2] <= box[3]


@njit(cache=True, parallel=True)
def project(positions, scales, rotations, lens, num_levels, num_chunks, splats, levels, boxes):
    """Fills splats [N, SPLAT_FIELDS], levels [N] (-1: not visible) and boxes [N, 4], the cells that a splat may touch.

    A box is first row, last row, first column, last column on the level, margins counted.
    """
    num = positions.shape[0]
    for chunk in prange(num_chunks):
        local, m = np.empty(9), np.empty(6)
        for i in range(chunk * num // num_chunks, (chunk + 1) * num // num_chunks):
            levels[i] = -1
            splats[i] = 0.0
            x, y, z, tx, ty = project_one(positions[i], rotations[i], scales[i], lens, local, m)
            if z > lens.near:
                level = _level(m, num_levels)
                u, v = lens.fx * x / z + lens.cx, lens.fy * y / z + lens.cy
                if _splat_one(u, v, level, m, lens, splats[i], boxes[i]):
                    levels[i] = level
                    fade = fade_in(z, lens.near)[0]
                    splats[i, 6] = lens.fx * lens.fy * math.sqrt(1 + tx * tx + ty * ty) / (z * z) * fade
            if levels[i] < 0:
                splats[i] = 0.0
                boxes[i, 0], boxes[i, 1], boxes[i, 2], boxes[i, 3] = 0, -1, 0, -1
