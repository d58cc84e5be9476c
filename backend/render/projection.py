"""Gaussians to splats: perspective projection of position, covariance and optical mass, and its gradient. All float64.

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

import numpy as np
from numba import njit, prange

NEAR = 0.01  # m; splats fade in from here to twice this depth
TANGENT_LIMIT = 1.3  # of the tangent of half the field of view: where the Jacobian is held
DILATION = 0.3  # px^2 added to both variances: no splat is thinner than the sampling can show
CUT = 12.5  # splats end where their exponent is -CUT; the share of mass outside is exp(-CUT) = 3.7e-6
KERNEL_VARIANCE = 1.3  # of the up-sampling kernel, in squared cells of the coarser level
LEVEL_VARIANCE = 3.4  # least variance of a splat on a coarse level, squared cells; aliasing there is 2e-6 of its peak
MARGIN = 12  # cells around coarse levels: the kernel's reach, through all levels
SPLAT_FIELDS = 7  # u, v [cells, from the corner of the padded level], a, b [1/cells^2], s, amplitude per px^2, mass to px^2


@njit(cache=True)
def narrowing(level: int) -> float:
    """Variance [px^2] that up-sampling from a level down to the image adds: kernel variance times 4^1 + ... + 4^level."""
    return KERNEL_VARIANCE * 4.0 * (4.0**level - 1.0) / 3.0


@njit(cache=True)
def _rotate(q, rotation, local):
    """local [9] = camera-from-world rotation [3, 3] times the rotation of the quaternion q [4] / |q|, row by row."""
    n = 1.0 / math.sqrt(q[0] * q[0] + q[1] * q[1] + q[2] * q[2] + q[3] * q[3])
    w, x, y, z = q[0] * n, q[1] * n, q[2] * n, q[3] * n
    for r in range(3):
        r0, r1, r2 = rotation[r, 0], rotation[r, 1], rotation[r, 2]
        local[3 * r] = r0 * (1 - 2 * (y * y + z * z)) + r1 * 2 * (x * y + w * z) + r2 * 2 * (x * z - w * y)
        local[3 * r + 1] = r0 * 2 * (x * y - w * z) + r1 * (1 - 2 * (x * x + z * z)) + r2 * 2 * (y * z + w * x)
        local[3 * r + 2] = r0 * 2 * (x * z + w * y) + r1 * 2 * (y * z - w * x) + r2 * (1 - 2 * (x * x + y * y))


@njit(cache=True)
def _fade(z, near):
    """Smooth step from 0 at near to 1 at twice near, and its derivative [1/m]."""
    t = (z - near) / near
    if t >= 1.0:
        return 1.0, 0.0
    return t * t * (3.0 - 2.0 * t), 6.0 * t * (1.0 - t) / near


@njit(cache=True)
def _clamped(tangent, low, high):
    return min(max(tangent, low), high)


@njit(cache=True)
def _project_one(p, q, s, rotation, camera, near, local, m):
    """One Gaussian: camera-axes position, clamped tangents, factor from mass to px^2; fills local [9] and m [6]."""
    dx, dy, dz = p[0] - camera[6], p[1] - camera[7], p[2] - camera[8]
    x = rotation[0, 0] * dx + rotation[0, 1] * dy + rotation[0, 2] * dz
    y = rotation[1, 0] * dx + rotation[1, 1] * dy + rotation[1, 2] * dz
    z = rotation[2, 0] * dx + rotation[2, 1] * dy + rotation[2, 2] * dz
    if not z > near:
        return x, y, z, 0.0, 0.0
    fx, fy, cx, cy, width, height = camera[0], camera[1], camera[2], camera[3], camera[4], camera[5]
    beyond_x, beyond_y = (TANGENT_LIMIT - 1) * 0.5 * width / fx, (TANGENT_LIMIT - 1) * 0.5 * height / fy
    tx = _clamped(x / z, -cx / fx - beyond_x, (width - cx) / fx + beyond_x)
    ty = _clamped(y / z, -cy / fy - beyond_y, (height - cy) / fy + beyond_y)
    _rotate(q, rotation, local)
    for k in range(3):
        m[k] = (local[k] - tx * local[6 + k]) * s[k] * fx / z
        m[3 + k] = (local[3 + k] - ty * local[6 + k]) * s[k] * fy / z
    return x, y, z, tx, ty


@njit(cache=True)
def _determinant(m):
    """Squared cross product of the two rows of m [6], and the cross product."""
    n0 = m[1] * m[5] - m[2] * m[4]
    n1 = m[2] * m[3] - m[0] * m[5]
    n2 = m[0] * m[4] - m[1] * m[3]
    return n0 * n0 + n1 * n1 + n2 * n2, n0, n1, n2


@njit(cache=True)
def _level(top, side, across, determinant, num_levels):
    """The level whose cells are as coarse as the splat's smaller variance allows."""
    largest = 0.5 * (top + side) + math.hypot(0.5 * (top - side), across)
    smallest = determinant / largest
    level = 0
    while level + 1 < num_levels and smallest >= LEVEL_VARIANCE * 4.0 ** (level + 1):
        level += 1
    return level


