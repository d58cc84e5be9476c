"""A proposed volume as a guide for particles: how dense the smoke is at a point, how it moves there, where on a ray it lies,
and how much of it the particles still lack."""

from __future__ import annotations

import numpy as np
from scipy import ndimage

from backend.fit.state import VolumeRecord
from backend.geometry.camera import View
from backend.geometry.lattice import Lattice

_SAMPLES = 64  # along a ray
_BLUR = 0.8  # voxels: what one particle is spread over before it is compared with the volume
_FLOOR = 0.02  # of the volume's largest density, added to both sides of a ratio


class Guide:
    """The volume of one frame. Points are [N, 3] m in the world."""

    def __init__(self, record: VolumeRecord) -> None:
        self.record = record
        size = float(record.voxel_size)
        shape = record.density.shape
        origin = tuple(-0.5 * size * (count - 1) for count in shape)
        self.lattice = Lattice(origin=origin, voxel_size=size, shape=shape)  # type: ignore[arg-type]
        self.density = record.density.astype(np.float32)

    def density_at(self, points: np.ndarray) -> np.ndarray:
        """[N] 1/m; zero outside the grid."""
        return _looked_up(self.density, self.places(points), "constant")

    def velocity_at(self, points: np.ndarray) -> np.ndarray:
        """[N, 3] m/s; outside the grid that of its nearest voxel."""
        at = self.places(points)
        return np.stack([_looked_up(self.record.velocity[..., axis], at, "nearest") for axis in range(3)], axis=1)

    def places(self, points: np.ndarray) -> np.ndarray:
        """[3, N] voxels from the first one's centre."""
        matrix = self.record.from_world
        local = points @ matrix[:3, :3].T + matrix[:3, 3]
        return ((local - np.asarray(self.lattice.origin)) / self.lattice.voxel_size).T

    def points_on_rays(self, pixels: np.ndarray, view: View, *, seed: int) -> tuple[np.ndarray, np.ndarray]:
        """A random point [N, 3] of the smoke on the ray of each pixel [N, 2], and whether there is any on that ray [N]."""
        draw = np.random.default_rng(seed)
        middle = view.to_camera(-(self.record.from_world[:3, :3].T @ self.record.from_world[:3, 3])[None])[0, 2]
        reach = 0.5 * self.lattice.voxel_size * float(np.linalg.norm(self.lattice.shape))
        near, far = max(middle - reach, 1e-3 * reach), max(middle + reach, 2e-3 * reach)
        depths = near + (far - near) * (np.arange(_SAMPLES) + 0.5) / _SAMPLES
        count = len(pixels)
        points = view.unproject(np.repeat(pixels, _SAMPLES, axis=0), np.tile(depths, count))
        share = self.density_at(points).reshape(count, _SAMPLES).astype(np.float64)
        reached = np.cumsum(share, axis=1)
        has_smoke = reached[:, -1] > 0.0
        wanted = draw.random(count) * reached[:, -1]
        index = np.minimum((reached <= wanted[:, None]).sum(axis=1), _SAMPLES - 1)
        depth = depths[index] + (draw.random(count) - 0.5) * (far - near) / _SAMPLES
        return view.unproject(pixels, depth), has_smoke

    def carried(self, positions: np.ndarray, next_guide: Guide, *, seconds: float) -> np.ndarray:
        """Positions [N, 3] m one frame later: Heun's rule between the velocities of both frames."""
        first = self.velocity_at(positions)
        return positions + 0.5 * seconds * (first + next_guide.velocity_at(positions + seconds * first))

    def lack(self, positions: np.ndarray, masses: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """How many times the mass of each particle [N] the volume asks for, and the density [X, Y, Z] 1/m that is missing."""
        size = self.lattice.voxel_size
        carried = _blurred(deposited(self.places(positions), masses, self.lattice.shape) / size**3)
        wanted = _blurred(self.density)
        floor = _FLOOR * max(float(wanted.max(initial=0.0)), 1e-12)
        ratio = (wanted + floor) / (carried + floor)
        return _looked_up(ratio, self.places(positions), "nearest"), np.maximum(wanted - carried, 0.0)


def deposited(places: np.ndarray, masses: np.ndarray, shape: tuple[int, ...]) -> np.ndarray:
    """Masses [N] shared among the eight voxels around their places [3, N] -> [X, Y, Z] float64; what is outside is lost."""
    low = np.floor(places).astype(np.int64)
    share = places - low
    total = np.zeros(int(np.prod(shape)))
    for corner in np.ndindex(2, 2, 2):
        index = low + np.array(corner)[:, None]
        weight = np.prod(np.where(np.array(corner)[:, None] == 1, share, 1 - share), axis=0) * masses
        inside = ((index >= 0) & (index < np.array(shape)[:, None])).all(axis=0)
        flat = np.ravel_multi_index(tuple(index[:, inside]), shape)
        total += np.bincount(flat, weight[inside], minlength=total.size)
    return total.reshape(shape)


def _blurred(values: np.ndarray) -> np.ndarray:
    return ndimage.gaussian_filter(np.asarray(values, np.float32), _BLUR, mode="constant")


def _looked_up(values: np.ndarray, places: np.ndarray, mode: str) -> np.ndarray:
    return ndimage.map_coordinates(values, places, order=1, mode=mode)
