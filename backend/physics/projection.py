"""Density projection of a position-based fluid: the compiled passes over neighbour lists.

Everything here is in units of the smoothing length and the substep: positions x [h], motion u [h per substep], number
density [1/h^3]. Scenes that differ in scale alone then differ in nothing.

Macklin & Mueller 2013, "Position Based Fluids": constraint C_i = rho_i / rho_0 - 1 (eq. 1), its gradients (eq. 8),
lambda_i (eq. 11), correction dx_i (eq. 12-14). What differs, and why:

- lambda's epsilon is a share of the sum of squared gradients at rest density; an absolute one means another fluid at
  every scale, and lambdas in the thousands for a pair on its own.
- Gas does not pull itself together: an under-dense particle has lambda 0.
- Only the part of the over-density that this substep's own motion has brought about turns into velocity. What was
  there before (particles born into each other, the last step's remainder) is put right in place; a published step
  turns it into a speed of overlap / dt, which has no bound.
- Every correction is exchanged between two particles, with opposite signs, also when it is limited: momentum stays.
"""

from __future__ import annotations

import math

import numpy as np
from numba import njit, prange

from .kernels import POLY6, SPIKY_SLOPE, poly6

COINCIDENT = 1e-6  # smoothing lengths; closer pairs are parted along a direction made from their ids

# Sums may be reordered, so that loops over neighbours run in vector registers. The order is fixed when compiled: results
# are the same for any number of threads, and differ between kinds of processor in the last digits.
_SUMS = {"reassoc", "contract", "arcp", "nsz"}
_SMALLEST_SQUARE = COINCIDENT * COINCIDENT  # h^2; under the root wherever a direction is needed


@njit(cache=True, inline="always")
def _mixed(value):
    """Splitmix64 finaliser (Steele et al. 2014): scrambles 64 bits."""
    value = (value ^ (value >> np.uint64(30))) * np.uint64(0xBF58476D1CE4E5B9)
    value = (value ^ (value >> np.uint64(27))) * np.uint64(0x94D049BB133111EB)
    return value ^ (value >> np.uint64(31))


@njit(cache=True)
def separation(id_a, id_b):
    """Unit vector that parts two coincident particles; that of (b, a) is its opposite. Two equal ids give 0."""
    low, high = min(id_a, id_b), max(id_a, id_b)
    sign = 0.0 if id_a == id_b else (1.0 if id_a < id_b else -1.0)
    bits = _mixed(np.uint64(low) * np.uint64(0x9E3779B97F4A7C15) + np.uint64(high))
    z = 2.0 * (np.float64(bits >> np.uint64(40)) + 0.5) / 16777216.0 - 1.0
    angle = 2.0 * math.pi * np.float64(bits & np.uint64(0xFFFFFF)) / 16777216.0
    radius = math.sqrt(1.0 - z * z)
    return sign * radius * math.cos(angle), sign * radius * math.sin(angle), sign * z


@njit(cache=True, parallel=True, error_model="numpy")
def part(positions, ids, starts, indices, parted):
    """Writes parted [N, 3]: positions with coincident pairs moved apart by 2 COINCIDENT, their centre kept."""
    for i in prange(positions.shape[0]):
        x, y, z = positions[i, 0], positions[i, 1], positions[i, 2]
        for k in range(starts[i], starts[i + 1]):
            j = indices[k]
            dx, dy, dz = positions[i, 0] - positions[j, 0], positions[i, 1] - positions[j, 1], positions[i, 2] - positions[j, 2]
            if dx * dx + dy * dy + dz * dz < _SMALLEST_SQUARE:
                dx, dy, dz = separation(ids[i], ids[j])
                x, y, z = x + COINCIDENT * dx, y + COINCIDENT * dy, z + COINCIDENT * dz
        parted[i, 0], parted[i, 1], parted[i, 2] = x, y, z


@njit(cache=True, parallel=True, error_model="numpy", fastmath=_SUMS)
def approach(positions, motion, starts, indices, rest_density, rates, nearest):
    """rates [N]: dC/dt for the motion, per substep; nearest [N]: squared distance of the closest neighbour [h^2]."""
    for i in prange(positions.shape[0]):
        rate, closest = 0.0, 1.0
        x, y, z = positions[i, 0], positions[i, 1], positions[i, 2]
        ux, uy, uz = motion[i, 0], motion[i, 1], motion[i, 2]
        for k in range(starts[i], starts[i + 1]):
            j = np.uint32(indices[k])
            dx, dy, dz = x - positions[j, 0], y - positions[j, 1], z - positions[j, 2]
            squared = dx * dx + dy * dy + dz * dz
            closest = min(closest, squared)
            near = max(1.0 - squared, 0.0)
            rate -= near * near * (dx * (ux - motion[j, 0]) + dy * (uy - motion[j, 1]) + dz * (uz - motion[j, 2]))
        rates[i] = 6.0 * POLY6 / rest_density * rate
        nearest[i] = closest


