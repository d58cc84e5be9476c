"""The density of a frame from all that is known of it, weighed by the network of shares; fixed powers have their say in it."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from backend.field.rays import at_voxels
from backend.fit.levelled import Levels
from backend.fit.region import Region
from backend.prior.predict import Proposal, one_thread
from backend.prior.shares import Known, ShareNet, ask


@dataclass(frozen=True, slots=True, kw_only=True)
class Weighing:
    """Of a clip, in its upright world."""

    region: Region
    levels: Levels
    net: ShareNet

    def weighed(self, said: Proposal, sharp: np.ndarray, lasts: np.ndarray, frame: int) -> np.ndarray:
        """Density [X, Y, Z] 1/m on the proposal's voxels; along rays it has not the frame's sums yet. The rest: see `known`."""
        known = self.known(said, sharp, lasts, frame)
        with one_thread():
            return ask(self.net, known)

    def known(self, said: Proposal, sharp: np.ndarray, lasts: np.ndarray, frame: int) -> Known:
        """said: by the large network, for that frame. On its voxels [X, Y, Z] 1/m: sharp, what fixed powers make of it, and
        lasts, what does around the frame."""
        stand, finer = said.stand, self.levels.finer(said.stand)
        told = self.levels.told(stand, frame)
        depth, view = self.region.finer.of(frame)
        return Known(
            said=said.density,
            moved=self.levels.levelled(said, frame, share=1.0).density,
            lasts=lasts,
            sharp=sharp,
            depth=at_voxels(depth, stand.lattice, stand.seen(view)),
            middle=(finer * told.middle).astype(np.float32),
            width=(finer * told.width).astype(np.float32),
            unsure=(finer * told.unsure).astype(np.float32),
            asked=told.asked.astype(np.float32),
            astray=np.asarray(finer * self.levels.apart, np.float32),
        )
