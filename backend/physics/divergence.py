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


@njit(cache=True, parallel=True, error_model="numpy")
def _normal_equations(positions, velocities, starts, indices, sigma, normal, moment):
    """Writes normal [N, 3, 3] = A^T W A and moment [N, 3, 3] = A^T W B."""
    for i in prange(positions.shape[0]):
        normal[i, :, :] = 0.0
        moment[i, :, :] = 0.0
        for k in range(starts[i], starts[i + 1]):
            j = indices[k]
            squared = 0.0
            for axis in range(3):
                squared += (positions[j, axis] - positions[i, axis]) ** 2
            weight = math.exp(-squared / (2.0 * sigma * sigma))
            for row in range(3):
                offset = weight * (positions[j, row] - positions[i, row])
                for column in range(3):
                    normal[i, row, column] += offset * (positions[j, column] - positions[i, column])
                    moment[i, row, column] += offset * (velocities[j, column] - velocities[i, column])


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
