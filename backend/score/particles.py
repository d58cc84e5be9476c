"""Particles as something that can be scored."""

from __future__ import annotations

import numpy as np

from backend.geometry.camera import View
from backend.geometry.lattice import Lattice
from backend.io.particles import Particles
from backend.render.picture import picture
from backend.render.voxelize import voxelize
from backend.score.truth_set import Volume


class ParticlePrediction:
    """An open particles.h5, fitted frames and forecast."""

    def __init__(self, particles: Particles) -> None:
        self._particles = particles
        self._start = particles.info.frame_start
        self.num_frames = self._start + particles.num_frames + particles.num_forecast

    def picture(self, view: View, frame: int) -> np.ndarray:
        return picture(self._particles.frame(frame - self._start), view)

    def volume(self, like: Volume, frame: int) -> tuple[np.ndarray, np.ndarray]:
        x, y, z = like.density.shape
        origin = (float(like.origin[0]), float(like.origin[1]), float(like.origin[2]))
        lattice = Lattice(origin=origin, voxel_size=like.voxel_size, shape=(x, y, z))
        grids = voxelize(self._particles.frame(frame - self._start), lattice)
        return grids["density"], grids["velocity"]
