"""What the prior proposed for each frame, as volumes that can be scored: the answer of a method that treats frames apart."""

from __future__ import annotations

import numpy as np

from backend.fit.guide import Guide
from backend.fit.series import Series
from backend.fit.state import VolumeRecord
from backend.score.truth_set import Volume


class Proposals:
    """The records of the stage `volume`; the first is of video frame frame_start."""

    def __init__(self, records: Series[VolumeRecord], *, frame_start: int) -> None:
        self._records = records
        self._start = frame_start

    def volume(self, like: Volume, frame: int) -> tuple[np.ndarray, np.ndarray]:
        guide = Guide(self._records[frame - self._start])
        points = like.lattice.centres().reshape(-1, 3)
        shape = like.density.shape
        return guide.density_at(points).reshape(shape), guide.velocity_at(points).reshape(*shape, 3)
