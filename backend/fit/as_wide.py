"""Smoke before a camera that stands still, as deep as it is wide.

Such a camera shows nothing of depth, and a network that was taught by squared errors answers with a mean over all that could be,
drawn out along the view. How deep smoke is says its silhouette better (`backend/fit/depth_prior.py`); where in depth its levels
lie, and what on a ray is dense, says the network.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import replace

import numpy as np
from scipy import ndimage

from backend.field.rays import at_voxels
from backend.fit.depth_prior import inflate
from backend.fit.region import Region
from backend.geometry.camera import View
from backend.prior.predict import Proposal
from backend.prior.window import Stand

_WIDER = 1.3  # times the solid's chord: tuned, as the power is, on ten plumes before a camera that stands still
_POWER = 0.5
_LEAST = 0.8  # voxels, of half a chord
_SMOOTH = 3.0  # voxels of the prior's, standard deviation: neighbouring levels have their middles nearly in one place
_FOOT = 0.1  # of a frame's smoke: so much of it, the lowest, is its foot
_BEYOND = 1e-4  # of what the middle of a chord counts: the frame's smoke is there, even where the solid has no room for it


def too_near(proposals: Iterable[Proposal], region: Region) -> float:
    """How many times as far away as its foot in what a network says the smoke rises, in the mean: no still camera shows how far
    away smoke is, and it stands where it is taken to. 1 where there is none."""
    away = total = 0.0
    for proposal in proposals:
        mass = proposal.density.sum(axis=(0, 1), dtype=np.float64)
        foot = np.clip(_FOOT * mass.sum() - (np.cumsum(mass) - mass), 0.0, mass)
        along = np.arange(proposal.density.shape[1]) @ proposal.density.sum(axis=0, dtype=np.float64)
        source = float(proposal.stand.voxels(region.source[None])[0, 1])
        away += float(foot @ (along / np.maximum(mass, 1e-12) - source)) * proposal.stand.lattice.voxel_size
        total += float(foot.sum())
    distance = float(np.linalg.norm(region.source - region.pictures.views[0].position))
    behind = away / total if total > 0.0 else 0.0
    return distance / max(distance + behind, 0.5 * distance)


def larger(proposal: Proposal, eye: np.ndarray, factor: float) -> Proposal:
    """What looks the same to an `eye` [3] m, that many times as large and as far away."""
    lattice, matrix = proposal.stand.lattice, proposal.stand.from_world.copy()
    x, y, z = (factor * start for start in lattice.origin)
    seen_from = matrix[:3, :3] @ eye
    matrix[:3, 3] = factor * (seen_from + matrix[:3, 3]) - seen_from
    return Proposal(
        stand=Stand(lattice=replace(lattice, origin=(x, y, z), voxel_size=factor * lattice.voxel_size), from_world=matrix),
        density=proposal.density / np.float32(factor),
        velocity=proposal.velocity * np.float32(factor),
    )


def as_deep_as_wide(
    density: np.ndarray,  # [X, Y, Z] 1/m, as a network says it, on the voxels of `stand`, Y along the view
    stand: Stand,
    depth: np.ndarray,  # [h, w] optical depth of the frame
    view: View,
    source: np.ndarray,  # [3] m: how far away the smoke is
    *,
    finer: float = 1.0,  # voxels of the stand to one of the prior's
) -> np.ndarray:
    """[X, Y, Z] 1/m: the density to a power, times the profile of the silhouette's solid around the middle of each level; with
    the largest as it was, and other sums along the rays."""
    largest, mass = float(density.max(initial=0.0)), density.sum(axis=(0, 1), dtype=np.float64)
    if largest <= 0.0 or not depth.any():
        return density
    along = np.arange(density.shape[1])
    smooth = _SMOOTH * finer
    total = ndimage.gaussian_filter1d(mass, smooth, mode="constant")
    middle = ndimage.gaussian_filter1d(along @ density.sum(axis=0, dtype=np.float64), smooth, mode="constant")
    middle /= total + 1e-9 * mass.max()
    chords = inflate(depth, view, source).half_thickness.astype(np.float32) / np.float32(stand.lattice.voxel_size)
    half = at_voxels(chords, stand.lattice, stand.seen(view), outside=float(chords.min()))
    share = (along[:, None] - middle).astype(np.float32) / np.maximum(np.float32(_WIDER) * half, np.float32(_LEAST))
    profile = np.maximum(1.0 - share * share, 0.0) ** 1.5 + _BEYOND
    return largest * (density / largest) ** _POWER * profile.astype(np.float32)
