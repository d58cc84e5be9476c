"""A proposal for a frame from those of two frames around it, each carried along its own velocity to the moment between."""

from __future__ import annotations

import numpy as np
from scipy import ndimage

from backend.prior.predict import Proposal
from backend.prior.window import Stand


def between(before: Proposal, after: Proposal, stand: Stand, *, share: float, seconds: float) -> Proposal:
    """The mean of both on the voxels of `stand`, at `share` (0 to 1) of the `seconds` from the one to the other.

    Semi-Lagrangian (Stam 1999), one step each, with the velocity where the voxel is.
    """
    points = stand.lattice.centres().reshape(-1, 3) - stand.from_world[:3, 3]
    points = points @ stand.from_world[:3, :3]
    density, velocity = np.zeros(len(points), np.float32), np.zeros((len(points), 3), np.float32)
    for proposal, weight, ahead in ((before, 1.0 - share, share * seconds), (after, share, (share - 1.0) * seconds)):
        at = proposal.stand.voxels(points)
        speed = _looked_up(proposal.velocity, at, "nearest")
        origin = proposal.stand.voxels(points - ahead * speed)
        density += np.float32(weight) * _looked_up(proposal.density[..., None], origin, "constant")[:, 0]
        velocity += np.float32(weight) * _looked_up(proposal.velocity, origin, "nearest")
    shape = stand.lattice.shape
    return Proposal(stand=stand, density=density.reshape(shape), velocity=velocity.reshape(*shape, 3))


def _looked_up(values: np.ndarray, places: np.ndarray, mode: str) -> np.ndarray:
    """[X, Y, Z, C] at places [N, 3] voxels -> [N, C]."""
    channels = [ndimage.map_coordinates(values[..., index], places.T, order=1, mode=mode) for index in range(values.shape[-1])]
    return np.stack(channels, axis=1)
