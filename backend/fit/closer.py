"""A proposal on finer voxels, with the motion that the prior sees when it looks closer.

The prior's grid holds all of the smoke, and its voxels are as large as that takes. Asked about parts of the smoke with smaller
voxels, finer pictures and shorter strides it sees more of how the smoke moves across the view, and less of where in depth it is
and how it moves there, for which the whole counts.
"""

from __future__ import annotations

import math
from collections.abc import Callable

import numpy as np

from backend.prior.predict import Proposal
from backend.prior.window import SHAPE, Stand

TRUST = 0.5  # how much what is seen closer counts; both are a little wrong in ways of their own
_LEAST = 0.01  # of the fullest level: where smoke ends
_OUTER = 0.02  # of the smoke of a part, at each of its sides, that may be beyond
_OVERLAP = 4.0  # voxels of a proposal that parts overlap at least
_RIM = 4.0  # finer voxels over which a part begins to count


def closer(proposal: Proposal, stand: Stand, ask: Callable[[np.ndarray], Proposal]) -> Proposal:
    """On the voxels of `stand`, as finely as there. ask: the middle of a grid [3] m -> what the prior says of it, with voxels as
    those of `stand`."""
    points = stand.centres().reshape(-1, 3)
    own = proposal.stand
    density = own.at(proposal.density, points, outside="grid-constant")
    velocity = own.at(proposal.velocity, points, outside="nearest")
    seen, weight, most = np.zeros_like(velocity), np.zeros(len(points), np.float32), np.zeros(len(points), np.float32)
    for middle in _middles(proposal, share=stand.lattice.voxel_size / own.lattice.voxel_size):
        part = ask(middle)
        at = part.stand.voxels(points)
        inward = np.minimum(at + 0.5, np.array(SHAPE) - 0.5 - at)
        counts = np.clip(inward / _RIM, 0.0, 1.0).prod(axis=1).astype(np.float32)
        held = counts > 0.0
        seen[held] += counts[held, None] * part.stand.at(part.velocity, points[held], outside="nearest")
        weight += counts
        most = np.maximum(most, counts)
    change = seen / np.maximum(weight, 1e-6)[:, None] - velocity
    away = stand.from_world[1, :3].astype(np.float32)
    change -= (change @ away)[:, None] * away
    velocity += np.float32(TRUST) * most[:, None] * change
    shape = stand.lattice.shape
    return Proposal(stand=stand, density=density.reshape(shape), velocity=velocity.reshape(*shape, 3))


def _middles(proposal: Proposal, *, share: float) -> list[np.ndarray]:
    """[3] m each: of grids `share` as large as the proposal's, which together hold its smoke."""
    stand, density = proposal.stand, proposal.density.astype(np.float64)
    levels = density.sum(axis=(0, 1))
    lit = np.flatnonzero(levels > _LEAST * levels.max(initial=0.0))
    if not lit.size:
        return []
    wide, _, high = share * np.array(SHAPE)
    found = []
    for z in _cover(lit[0] - 0.5, lit[-1] + 0.5, high):
        low, top = max(0, round(z - high / 2)), round(z + high / 2) + 1
        part = density[:, :, low:top]
        y = 0.5 * sum(_ends(part.sum(axis=(0, 2))))
        found += [np.array([x, y, z]) for x in _cover(*_ends(part.sum(axis=(1, 2))), wide)]
    return list(stand.points(np.array(found).reshape(-1, 3)))


def _ends(amounts: np.ndarray) -> tuple[float, float]:
    """Voxels between which all but the outermost lies, of amounts [N]."""
    below = np.cumsum(amounts) / amounts.sum()
    first, last = np.interp((_OUTER, 1.0 - _OUTER), below, np.arange(len(amounts)) + 0.5)
    return float(first), float(last)


def _cover(first: float, last: float, length: float) -> np.ndarray:
    """The middles of as few pieces of a length as cover what is between, evenly."""
    if last - first <= length:
        return np.array([0.5 * (first + last)])
    count = math.ceil((last - first - _OVERLAP) / (length - _OVERLAP))
    return np.linspace(first + length / 2, last - length / 2, count)