@njit(cache=True)
def _reach(centre, variance, cell, count):
    """First and last of `count` cells within the cut of a Gaussian with this variance [px^2]."""
    reach = math.sqrt(2 * CUT * variance) / cell
    return math.ceil(min(max(centre - reach, 0.0), float(count))), math.floor(max(min(centre + reach, count - 1.0), -1.0))


@njit(cache=True, parallel=True)
def project(positions, scales, rotations, rotation, camera, near, num_levels, num_chunks, splats, levels, boxes):
    """Fills splats [N, SPLAT_FIELDS], levels [N] (-1: not visible) and boxes [N, 4], the cells that a splat may touch.

    A box is first row, last row, first column, last column on the level, margins counted.

    rotation: world to camera [3, 3]; camera: fx, fy, cx, cy, width, height, position x, y, z [9].
    """
    num = positions.shape[0]
    for chunk in prange(num_chunks):
        local, m = np.empty(9), np.empty(6)
        for i in range(chunk * num // num_chunks, (chunk + 1) * num // num_chunks):
            levels[i] = -1
            boxes[i, 0], boxes[i, 1], boxes[i, 2], boxes[i, 3] = 0, -1, 0, -1
            for k in range(SPLAT_FIELDS):
                splats[i, k] = 0.0
            x, y, z, tx, ty = _project_one(positions[i], rotations[i], scales[i], rotation, camera, near, local, m)
            if not z > near:
                continue
            det = _determinant(m)[0]
            top, side = m[0] * m[0] + m[1] * m[1] + m[2] * m[2], m[3] * m[3] + m[4] * m[4] + m[5] * m[5]
            across = m[0] * m[3] + m[1] * m[4] + m[2] * m[5]
            dilated = det + DILATION * (top + side) + DILATION * DILATION
            level = _level(top + DILATION, side + DILATION, across, dilated, num_levels)
            added = DILATION - narrowing(level)
            det, variance_x, variance_y = det + added * (top + side) + added * added, top + added, side + added
            fx, fy, width, height = camera[0], camera[1], camera[4], camera[5]
            u, v = fx * x / z + camera[2], fy * y / z + camera[3]
            cell = 2.0**level
            margin = MARGIN if level else 0
            centre_x, centre_y = u / cell - 0.5 + margin, v / cell - 0.5 + margin
            first, last = _reach(centre_y, variance_y, cell, math.ceil(height / cell) + 2 * margin)
            left, right = _reach(centre_x, variance_x, cell, math.ceil(width / cell) + 2 * margin)
            if first > last or left > right:
                continue
            px2 = fx * fy * math.sqrt(1 + tx * tx + ty * ty) / (z * z) * _fade(z, near)[0]
            levels[i] = level
            boxes[i, 0], boxes[i, 1], boxes[i, 2], boxes[i, 3] = first, last, left, right
            splats[i, 0], splats[i, 1] = centre_x, centre_y
            splats[i, 2], splats[i, 3] = variance_y / det * cell * cell, cell * cell / variance_y
            splats[i, 4] = across / variance_y
            splats[i, 5] = 1.0 / (2 * math.pi * math.sqrt(det))
            splats[i, 6] = px2


@njit(cache=True)
def _covariance_gradient(m, level, sums, splat, dm):
    """Gradient with respect to m [6] from the sums of one splat; adds to dm [6]. sums: see splat_kernels, in cells.

    With A the amplitude, L = A sums0 and so on: dL/da = A (S0/a - S2) / 2, dL/db = A (S0/b - Y2) / 2, dL/ds = A a X.
    """
    a, b, s = splat[2], splat[3], splat[4]
    cell2 = 4.0**level
    added = DILATION - narrowing(level)
    det, n0, n1, n2 = _determinant(m)
    top, side = m[0] * m[0] + m[1] * m[1] + m[2] * m[2], m[3] * m[3] + m[4] * m[4] + m[5] * m[5]
    variance = side + added  # C
    det = det + added * (top + side) + added * added
    # 1/a = det / C and 1/b = C in px^2
    d_inverse_a = -(a / cell2) * 0.5 * (sums[0] - a * sums[2])
    d_inverse_b = -(b / cell2) * 0.5 * (sums[0] - b * sums[4])
    ds = a * sums[5]
    d_det = d_inverse_a / variance
    d_across = ds / variance
    d_variance = d_inverse_b - d_inverse_a * det / (variance * variance) - ds * s / variance
    d_trace = added * d_det
    n0, n1, n2 = 2 * n0 * d_det, 2 * n1 * d_det, 2 * n2 * d_det
    for k in range(3):
        dm[k] = 2 * d_trace * m[k] + d_across * m[3 + k]
        dm[3 + k] = 2 * (d_trace + d_variance) * m[3 + k] + d_across * m[k]
    dm[0] += m[4] * n2 - m[5] * n1
    dm[1] += m[5] * n0 - m[3] * n2
    dm[2] += m[3] * n1 - m[4] * n0
    dm[3] += n1 * m[2] - n2 * m[1]
    dm[4] += n2 * m[0] - n0 * m[2]
    dm[5] += n0 * m[1] - n1 * m[0]


@njit(cache=True)
def _quaternion_gradient(q, d, out):
    """Gradient with respect to q [4] from d [9], the one of the matrix of q / |q|; tangent to the unit sphere."""
    n = 1.0 / math.sqrt(q[0] * q[0] + q[1] * q[1] + q[2] * q[2] + q[3] * q[3])
    w, x, y, z = q[0] * n, q[1] * n, q[2] * n, q[3] * n
    gw = 2 * (x * (d[7] - d[5]) + y * (d[2] - d[6]) + z * (d[3] - d[1]))
    gx = 2 * (w * (d[7] - d[5]) + y * (d[1] + d[3]) + z * (d[2] + d[6]) - 2 * x * (d[4] + d[8]))
    gy = 2 * (w * (d[2] - d[6]) + x * (d[1] + d[3]) + z * (d[5] + d[7]) - 2 * y * (d[0] + d[8]))
    gz = 2 * (w * (d[3] - d[1]) + x * (d[2] + d[6]) + y * (d[5] + d[7]) - 2 * z * (d[0] + d[4]))
    along = w * gw + x * gx + y * gy + z * gz
    out[0], out[1] = (gw - w * along) * n, (gx - x * along) * n
    out[2], out[3] = (gy - y * along) * n, (gz - z * along) * n


@njit(cache=True, parallel=True)
def project_backward(
    positions,
    scales,
    rotations,
    masses,
    rotation,
    camera,
    near,
    num_chunks,
    splats,
    levels,
    sums,
    d_positions,
    d_scales,
    d_rotations,
    d_masses,
    d_camera,
):
    """From sums [N, 6] (see splat_kernels) to the gradients of the inputs, and of the camera per chunk [chunks, 6].

    d_camera: of a translation and of a rotation (axis times angle) of the camera, both in camera axes.
    """
    num = positions.shape[0]
    fx, fy, width, height = camera[0], camera[1], camera[4], camera[5]
    beyond_x, beyond_y = (TANGENT_LIMIT - 1) * 0.5 * width / fx, (TANGENT_LIMIT - 1) * 0.5 * height / fy
    low_x, high_x = -camera[2] / fx - beyond_x, (width - camera[2]) / fx + beyond_x
    low_y, high_y = -camera[3] / fy - beyond_y, (height - camera[3]) / fy + beyond_y
    for chunk in prange(num_chunks):
        local, m, dm, d_local, d_world, scaled = np.empty(9), np.empty(6), np.empty(6), np.empty(9), np.empty(9), np.empty(6)
        for i in range(chunk * num // num_chunks, (chunk + 1) * num // num_chunks):
            if levels[i] < 0:
                continue
            x, y, z, tx, ty = _project_one(positions[i], rotations[i], scales[i], rotation, camera, near, local, m)
            a, b, s, peak, px2 = splats[i, 2], splats[i, 3], splats[i, 4], splats[i, 5], splats[i, 6]
            d_masses[i] = sums[i, 0] * peak * px2
            amplitude = masses[i] * px2 * peak
            for k in range(6):
                scaled[k] = amplitude * sums[i, k]
            cell = 2.0 ** levels[i]
            du = a * scaled[1] / cell
            dv = (b * scaled[3] - a * s * scaled[1]) / cell
            _covariance_gradient(m, levels[i], scaled, splats[i], dm)
            # position: through the centre, the Jacobian and the mass
            long2 = 1 + tx * tx + ty * ty
            fade, d_fade = _fade(z, near)
            dz = masses[i] * sums[i, 0] * peak * fx * fy * math.sqrt(long2) / (z * z) * (d_fade - 2 * fade / z)
            dtx, dty = scaled[0] * tx / long2, scaled[0] * ty / long2
            for k in range(3):
                dz -= (dm[k] * m[k] + dm[3 + k] * m[3 + k]) / z
                dtx -= dm[k] * local[6 + k] * scales[i, k] * fx / z
                dty -= dm[3 + k] * local[6 + k] * scales[i, k] * fy / z
            dx, dy = fx / z * du, fy / z * dv
            dz -= (fx * x * du + fy * y * dv) / (z * z)
            if low_x < x / z < high_x:
                dx += dtx / z
                dz -= dtx * x / (z * z)
            if low_y < y / z < high_y:
                dy += dty / z
                dz -= dty * y / (z * z)
            for k in range(3):
                d_positions[i, k] = rotation[0, k] * dx + rotation[1, k] * dy + rotation[2, k] * dz
            # shape: m = J local S, local = rotation R
            turn_x, turn_y, turn_z = y * dz - z * dy, z * dx - x * dz, x * dy - y * dx
            for k in range(3):
                g0, g1 = dm[k] * fx / z, dm[3 + k] * fy / z
                g2 = -tx * g0 - ty * g1
                d_scales[i, k] = g0 * local[k] + g1 * local[3 + k] + g2 * local[6 + k]
                g0, g1, g2 = g0 * scales[i, k], g1 * scales[i, k], g2 * scales[i, k]
                d_local[k], d_local[3 + k], d_local[6 + k] = g0, g1, g2
                turn_x += local[3 + k] * g2 - local[6 + k] * g1
                turn_y += local[6 + k] * g0 - local[k] * g2
                turn_z += local[k] * g1 - local[3 + k] * g0
            for r in range(3):
                for k in range(3):
                    d_world[3 * r + k] = (
                        rotation[0, r] * d_local[k] + rotation[1, r] * d_local[3 + k] + rotation[2, r] * d_local[6 + k]
                    )
            _quaternion_gradient(rotations[i], d_world, d_rotations[i])
            d_camera[chunk, 0] -= dx
            d_camera[chunk, 1] -= dy
            d_camera[chunk, 2] -= dz
            d_camera[chunk, 3] -= turn_x
            d_camera[chunk, 4] -= turn_y
            d_camera[chunk, 5] -= turn_z
