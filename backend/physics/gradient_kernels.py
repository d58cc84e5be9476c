"""Compiled vector-Jacobian products of the passes in projection.py, each a gather over a particle's neighbours.

Symbols as there: x positions, u motion, d = x_i - x_j, r = |d|, s = 1 - r of spiky, n = 1 - r^2 of poly6. A bar means the
gradient of the loss by what stands under it. What a pass sums over j is even (d -> -d leaves it) or odd in d, so the
gradient at particle i is again a sum over its own neighbours: with the sum of both bars where even, with their difference
where odd. No thread writes another's row: results do not depend on the number of threads.

Where r is below COINCIDENT the passes hold r fixed; so do the gradients.
"""

from __future__ import annotations

import math

import numpy as np
from numba import njit, prange

from .kernels import POLY6, SPIKY_SLOPE
from .projection import COINCIDENT, tensile_share

_SUMS = {"reassoc", "contract", "arcp", "nsz"}  # as in projection.py
_SMALLEST_SQUARE = COINCIDENT * COINCIDENT


@njit(cache=True, parallel=True, error_model="numpy", fastmath=_SUMS)
def approach_gradient(positions, motion, starts, indices, rest_density, rate_bars, position_bars, motion_bars):
    """Of approach: adds to position_bars [N, 3] and motion_bars [N, 3].

    rate_i = -a sum_j n^2 d.(u_i - u_j), even in d.
    """
    scale = -6.0 * POLY6 / rest_density
    for i in prange(positions.shape[0]):
        x, y, z = positions[i, 0], positions[i, 1], positions[i, 2]
        ux, uy, uz = motion[i, 0], motion[i, 1], motion[i, 2]
        own = rate_bars[i]
        gx, gy, gz, hx, hy, hz = 0.0, 0.0, 0.0, 0.0, 0.0, 0.0
        for k in range(starts[i], starts[i + 1]):
            j = np.uint32(indices[k])
            dx, dy, dz = x - positions[j, 0], y - positions[j, 1], z - positions[j, 2]
            vx, vy, vz = ux - motion[j, 0], uy - motion[j, 1], uz - motion[j, 2]
            near = max(1.0 - (dx * dx + dy * dy + dz * dz), 0.0)
            weight = (own + rate_bars[j]) * near
            along = -4.0 * weight * (dx * vx + dy * vy + dz * vz)
            weight *= near
            gx += weight * vx + along * dx
            gy += weight * vy + along * dy
            gz += weight * vz + along * dz
            hx += weight * dx
            hy += weight * dy
            hz += weight * dz
        position_bars[i, 0] += scale * gx
        position_bars[i, 1] += scale * gy
        position_bars[i, 2] += scale * gz
        motion_bars[i, 0] += scale * hx
        motion_bars[i, 1] += scale * hy
        motion_bars[i, 2] += scale * hz


