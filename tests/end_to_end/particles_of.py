"""Particles for tests: as many as there are positions, small, at rest, all of one mass."""

from __future__ import annotations

import numpy as np

from backend.io.particles import ParticleFrame


def particles(positions: np.ndarray, colors: np.ndarray) -> ParticleFrame:
    """At positions [N, 3] m, of colours [N, 3] or [3]."""
    count = len(positions)
    return ParticleFrame(
        positions=positions,
        velocities=np.zeros((count, 3), np.float32),
        scales=np.full(count, 0.1, np.float32),
        optical_masses=np.full(count, 0.01, np.float32),
        colors=np.broadcast_to(colors, (count, 3)).astype(np.float32),
        ids=np.arange(count),
    )
