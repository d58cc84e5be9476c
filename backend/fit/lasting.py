"""Where smoke lasts: the one density that explains the images of many frames around a moment, as well as one can.

What is proposed for a frame is unsure in depth; what other frames show from elsewhere is not known of smoke that has moved
on since. But plumes stay roughly where they are: from all sides of the camera's way their mean is seen as a still thing is
in tomography, and where the mean is thin a frame's own smoke seldom lies.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np

from backend.field.rays import at_voxels
from backend.fit.region import Region
from backend.fit.sharpen import ratio_to
from backend.geometry.camera import View
from backend.geometry.lattice import Lattice
from backend.prior.predict import Proposal
from backend.prior.window import SHAPE, Stand

_UPDATES = 6
_AS_IT_IS = 1e-3  # weight of a sighting that would leave each voxel as it stands
_REACH = 15  # strides to either side that count
_APART = 5  # strides between the moments at which it is found
_WIDE = 28  # voxels of proposals that its grid is wide along x and y: all that the cameras' grids cover but their corners


@dataclass(frozen=True, slots=True, kw_only=True)
class Sighting:
    """A frame's optical depth [h, w], its view, and how much it counts."""

    depth: np.ndarray
    view: View
    weight: float


def lasting(density: np.ndarray, lattice: Lattice, sightings: Sequence[Sighting]) -> np.ndarray:
    """Density [X, Y, Z] 1/m, from a first guess that is nowhere zero where smoke may be.

    Maximum likelihood by expectation maximisation (Shepp and Vardi 1982), of images whose smoke is counted; voxels that no
    image shows stay as they are.
    """
    shown = [sighting.weight * at_voxels(np.ones_like(sighting.depth), lattice, sighting.view) for sighting in sightings]
    share = np.sum(shown, axis=0) + _AS_IT_IS
    for _ in range(_UPDATES):
        total = np.full_like(share, _AS_IT_IS)
        for sighting in sightings:
            ratio = ratio_to(sighting.depth, density, lattice, sighting.view)
            total += np.float32(sighting.weight) * at_voxels(ratio, lattice, sighting.view)
        density = density * (total / share)
    return density


class Lasting:
    """What lasts around each frame of a clip: found at some moments from the proposals for frames around, linear between."""

    def __init__(self, region: Region, proposal_at: Callable[[int], Proposal], asked: Sequence[int], *, stride: int) -> None:
        """proposal_at: index in `asked`, the frames of proposals -> proposal, as often as wanted. stride: frames."""
        self.region, self.proposal_at, self.asked, self.stride = region, proposal_at, asked, stride
        apart = max(1, round(stride * len(asked) / region.num_frames))
        self.looked = range(0, len(asked), apart)  # which of those asked
        self.moments = sorted({*(asked[index] for index in self.looked[::_APART]), asked[-1]})
        shape = region.finely((_WIDE, _WIDE, SHAPE[2]))
        origin = region.centre - 0.5 * region.finer_size * (np.array(shape) - 1)
        self.lattice = Lattice(origin=tuple(origin), voxel_size=region.finer_size, shape=shape)
        self.stand = Stand(lattice=self.lattice, from_world=np.eye(4))
        self.found: dict[int, np.ndarray] = {}

    def at(self, stand: Stand, frame: int) -> np.ndarray:
        """[X, Y, Z] 1/m on the voxels of a stand."""
        later = next(moment for moment in self.moments if moment >= frame)
        earlier = max((moment for moment in self.moments if moment <= frame), default=later)
        share = (frame - earlier) / max(later - earlier, 1)
        self.found = {moment: self.found[moment] if moment in self.found else self._around(moment) for moment in {earlier, later}}
        values = (1.0 - share) * self.found[earlier] + share * self.found[later]
        return self.stand.at(values, stand.centres().reshape(-1, 3), outside="nearest").reshape(stand.lattice.shape)

    def _around(self, moment: int) -> np.ndarray:
        points = self.stand.centres().reshape(-1, 3)
        guess, sightings = np.zeros(len(points), np.float32), []
        for index in self.looked:
            frame = self.asked[index]
            weight = 1.0 - abs(frame - moment) / (_REACH * self.stride)
            if weight <= 0.0:
                continue
            proposal = self.proposal_at(index)
            guess += np.float32(weight) * proposal.stand.at(proposal.density, points, outside="grid-constant")
            depth, view = self.region.finer.of(frame)
            sightings.append(Sighting(depth=depth, view=view, weight=weight))
        total = sum(sighting.weight for sighting in sightings)
        floor = 1e-6 * float(guess.max(initial=0.0))
        return lasting((guess / np.float32(total) + np.float32(floor)).reshape(self.lattice.shape), self.lattice, sightings)