@njit(cache=True, parallel=True, error_model="numpy", fastmath=_SUMS)
def correct_gradient(
    positions, starts, indices, rest_density, lambdas, moving, factors, tensile, exponent, shift_bars, impulse_bars,
    position_bars, lambda_bars, moving_bars, factor_bars, gradients, squares,
):  # fmt: skip
    """Of correct: adds to position_bars [N, 3] and lambda_bars [N]; writes moving_bars and factor_bars [N].

    shift_i = sum_j w (lambda_i + lambda_j - tensile) d, impulse_i = sum_j w (moving_i + moving_j) d, odd in d, with
    w = -c s^2 min(factor_i, factor_j) / r. Writes besides what constrain has summed and the next pass needs:
    gradients [N, 3] = sum_j s^2 d / r and squares [N] = sum_j s^4.
    """
    scale = SPIKY_SLOPE / rest_density
    for i in prange(positions.shape[0]):
        x, y, z = positions[i, 0], positions[i, 1], positions[i, 2]
        ax, ay, az = shift_bars[i, 0], shift_bars[i, 1], shift_bars[i, 2]
        bx, by, bz = impulse_bars[i, 0], impulse_bars[i, 1], impulse_bars[i, 2]
        own, own_moving, limit = lambdas[i], moving[i], factors[i]
        gx, gy, gz, qx, qy, qz, square = 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0
        to_lambda, to_moving, to_factor = 0.0, 0.0, 0.0
        for k in range(starts[i], starts[i + 1]):
            j = np.uint32(indices[k])
            dx, dy, dz = x - positions[j, 0], y - positions[j, 1], z - positions[j, 2]
            true_square = dx * dx + dy * dy + dz * dz
            squared = max(true_square, _SMALLEST_SQUARE)
            is_free = 1.0 if true_square >= _SMALLEST_SQUARE else 0.0
            inverse = 1.0 / math.sqrt(squared)
            share = max(1.0 - squared * inverse, 0.0)
            slope = share * share
            over = slope * inverse
            qx += over * dx
            qy += over * dy
            qz += over * dz
            square += slope * slope
            # a and b: what this pair's shift and impulse are asked for
            cx, cy, cz = ax - shift_bars[j, 0], ay - shift_bars[j, 1], az - shift_bars[j, 2]
            ex, ey, ez = bx - impulse_bars[j, 0], by - impulse_bars[j, 1], bz - impulse_bars[j, 2]
            asked = cx * dx + cy * dy + cz * dz
            asked_impulse = ex * dx + ey * dy + ez * dz
            tension = tensile * tensile_share(squared, exponent)
            pressure = own + lambdas[j] - tension
            impulse = own_moving + moving[j]
            smaller = min(limit, factors[j])
            weight = -scale * over * smaller
            to_lambda += weight * asked
            to_moving += weight * asked_impulse
            total = pressure * asked + impulse * asked_impulse
            # two that are limited alike share what changes their limit
            decides = 1.0 if limit < factors[j] else (0.5 if limit == factors[j] else 0.0)
            to_factor -= decides * scale * over * total
            # d(s^2 / r)/dr / r, and dT/dr / r of the tension T = tensile n^(3 exponent)
            bend = -(2.0 * share + over) * inverse * inverse
            steep = -6.0 * exponent * tension / max(1.0 - squared, 1e-300)
            radial = is_free * -scale * smaller * (bend * total - over * steep * asked)
            gx += weight * (pressure * cx + impulse * ex) + radial * dx
            gy += weight * (pressure * cy + impulse * ey) + radial * dy
            gz += weight * (pressure * cz + impulse * ez) + radial * dz
        position_bars[i, 0] += gx
        position_bars[i, 1] += gy
        position_bars[i, 2] += gz
        lambda_bars[i] += to_lambda
        moving_bars[i], factor_bars[i] = to_moving, to_factor
        gradients[i, 0], gradients[i, 1], gradients[i, 2], squares[i] = qx, qy, qz, square


@njit(cache=True, parallel=True, error_model="numpy", fastmath=_SUMS)
def constrain_gradient(positions, starts, indices, density_bars, gradient_bars, square_bars, position_bars):
    """Of constrain's three sums: adds to position_bars [N, 3].

    density = POLY6 (1 + sum_j n^3) and squares = sum_j s^4 are even in d, gradients = sum_j s^2 d / r is odd.
    """
    for i in prange(positions.shape[0]):
        x, y, z = positions[i, 0], positions[i, 1], positions[i, 2]
        ax, ay, az = gradient_bars[i, 0], gradient_bars[i, 1], gradient_bars[i, 2]
        own_density, own_square = density_bars[i], square_bars[i]
        gx, gy, gz = 0.0, 0.0, 0.0
        for k in range(starts[i], starts[i + 1]):
            j = np.uint32(indices[k])
            dx, dy, dz = x - positions[j, 0], y - positions[j, 1], z - positions[j, 2]
            true_square = dx * dx + dy * dy + dz * dz
            squared = max(true_square, _SMALLEST_SQUARE)
            is_free = 1.0 if true_square >= _SMALLEST_SQUARE else 0.0
            inverse = 1.0 / math.sqrt(squared)
            share = max(1.0 - squared * inverse, 0.0)
            over = share * share * inverse
            near = max(1.0 - squared, 0.0)
            cx, cy, cz = ax - gradient_bars[j, 0], ay - gradient_bars[j, 1], az - gradient_bars[j, 2]
            bend = -(2.0 * share + over) * inverse * inverse * (cx * dx + cy * dy + cz * dz)
            fall = -6.0 * POLY6 * near * near * (own_density + density_bars[j])
            fall -= 4.0 * share * share * share * inverse * (own_square + square_bars[j])
            radial = is_free * (bend + fall)
            gx += over * cx + radial * dx
            gy += over * cy + radial * dy
            gz += over * cz + radial * dz
        position_bars[i, 0] += gx
        position_bars[i, 1] += gy
        position_bars[i, 2] += gz


