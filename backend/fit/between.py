"""A proposal for a frame from those of two frames around it, each carried along its own velocity to the moment between."""

from __future__ import annotations

import numpy as np

from backend.prior.predict import Proposal
from backend.prior.window import Stand


def between(before: Proposal, after: Proposal, stand: Stand, *, share: float, seconds: float) -> Proposal:
    """The mean of both on the voxels of `stand`, at `share` (0 to 1) of the `seconds` from the one to the other.

    Semi-Lagrangian (Stam 1999), one step each, with the velocity where the voxel is.
    """
    points = stand.centres().reshape(-1, 3)
    density, velocity = np.zeros(len(points), np.float32), np.zeros((len(points), 3), np.float32)
    for proposal, weight, ahead in ((before, 1.0 - share, share * seconds), (after, share, (share - 1.0) * seconds)):
        own = proposal.stand
        origins = points - ahead * own.at(proposal.velocity, points, outside="nearest")
        density += np.float32(weight) * own.at(proposal.density, origins, outside="grid-constant")
        velocity += np.float32(weight) * own.at(proposal.velocity, origins, outside="nearest")
    shape = stand.lattice.shape
    return Proposal(stand=stand, density=density.reshape(shape), velocity=velocity.reshape(*shape, 3))
