"""Losses of the published physical stage on particles, each with its gradient. Lengths count in units of the fluid's own.

Symbols: x positions [m], h smoothing length, d spacing = h / SPACINGS_PER_LENGTH, rho number density, rho_0 rest density.
The papers give weights but no units; with these the weights mean the same at every scale. Means are over particles.
"""

from __future__ import annotations

import numpy as np

from backend.physics.fluid import SPACINGS_PER_LENGTH, FluidParameters, FluidState, number_density
from backend.physics.fluid_gradient import number_density_gradient, rollout
from backend.physics.neighbours import find_neighbours

SPACING_WEIGHT, ANCHOR_WEIGHT, DENSITY_WEIGHT, AHEAD_WEIGHT = 0.1, 0.1, 1.0, 0.1  # FluidNexus (Gao et al. 2025)


def anchor_loss(positions: np.ndarray, predicted: np.ndarray, length: float) -> tuple[float, np.ndarray]:
    """mean |x - predicted|^2 / h^2; the gradient by `predicted` is that by x with the other sign."""
    num = max(len(positions), 1)
    apart = (positions - predicted) / length
    return float((apart * apart).sum()) / num, 2.0 * apart / (length * num)


def spacing_loss(positions: np.ndarray, length: float) -> tuple[float, np.ndarray]:
    """mean over i of sum over j of max(1 - |x_i - x_j| / d, 0)^2: particles keep their distance. Coincident ones: slope 0."""
    num, spacing = max(len(positions), 1), length / SPACINGS_PER_LENGTH
    lists = find_neighbours(np.ascontiguousarray(positions / spacing), 1.0)
    first = np.repeat(np.arange(len(positions)), np.diff(lists.starts))
    offsets = (positions[first] - positions[lists.indices]) / spacing
    distances = np.sqrt(np.einsum("pi,pi->p", offsets, offsets))
    near = np.maximum(1.0 - distances, 0.0)
    over = np.divide(-4.0 * near, distances, out=np.zeros_like(near), where=distances > 1e-12)[:, None] * offsets
    gradient = np.stack([np.bincount(first, over[:, axis], len(positions)) for axis in range(3)], axis=1)
    return float((near * near).sum()) / num, gradient / (num * spacing)


def density_loss(positions: np.ndarray, parameters: FluidParameters) -> tuple[float, np.ndarray]:
    """mean max(rho / rho_0 - 1, 0)^2, the constraint of Macklin & Mueller 2013 eq. 1; a gas may be thinner than at rest."""
    num, length = max(len(positions), 1), parameters.smoothing_length
    if len(positions) == 0:
        return 0.0, np.zeros((0, 3))
    excess = np.maximum(number_density(positions, length) / parameters.rest_density - 1.0, 0.0)
    bars = 2.0 * excess / (num * parameters.rest_density)
    return float((excess * excess).sum()) / num, number_density_gradient(positions, length, bars)


def ahead_loss(
    positions: np.ndarray,  # [N, 3] m
    before: FluidState,  # the same particles one step earlier
    parameters: FluidParameters,
    seconds: float,
) -> tuple[float, np.ndarray, np.ndarray]:  # loss, [N, 3] by the positions, [3] by the buoyancy
    """density_loss one step ahead: from x with the velocity (x - before) / dt, through the fluid's own step.

    Density does not change when all particles move alike, so the part by a uniform buoyancy is 0 but for drag at the
    surface and what limits a step.
    """
    velocities = (positions - before.positions) / seconds
    state = FluidState(positions=positions, velocities=velocities, masses=before.masses, ids=before.ids, born=before.born)
    moved = rollout(state, parameters, seconds)
    loss, slope = density_loss(moved.states[1].positions, parameters)
    found = moved.backward([None, slope])
    return loss, found.start.positions + found.start.velocities / seconds, found.buoyancy
