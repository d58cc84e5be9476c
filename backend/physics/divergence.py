"""How far from incompressible a set of moving particles is: local least-squares divergence, supplement eq. 7 and 8.

Symbols: rows of A the offsets x_j - x_i [m], rows of B the differences v_j - v_i [m/s], W = diag(exp(-|x_j - x_i|^2 /
(2 sigma^2))), j within r of i. X = (A^T W A + lambda I)^-1 A^T W B is the transposed Jacobian; its trace the divergence.

As published lambda is a number of m^2 and every particle counts, so that a sparse set, whose A^T W A is small against
lambda, looks incompressible. Corrected: lambda is a share of trace(A^T W A) / 3, a particle with fewer than eight
neighbours has no value, and the share of particles that have one is reported.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numba import njit, prange

from .neighbours import find_neighbours

MIN_NEIGHBOURS = 8
PUBLISHED_REGULARISATION = 1e-4  # m^2; the supplement gives no value
RELATIVE_REGULARISATION = 1e-6  # of trace(A^T W A) / 3
_SIGMA_SHARE = 0.5  # sigma over r; the supplement only says that they are tied


@dataclass(frozen=True, slots=True, kw_only=True)
class Divergence:
    """values: [N] 1/s, NaN where there are too few neighbours. mean_absolute: 1/s, over the others; NaN without any.

    coverage: share of the particles that have a value.
    """

    values: np.ndarray
    mean_absolute: float
    coverage: float


@njit(cache=True, fastmath={"contract"}, inline="always")
def _exp(x):
    """exp of -2..0 to 1e-15: eleven terms of its series at an eighth of x, then squared three times. math.exp costs more than
    all else in the loop."""
    t = 0.125 * x
    p = 1.0 + t * (1.0 / 11.0)
    p = 1.0 + t * (1.0 / 10.0) * p
    p = 1.0 + t * (1.0 / 9.0) * p
    p = 1.0 + t * (1.0 / 8.0) * p
    p = 1.0 + t * (1.0 / 7.0) * p
    p = 1.0 + t * (1.0 / 6.0) * p
    p = 1.0 + t * (1.0 / 5.0) * p
    p = 1.0 + t * (1.0 / 4.0) * p
    p = 1.0 + t * (1.0 / 3.0) * p
    p = 1.0 + t * (1.0 / 2.0) * p
    p = 1.0 + t * p
    p *= p
    p *= p
    return p * p


@njit(cache=True, parallel=True, error_model="numpy", fastmath={"reassoc", "contract", "nsz"})
def _normal_equations(positions, velocities, starts, indices, sigma, normal, moment):
    """Writes normal [N, 3, 3] = A^T W A and moment [N, 3, 3] = A^T W B."""
    scale = -1.0 / (2.0 * sigma * sigma)
    for i in prange(positions.shape[0]):
        # Sums in variables of their own stay in registers; in arrays they do not.
        xx = xy = xz = yy = yz = zz = 0.0
        xu = xv = xw = yu = yv = yw = zu = zv = zw = 0.0
        for k in range(starts[i], starts[i + 1]):
            j = indices[k]
            x = positions[j, 0] - positions[i, 0]
            y = positions[j, 1] - positions[i, 1]
            z = positions[j, 2] - positions[i, 2]
            u = velocities[j, 0] - velocities[i, 0]
            v = velocities[j, 1] - velocities[i, 1]
            w = velocities[j, 2] - velocities[i, 2]
            weight = _exp(scale * (x * x + y * y + z * z))
            wx, wy, wz = weight * x, weight * y, weight * z
            xx, xy, xz, yy, yz, zz = xx + wx * x, xy + wx * y, xz + wx * z, yy + wy * y, yz + wy * z, zz + wz * z
            xu, xv, xw = xu + wx * u, xv + wx * v, xw + wx * w
            yu, yv, yw = yu + wy * u, yv + wy * v, yw + wy * w
            zu, zv, zw = zu + wz * u, zv + wz * v, zw + wz * w
        normal[i, 0, 0], normal[i, 0, 1], normal[i, 0, 2] = xx, xy, xz
        normal[i, 1, 0], normal[i, 1, 1], normal[i, 1, 2] = xy, yy, yz
        normal[i, 2, 0], normal[i, 2, 1], normal[i, 2, 2] = xz, yz, zz
        moment[i, 0, 0], moment[i, 0, 1], moment[i, 0, 2] = xu, xv, xw
        moment[i, 1, 0], moment[i, 1, 1], moment[i, 1, 2] = yu, yv, yw
        moment[i, 2, 0], moment[i, 2, 1], moment[i, 2, 2] = zu, zv, zw


def _fit(positions: np.ndarray, velocities: np.ndarray, radius: float) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Normal matrices [N, 3, 3], moments [N, 3, 3] and numbers of neighbours [N]. Lengths in units of the radius."""
    positions, velocities = np.asarray(positions, np.float64), np.asarray(velocities, np.float64)
    if positions.ndim != 2 or positions.shape[1] != 3 or positions.shape != velocities.shape:
        raise ValueError(f"positions {positions.shape} and velocities {velocities.shape} are not both [N, 3]")
    if not (np.isfinite(positions).all() and np.isfinite(velocities).all() and math.isfinite(radius) and radius > 0.0):
        raise ValueError("positions, velocities or radius hold NaN or infinity")
    scaled = np.ascontiguousarray(positions / radius)
    lists = find_neighbours(scaled, 1.0)
    normal, moment = np.empty((len(scaled), 3, 3)), np.empty((len(scaled), 3, 3))
    velocities = np.ascontiguousarray(velocities)
    _normal_equations(scaled, velocities, lists.starts, lists.indices, _SIGMA_SHARE, normal, moment)
    return normal, moment, np.diff(lists.starts)


