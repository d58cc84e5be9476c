"""The gradient of projection.py, by hand: from sums over each splat's cells to the particles and the camera. Float64."""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from numba import njit, prange

from .projection import DILATION, determinant_of, fade_in, narrowing, project_one


class Found(NamedTuple):
    """Where the gradients go; the camera's per chunk of Gaussians: translation and rotation, in camera axes."""

    positions: np.ndarray  # [N, 3]
    scales: np.ndarray  # [N, 3]
    rotations: np.ndarray  # [N, 4]
    optical_masses: np.ndarray  # [N]
    camera: np.ndarray  # [chunks, 6]


def no_gradients(num: int, num_chunks: int) -> Found:
    """Zeros for N Gaussians."""
    return Found(
        positions=np.zeros((num, 3)),
        scales=np.zeros((num, 3)),
        rotations=np.zeros((num, 4)),
        optical_masses=np.zeros(num),
        camera=np.zeros((num_chunks, 6)),
    )


@njit(cache=True, forceinline=True)
def _covariance_gradient(m, level, sums, splat, dm):
    """Gradient with respect to m [6] from the sums of one splat; adds to dm [6]. sums: see splat_kernels, in cells.

    With A the amplitude, L = A sums0 and so on: dL/da = A (S0/a - S2) / 2, dL/db = A (S0/b - Y2) / 2, dL/ds = A a X.
    """
    a, b, s = splat[2], splat[3], splat[4]
    cell2 = float(1 << 2 * level)
    added = DILATION - narrowing(level)
    det, n0, n1, n2 = determinant_of(m)
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


@njit(cache=True, forceinline=True)
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


@njit(cache=True, forceinline=True)
def _position_gradient(p, scales, local, m, dm, du, dv, d_log_mass, lens):
    """Camera-axes gradient of a position p (x, y, z, tx, ty): through the centre, the Jacobian and the mass.

    d_log_mass: gradient with respect to the logarithm of the mass in px^2, without the fade at the near plane.
    """
    x, y, z, tx, ty = p
    long2 = 1 + tx * tx + ty * ty
    dx, dy, dz = lens.fx / z * du, lens.fy / z * dv, -2 * d_log_mass / z
    dz -= (lens.fx * x * du + lens.fy * y * dv) / (z * z)
    dtx, dty = d_log_mass * tx / long2, d_log_mass * ty / long2
    for k in range(3):
        dz -= (dm[k] * m[k] + dm[3 + k] * m[3 + k]) / z
        dtx -= dm[k] * local[6 + k] * scales[k] * lens.fx / z
        dty -= dm[3 + k] * local[6 + k] * scales[k] * lens.fy / z
    if lens.low_x < x / z < lens.high_x:
        dx += dtx / z
        dz -= dtx * x / (z * z)
    if lens.low_y < y / z < lens.high_y:
        dy += dty / z
        dz -= dty * y / (z * z)
    return dx, dy, dz


@njit(cache=True, forceinline=True)
def _shape_gradient(p, quaternion, scales, local, dm, lens, d_local, d_world, d_scales, d_quaternion):
    """Through m = J local S: fills d_scales [3] and d_quaternion [4]; returns the turning moment of the shape [3]."""
    _, _, z, tx, ty = p
    w = lens.rotation
    turn_x, turn_y, turn_z = 0.0, 0.0, 0.0
    for k in range(3):
        g0, g1 = dm[k] * lens.fx / z, dm[3 + k] * lens.fy / z
        g2 = -tx * g0 - ty * g1
        d_scales[k] = g0 * local[k] + g1 * local[3 + k] + g2 * local[6 + k]
        g0, g1, g2 = g0 * scales[k], g1 * scales[k], g2 * scales[k]
        d_local[k], d_local[3 + k], d_local[6 + k] = g0, g1, g2
        turn_x += local[3 + k] * g2 - local[6 + k] * g1
        turn_y += local[6 + k] * g0 - local[k] * g2
        turn_z += local[k] * g1 - local[3 + k] * g0
    for r in range(3):
        for k in range(3):
            d_world[3 * r + k] = w[0, r] * d_local[k] + w[1, r] * d_local[3 + k] + w[2, r] * d_local[6 + k]
    _quaternion_gradient(quaternion, d_world, d_quaternion)
    return turn_x, turn_y, turn_z


@njit(cache=True, parallel=True)
def project_backward(positions, scales, rotations, masses, lens, num_chunks, splats, levels, sums, found):
    """Fills `found` (zero before) from sums [N, 6 or more] (see splat_kernels.py)."""
    num = positions.shape[0]
    # Taken out here: numba drops writes to an array that is still a member of a tuple inside a parallel loop.
    d_positions, d_scales, d_rotations, d_masses, d_camera = found
    for chunk in prange(num_chunks):
        local, m, dm, d_local, d_world, scaled = np.empty(9), np.empty(6), np.empty(6), np.empty(9), np.empty(9), np.empty(6)
        moved = d_camera[chunk]
        for i in range(chunk * num // num_chunks, (chunk + 1) * num // num_chunks):
            if levels[i] < 0:
                continue
            p = project_one(positions[i], rotations[i], scales[i], lens, local, m)
            x, y, z, tx, ty = p
            a, b, s, peak, to_px2 = splats[i, 2], splats[i, 3], splats[i, 4], splats[i, 5], splats[i, 6]
            d_masses[i] = sums[i, 0] * peak * to_px2
            for k in range(6):
                scaled[k] = masses[i] * to_px2 * peak * sums[i, k]
            cell = float(1 << levels[i])
            _covariance_gradient(m, levels[i], scaled, splats[i], dm)
            du, dv = a * scaled[1] / cell, (b * scaled[3] - a * s * scaled[1]) / cell
            dx, dy, dz = _position_gradient(p, scales[i], local, m, dm, du, dv, scaled[0], lens)
            # the fade itself may be 0 where its slope is not, so that its part cannot come from the logarithm
            slope = fade_in(z, lens.near)[1]
            dz += masses[i] * sums[i, 0] * peak * lens.fx * lens.fy * math.sqrt(1 + tx * tx + ty * ty) / (z * z) * slope
            for k in range(3):
                d_positions[i, k] = lens.rotation[0, k] * dx + lens.rotation[1, k] * dy + lens.rotation[2, k] * dz
            turn_x, turn_y, turn_z = _shape_gradient(
                p, rotations[i], scales[i], local, dm, lens, d_local, d_world, d_scales[i], d_rotations[i]
            )
            moved[0] -= dx
            moved[1] -= dy
            moved[2] -= dz
            moved[3] -= turn_x + y * dz - z * dy
            moved[4] -= turn_y + z * dx - x * dz
            moved[5] -= turn_z + x * dy - y * dx
