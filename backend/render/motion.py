"""The velocity field of Gaussians: not blurred by their width, and known beyond them.

`voxelize` gives each voxel the mean velocity of the Gaussians there, by mass. They are as wide as their distances, and so that
mean is smoother than what their velocities say of the places that they are at. `unblurred` gives them velocities whose mean at
those places is theirs (van Cittert 1931); `beyond` continues the field to where hardly any smoke is.
"""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np

from backend.field.lookup import trilinear
from backend.geometry.lattice import Lattice
from backend.io.particles import ParticleFrame
from backend.render.voxelize import CUTOFF, voxelize

_ROUNDS = 2
_COARSER = 1.5  # than half of the Gaussians are narrow: voxels in which means are found
_MOST_VOXELS = 4_000_000  # of these: smoke that is spread out wider stays as it is
_THIN = 1e-3  # of the largest density: with so much, half of a voxel's velocity is its own


def smoke_and_motion(frame: ParticleFrame, lattice: Lattice) -> tuple[np.ndarray, np.ndarray]:
    """Density [X, Y, Z] 1/m, and velocity [X, Y, Z, 3] m/s at every voxel."""
    grids = voxelize(unblurred(frame), lattice)
    return grids["density"], beyond(grids["density"], grids["velocity"])


def unblurred(frame: ParticleFrame) -> ParticleFrame:
    """The frame with velocities for `voxelize`; nothing else should read them."""
    lattice = _lattice_of(frame)
    if lattice is None:
        return frame
    wanted = np.asarray(frame.velocities, np.float64)
    places = (np.asarray(frame.positions, np.float64) - np.array(lattice.origin)) / lattice.voxel_size
    given = wanted
    for _ in range(_ROUNDS):
        shown = voxelize(replace(frame, velocities=given.astype(np.float32)), lattice)["velocity"]
        given = given + wanted - trilinear(shown, places, outside="nearest")
    return replace(frame, velocities=given.astype(np.float32))


def _lattice_of(frame: ParticleFrame) -> Lattice | None:
    """Voxels a little larger than half of the Gaussians are narrow, around all of them; None where that is none, or too many."""
    if not frame.count:
        return None
    size = _COARSER * float(np.median(np.asarray(frame.scales, np.float64).reshape(frame.count, -1).min(axis=1)))
    low, high = (np.asarray(bound(frame.positions, axis=0), np.float64) for bound in (np.min, np.max))
    sides = (high - low) / size + 2.0 * CUTOFF if size > 0.0 else np.full(3, np.inf)
    if not sides.prod() <= _MOST_VOXELS:
        return None
    x, y, z = (math.ceil(side) + 1 for side in sides)
    first = low - CUTOFF * size
    return Lattice(origin=(float(first[0]), float(first[1]), float(first[2])), voxel_size=size, shape=(x, y, z))


def beyond(density: np.ndarray, velocity: np.ndarray) -> np.ndarray:
    """Velocity [X, Y, Z, 3] m/s, where density [X, Y, Z] is next to nothing that of the smoke around it; zero without any.

    Means over ever larger blocks fill what smaller ones do not know (a pyramid; Gortler et al. 1996).
    """
    return _filled(density.astype(np.float32), velocity.astype(np.float32), _THIN * float(density.max(initial=0.0)))


def _filled(weight: np.ndarray, values: np.ndarray, least: float) -> np.ndarray:
    """values [X, Y, Z, C] of weights [X, Y, Z]; those of less than `least` mostly from larger blocks."""
    if not least > 0.0 or max(weight.shape) == 1:  # no smoke at all; one block of all voxels
        return values
    sums, weights = _in_blocks(weight[..., None] * values), _in_blocks(weight)
    means = sums / np.maximum(weights, np.float32(1e-30))[..., None]
    larger = _filled(weights, means, least)
    places = (np.moveaxis(np.indices(weight.shape), 0, -1).reshape(-1, 3) + 0.5) / 2 - 0.5
    around = trilinear(larger, places, outside="nearest").reshape(values.shape)
    own = (weight / (weight + np.float32(least)))[..., None]
    return own * values + (1 - own) * around


def _in_blocks(values: np.ndarray) -> np.ndarray:
    """Sums over blocks of 2 x 2 x 2 voxels, of which the last may be smaller."""
    padded = np.pad(values, [(0, size % 2) for size in values.shape[:3]] + [(0, 0)] * (values.ndim - 3))
    x, y, z = (size // 2 for size in padded.shape[:3])
    return padded.reshape(x, 2, y, 2, z, 2, *values.shape[3:]).sum(axis=(1, 3, 5))