@njit(cache=True, parallel=True, error_model="numpy", fastmath=_SUMS)
def constrain(positions, starts, indices, rest_density, epsilon, pulls, densities, lambdas):
    """Writes densities [N] 1/h^3 and lambdas [N] h^2 (eq. 11).

    epsilon: added to the sum of squared gradients. pulls: under-dense particles attract.
    """
    scale = SPIKY_SLOPE / rest_density
    for i in prange(positions.shape[0]):
        total, squares, gx, gy, gz = 1.0, 0.0, 0.0, 0.0, 0.0
        x, y, z = positions[i, 0], positions[i, 1], positions[i, 2]
        for k in range(starts[i], starts[i + 1]):
            j = np.uint32(indices[k])
            dx, dy, dz = x - positions[j, 0], y - positions[j, 1], z - positions[j, 2]
            squared = max(dx * dx + dy * dy + dz * dz, _SMALLEST_SQUARE)
            near = max(1.0 - squared, 0.0)
            total += near * near * near
            inverse = 1.0 / math.sqrt(squared)
            slope = max(1.0 - squared * inverse, 0.0)
            slope *= slope
            squares += slope * slope
            over = slope * inverse
            gx += over * dx
            gy += over * dy
            gz += over * dz
        density = POLY6 * total
        constraint = density / rest_density - 1.0
        densities[i] = density
        squared_gradients = scale * scale * (gx * gx + gy * gy + gz * gz + squares)
        lambdas[i] = -(constraint if pulls else max(constraint, 0.0)) / (squared_gradients + epsilon)


@njit(cache=True, parallel=True, error_model="numpy", fastmath=_SUMS)
def correct(positions, starts, indices, rest_density, lambdas, moving, factors, tensile, exponent, shifts, impulses):
    """Writes shifts [N, 3], the corrections (eq. 14), and impulses [N, 3], the part of them that turns into velocity.

    moving [N]: the part of lambdas that does. factors [N]: limit of each particle's shift, a pair takes the smaller.
    tensile: strength of the artificial pressure (eq. 13, with distance 0.25 h) in units of lambda, exponent below 16;
    it parts particles and never turns into velocity.
    """
    scale = SPIKY_SLOPE / rest_density
    for i in prange(positions.shape[0]):
        sx, sy, sz, px, py, pz = 0.0, 0.0, 0.0, 0.0, 0.0, 0.0
        x, y, z = positions[i, 0], positions[i, 1], positions[i, 2]
        own, own_moving, limit = lambdas[i], moving[i], factors[i]
        for k in range(starts[i], starts[i + 1]):
            j = np.uint32(indices[k])
            dx, dy, dz = x - positions[j, 0], y - positions[j, 1], z - positions[j, 2]
            squared = max(dx * dx + dy * dy + dz * dz, _SMALLEST_SQUARE)
            inverse = 1.0 / math.sqrt(squared)
            slope = max(1.0 - squared * inverse, 0.0)
            over = -scale * slope * slope * inverse * min(limit, factors[j])
            pressure = over * (own + lambdas[j] - tensile * tensile_share(squared, exponent))
            impulse = over * (own_moving + moving[j])
            sx += pressure * dx
            sy += pressure * dy
            sz += pressure * dz
            px += impulse * dx
            py += impulse * dy
            pz += impulse * dz
        shifts[i, 0], shifts[i, 1], shifts[i, 2] = sx, sy, sz
        impulses[i, 0], impulses[i, 1], impulses[i, 2] = px, py, pz


@njit(cache=True, inline="always")
def tensile_share(squared, exponent):
    """(W(r) / W(0.25 h))^exponent by the bits of the exponent: selects, not branches."""
    base = max(1.0 - squared, 0.0) / (1.0 - 0.25 * 0.25)
    one = base * base * base
    two = one * one
    four = two * two
    power = one if exponent & 1 else 1.0
    power *= two if exponent & 2 else 1.0
    power *= four if exponent & 4 else 1.0
    power *= four * four if exponent & 8 else 1.0
    return power