def divergence_as_published(
    positions: np.ndarray,  # [N, 3] m
    velocities: np.ndarray,  # [N, 3] m/s
    radius: float,  # m
    *,
    regularisation: float = PUBLISHED_REGULARISATION,  # m^2
) -> Divergence:
    """Eq. 7 and 8 as printed: one absolute lambda, all particles count, isolated ones with 0."""
    return _as_published(_fit(positions, velocities, radius), radius, regularisation)


def divergence(
    positions: np.ndarray,  # [N, 3] m
    velocities: np.ndarray,  # [N, 3] m/s
    radius: float,  # m
    *,
    regularisation: float = RELATIVE_REGULARISATION,  # share of trace(A^T W A) / 3
) -> Divergence:
    """Eq. 7 and 8 with a relative lambda, over particles with at least MIN_NEIGHBOURS neighbours."""
    return _corrected(_fit(positions, velocities, radius), radius, regularisation)


def both_divergences(
    positions: np.ndarray,  # [N, 3] m
    velocities: np.ndarray,  # [N, 3] m/s
    radius: float,  # m
) -> tuple[Divergence, Divergence]:
    """As published and corrected, for little more than the cost of one: the sums over neighbours are the same."""
    fit = _fit(positions, velocities, radius)
    return _as_published(fit, radius, PUBLISHED_REGULARISATION), _corrected(fit, radius, RELATIVE_REGULARISATION)


Fit = tuple[np.ndarray, np.ndarray, np.ndarray]  # what _fit returns


def _as_published(fit: Fit, radius: float, regularisation: float) -> Divergence:
    if not regularisation > 0.0:
        raise ValueError(f"regularisation = {regularisation!r} is not positive")
    normal, moment, _ = fit
    jacobians = np.linalg.solve(normal + regularisation / radius**2 * np.eye(3), moment / radius)
    return _summary(np.trace(jacobians, axis1=1, axis2=2), np.ones(len(normal), bool))


def _corrected(fit: Fit, radius: float, regularisation: float) -> Divergence:
    if not regularisation > 0.0:
        raise ValueError(f"regularisation = {regularisation!r} is not positive")
    normal, moment, num_neighbours = fit
    scale = np.trace(normal, axis1=1, axis2=2) / 3.0
    is_covered = (num_neighbours >= MIN_NEIGHBOURS) & (scale > 0.0)
    ridge = np.where(is_covered, regularisation * scale, 1.0)[:, None, None] * np.eye(3)
    jacobians = np.linalg.solve(normal + ridge, moment / radius)
    return _summary(np.trace(jacobians, axis1=1, axis2=2), is_covered)


def _summary(values: np.ndarray, is_covered: np.ndarray) -> Divergence:
    num = int(is_covered.sum())
    return Divergence(
        values=np.where(is_covered, values, np.nan),
        mean_absolute=float(np.abs(values[is_covered]).mean()) if num else math.nan,
        coverage=num / len(values) if len(values) else 0.0,
    )
