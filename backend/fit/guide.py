"""A proposed volume as a guide for particles: how dense the smoke is at a point, how it moves there, where on a ray it lies."""

from __future__ import annotations

import cv2
import numpy as np

from backend.fit.depth_prior import MAX_SIDE, DepthPrior
from backend.fit.state import VolumeRecord
from backend.geometry.camera import View
from backend.geometry.lattice import Lattice
from backend.prior.window import Stand

_SAMPLES = 48  # along a ray
_HALF_OVER_SPREAD = 6.0**0.5  # of the profile (1 - s^2)^1.5 on -1..1
_BESIDE = 9  # pixels around smoke whose rays are asked too
_FAINT = 0.02  # of the largest sum along a ray: rays with less pass no smoke


class Guide:
    """The volume of one frame. Points are [N, 3] m in the world."""

    def __init__(self, record: VolumeRecord) -> None:
        self.record = record
        size = float(record.voxel_size)
        shape = record.density.shape
        origin = tuple(-0.5 * size * (count - 1) for count in shape)
        self.lattice = Lattice(origin=origin, voxel_size=size, shape=shape)  # type: ignore[arg-type]
        self.stand = Stand(lattice=self.lattice, from_world=record.from_world)
        self.density = record.density.astype(np.float32) * np.float32(record.density_unit)
        self.velocity = record.velocity.astype(np.float32) * np.float32(record.velocity_unit)

    def density_at(self, points: np.ndarray) -> np.ndarray:
        """[N] 1/m; zero outside the grid."""
        return self.stand.at(self.density, points, outside="grid-constant")

    def velocity_at(self, points: np.ndarray) -> np.ndarray:
        """[N, 3] m/s; outside the grid that of its nearest voxel."""
        return self.stand.at(self.velocity, points, outside="nearest")

    def prior_of(self, view: View, solid: DepthPrior) -> DepthPrior:
        """Where on each ray the volume's smoke is: the middle and, from its spread, the half thickness of the profile that
        `solid` stands for; on rays that pass no smoke of the volume those of `solid`."""
        height, width = solid.center_depth.shape
        scale = min(1.0, MAX_SIDE / max(height, width))
        size = max(1, round(width * scale)), max(1, round(height * scale))
        depths = self.depths(view)
        near = cv2.dilate(solid.is_smoke.astype(np.uint8), np.ones((_BESIDE, _BESIDE), np.uint8))
        rows, columns = np.nonzero(cv2.resize(near, size, interpolation=cv2.INTER_AREA))
        pixels = np.stack([(columns + 0.5) / size[0] * width, (rows + 0.5) / size[1] * height], axis=1)
        points = view.unproject(np.repeat(pixels, _SAMPLES, axis=0), np.tile(depths, len(pixels)))
        density = self.density_at(points).reshape(len(pixels), _SAMPLES).astype(np.float64)
        moments = []
        for power in range(3):
            moment = np.zeros(size[::-1])
            moment[rows, columns] = (density * depths**power).sum(axis=1)
            moments.append(cv2.GaussianBlur(moment, (0, 0), 1.0))
        is_known = moments[0] > _FAINT * max(float(moments[0].max(initial=0.0)), 1e-12)
        total = np.where(is_known, moments[0], 1.0)
        middle = np.where(is_known, moments[1] / total, 0.0)
        spread = np.sqrt(np.maximum(np.where(is_known, moments[2] / total, 0.0) - middle**2, 0.0))
        known = cv2.resize(is_known.astype(np.float32), (width, height), interpolation=cv2.INTER_LINEAR)
        share = np.maximum(known, 1e-6)
        center = cv2.resize(middle, (width, height), interpolation=cv2.INTER_LINEAR) / share
        half = cv2.resize(_HALF_OVER_SPREAD * spread, (width, height), interpolation=cv2.INTER_LINEAR) / share
        return DepthPrior(
            half_thickness=np.where(known > 0.5, half, solid.half_thickness),
            center_depth=np.where(known > 0.5, center, solid.center_depth),
            is_smoke=solid.is_smoke,
        )

    def depths(self, view: View) -> np.ndarray:
        """[_SAMPLES] m along the optical axis, through the whole grid."""
        middle = view.to_camera(-(self.record.from_world[:3, :3].T @ self.record.from_world[:3, 3])[None])[0, 2]
        reach = 0.5 * self.lattice.voxel_size * float(np.linalg.norm(self.lattice.shape[:2]))
        near, far = max(middle - reach, 1e-3 * reach), max(middle + reach, 2e-3 * reach)
        return near + (far - near) * (np.arange(_SAMPLES) + 0.5) / _SAMPLES

    def carried(self, positions: np.ndarray, next_guide: Guide, *, seconds: float) -> np.ndarray:
        """Positions [N, 3] m one frame later: Heun's rule between the velocities of both frames."""
        first = self.velocity_at(positions)
        return positions + 0.5 * seconds * (first + next_guide.velocity_at(positions + seconds * first))