@njit(cache=True, parallel=True, error_model="numpy", fastmath=_SUMS)
def density_gradient(positions, starts, indices, density_bars, position_bars):
    """Of the poly6 density alone: adds to position_bars [N, 3]."""
    for i in prange(positions.shape[0]):
        gx, gy, gz = 0.0, 0.0, 0.0
        for k in range(starts[i], starts[i + 1]):
            j = np.uint32(indices[k])
            dx, dy, dz = positions[i, 0] - positions[j, 0], positions[i, 1] - positions[j, 1], positions[i, 2] - positions[j, 2]
            near = max(1.0 - (dx * dx + dy * dy + dz * dz), 0.0)
            fall = -6.0 * POLY6 * near * near * (density_bars[i] + density_bars[j])
            gx += fall * dx
            gy += fall * dy
            gz += fall * dz
        position_bars[i, 0] += gx
        position_bars[i, 1] += gy
        position_bars[i, 2] += gz


@njit(cache=True, parallel=True, error_model="numpy", fastmath=_SUMS)
def blend_gradient(positions, motion, starts, indices, densities, share, blend_bars, position_bars, motion_bars, density_bars):
    """Of blend: adds to position_bars and motion_bars [N, 3], writes density_bars [N].

    blended_i = u_i + share sum_j w (u_j - u_i), w = W / max(rho_i, rho_j), odd under exchange of i and j.
    """
    for i in prange(positions.shape[0]):
        gx, gy, gz, hx, hy, hz, to_density = 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0
        own = densities[i]
        for k in range(starts[i], starts[i + 1]):
            j = np.uint32(indices[k])
            dx, dy, dz = positions[i, 0] - positions[j, 0], positions[i, 1] - positions[j, 1], positions[i, 2] - positions[j, 2]
            near = max(1.0 - (dx * dx + dy * dy + dz * dz), 0.0)
            over = POLY6 * near * near / max(own, densities[j])
            bx, by, bz = (
                blend_bars[j, 0] - blend_bars[i, 0],
                blend_bars[j, 1] - blend_bars[i, 1],
                blend_bars[j, 2] - blend_bars[i, 2],
            )
            along = -(
                bx * (motion[j, 0] - motion[i, 0]) + by * (motion[j, 1] - motion[i, 1]) + bz * (motion[j, 2] - motion[i, 2])
            )
            weight = over * near
            hx += weight * bx
            hy += weight * by
            hz += weight * bz
            gx -= 6.0 * over * along * dx
            gy -= 6.0 * over * along * dy
            gz -= 6.0 * over * along * dz
            decides = 1.0 if own > densities[j] else (0.5 if own == densities[j] else 0.0)
            to_density -= decides * weight * along / own
        position_bars[i, 0] += share * gx
        position_bars[i, 1] += share * gy
        position_bars[i, 2] += share * gz
        motion_bars[i, 0] += blend_bars[i, 0] + share * hx
        motion_bars[i, 1] += blend_bars[i, 1] + share * hy
        motion_bars[i, 2] += blend_bars[i, 2] + share * hz
        density_bars[i] = share * to_density