@njit(cache=True, parallel=True, error_model="numpy")
def blend(positions, motion, starts, indices, densities, share, blended):
    """XSPH viscosity (Schechter & Bridson 2012; Macklin & Mueller 2013 eq. 17). Writes blended [N, 3].

    Divided by the larger density of a pair: what one gains the other loses, and with share at most 1 every new motion
    lies among the old ones.
    """
    for i in prange(positions.shape[0]):
        x, y, z = 0.0, 0.0, 0.0
        for k in range(starts[i], starts[i + 1]):
            j = indices[k]
            dx, dy, dz = positions[i, 0] - positions[j, 0], positions[i, 1] - positions[j, 1], positions[i, 2] - positions[j, 2]
            squared = dx * dx + dy * dy + dz * dz
            if squared < 1.0:
                weight = poly6(squared, 1.0) / max(densities[i], densities[j])
                x += weight * (motion[j, 0] - motion[i, 0])
                y += weight * (motion[j, 1] - motion[i, 1])
                z += weight * (motion[j, 2] - motion[i, 2])
        blended[i, 0] = motion[i, 0] + share * x
        blended[i, 1] = motion[i, 1] + share * y
        blended[i, 2] = motion[i, 2] + share * z


@njit(cache=True, parallel=True, error_model="numpy")
def curl(positions, motion, starts, indices, densities, curls):
    """Vorticity sum_j (u_j - u_i) x grad_j W / rho (Macklin & Mueller 2013 eq. 15). Writes curls [N, 3]."""
    for i in prange(positions.shape[0]):
        x, y, z = 0.0, 0.0, 0.0
        for k in range(starts[i], starts[i + 1]):
            j = indices[k]
            dx, dy, dz = positions[i, 0] - positions[j, 0], positions[i, 1] - positions[j, 1], positions[i, 2] - positions[j, 2]
            squared = max(dx * dx + dy * dy + dz * dz, _SMALLEST_SQUARE)
            if squared < 1.0:
                distance = math.sqrt(squared)
                over = SPIKY_SLOPE * (1.0 - distance) * (1.0 - distance) / distance / densities[i]
                gx, gy, gz = over * dx, over * dy, over * dz
                ux, uy, uz = motion[j, 0] - motion[i, 0], motion[j, 1] - motion[i, 1], motion[j, 2] - motion[i, 2]
                x, y, z = x + uy * gz - uz * gy, y + uz * gx - ux * gz, z + ux * gy - uy * gx
        curls[i, 0], curls[i, 1], curls[i, 2] = x, y, z


@njit(cache=True, parallel=True, error_model="numpy")
def confine(positions, starts, indices, densities, curls, pushes):
    """Direction N x omega of vorticity confinement (Macklin & Mueller 2013 eq. 16). Writes pushes [N, 3].

    N = grad |omega| / |grad |omega||, with an epsilon under the root relative to |omega| per smoothing length.
    """
    for i in prange(positions.shape[0]):
        own = math.sqrt(curls[i, 0] ** 2 + curls[i, 1] ** 2 + curls[i, 2] ** 2)
        x, y, z, largest = 0.0, 0.0, 0.0, own
        for k in range(starts[i], starts[i + 1]):
            j = indices[k]
            dx, dy, dz = positions[i, 0] - positions[j, 0], positions[i, 1] - positions[j, 1], positions[i, 2] - positions[j, 2]
            squared = max(dx * dx + dy * dy + dz * dz, _SMALLEST_SQUARE)
            if squared < 1.0:
                distance = math.sqrt(squared)
                other = math.sqrt(curls[j, 0] ** 2 + curls[j, 1] ** 2 + curls[j, 2] ** 2)
                over = -SPIKY_SLOPE * (1.0 - distance) * (1.0 - distance) / distance / densities[i] * (other - own)
                x, y, z, largest = x + over * dx, y + over * dy, z + over * dz, max(largest, other)
        length = math.sqrt(x * x + y * y + z * z + 1e-12 * largest * largest)
        over = 1.0 / length if length > 0.0 else 0.0
        pushes[i, 0] = over * (y * curls[i, 2] - z * curls[i, 1])
        pushes[i, 1] = over * (z * curls[i, 0] - x * curls[i, 2])
        pushes[i, 2] = over * (x * curls[i, 1] - y * curls[i, 0])
