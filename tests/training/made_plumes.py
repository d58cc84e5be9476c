"""A plume made by hand, and the particles that a perfect fit of one would have: for tests of those who judge."""

from __future__ import annotations

import numpy as np

from backend.fit.state import VisualRecord
from training.library import NUM_FRAMES, VELOCITY_EVERY, VOXEL_SIZE, Plume
from training.plumes import SIZE, plume
from training.samples import lattice_of


def grid() -> list[np.ndarray]:
    """Of a made plume the numbers of each voxel, [X, Y, Z] three times."""
    return np.meshgrid(*(np.arange(round(size / VOXEL_SIZE)) for size in SIZE), indexing="ij")


def made_plume(density: np.ndarray, velocity: np.ndarray | None = None) -> Plume:
    """density [X, Y, Z] or [F, X, Y, Z], up to 255; velocity [X, Y, Z, 3] m/s at all times, none: it stands still."""
    shape = density.shape[-3:]
    motion = np.zeros((*shape, 3)) if velocity is None else velocity
    return Plume(
        scene=plume(3),
        density=np.broadcast_to(density.astype(np.uint8), (NUM_FRAMES, *shape)),
        velocity=np.broadcast_to(motion.astype(np.float16), (NUM_FRAMES // VELOCITY_EVERY + 1, *motion.shape)),
        origin=(-5.83, -5.83, 0.17),
    )


def ball() -> np.ndarray:
    """[X, Y, Z], the density of a ball of smoke."""
    x, y, z = grid()
    return 120 * np.exp(-((x - 18) ** 2 + (y - 20) ** 2 + (z - 25) ** 2) / 12)


def true_gaussians(of: Plume, *, shift: float) -> list[VisualRecord]:
    """One in each voxel of the true smoke, moved by some metres along x."""
    found, lattice = [], lattice_of(of)
    for frame in range(0, 120, 2 * VELOCITY_EVERY):
        density, velocity = of.density_at(frame), of.velocity_at(frame)
        is_smoke = density > 0.02
        count = int(is_smoke.sum())
        record = VisualRecord(
            positions=lattice.centres()[is_smoke] + np.array([shift, 0.0, 0.0]),
            velocities=velocity[is_smoke],
            scales=np.full(count, 0.6 * VOXEL_SIZE, np.float32),
            optical_masses=(density[is_smoke] * VOXEL_SIZE**3).astype(np.float32),
            colors=np.full((count, 3), 0.4, np.float32),
            ids=np.arange(count),
            born=np.zeros(count, np.int32),
            next_id=np.asarray(count),
        )
        found += [record] * (2 * VELOCITY_EVERY)
    return found
