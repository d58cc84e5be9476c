"""Gaussians that stand alone, drawn out along the ray that they were seen on.

Where on its ray the faint smoke of a silhouette is, one view does not tell: single Gaussians end up far from all others, and
from elsewhere they are seen as beads. Drawn out along the ray they are the haze that is known of them, and the view that
they were fitted to shows them as before.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from scipy import ndimage

from backend.geometry.camera import View
from backend.geometry.lattice import Lattice
from backend.io.particles import ParticleFrame
from backend.render.voxelize import MIN_SCALE_VOXELS, voxelize

_ALONE = 0.4  # own share of the density at its place, from which on a Gaussian is drawn out
_LONGEST = 5.0  # times its width, where all of the density is its own
_MOST_VOXELS = 128  # a side
_MARGIN = 4.0  # voxels around the outermost


def drawn_out(frame: ParticleFrame, view: View) -> ParticleFrame:
    """A frame with rotations. Those that have some, as the published methods make them, stay as they are."""
    if frame.rotations is not None:
        return frame
    alone = np.clip((own_shares(frame) - _ALONE) / (1.0 - _ALONE), 0.0, 1.0)
    stretches = np.ones((frame.count, 3), np.float32)
    stretches[:, 0] += (_LONGEST - 1.0) * alone
    return replace(frame, scales=stretches * frame.scales[:, None], rotations=_from_first_axis(frame.positions - view.position))


def own_shares(frame: ParticleFrame) -> np.ndarray:
    """[N], 0..1: of the density at each Gaussian's place how much is its own; 0 of those without mass or width."""
    if not frame.count or not frame.scales.max() > 0.0:
        return np.zeros(frame.count)
    low, high = frame.positions.min(axis=0), frame.positions.max(axis=0)
    size = max(float(np.median(frame.scales)), float((high - low).max()) / _MOST_VOXELS, 1e-3 * float(frame.scales.max()))
    low, high = low - _MARGIN * size, high + _MARGIN * size
    x, y, z = (int(count) for count in np.ceil((high - low) / size) + 1)
    lattice = Lattice(origin=(float(low[0]), float(low[1]), float(low[2])), voxel_size=size, shape=(x, y, z))
    places = ((frame.positions - low) / size).T
    density = ndimage.map_coordinates(voxelize(frame, lattice)["density"], places, order=1).astype(np.float64)
    scales = np.maximum(frame.scales.astype(np.float64) ** 2, (MIN_SCALE_VOXELS**2 + 1.0 / 6.0) * size**2)
    own = frame.optical_masses / (2.0 * np.pi * scales) ** 1.5
    return np.clip(own / np.maximum(density, 1e-300), 0.0, 1.0) * (own > 0.0)


def _from_first_axis(directions: np.ndarray) -> np.ndarray:
    """[N, 3] of any length -> [N, 4] float32 quaternions w x y z that turn the first axis towards them."""
    lengths = np.linalg.norm(directions, axis=1, keepdims=True)
    x, y, z = np.where(lengths > 0.0, directions / np.maximum(lengths, 1e-300), (1.0, 0.0, 0.0)).T
    turns = np.stack([1.0 + x, np.zeros_like(x), -z, y], axis=1)  # by half the angle about the axis between
    turns[x < -1.0 + 1e-9] = (0.0, 0.0, 0.0, 1.0)
    return (turns / np.linalg.norm(turns, axis=1, keepdims=True)).astype(np.float32)
