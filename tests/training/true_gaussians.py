"""Particles that a perfect fit would have, for tests of those who judge."""

from __future__ import annotations

import numpy as np

from backend.fit.state import VisualRecord
from training.library import VELOCITY_EVERY, VOXEL_SIZE, Plume
from training.samples import lattice_of


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
