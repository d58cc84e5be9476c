"""Colours as another side knows them.

A frame says how bright a ray is, not which part of the smoke along it. Seen along the same line, from before or behind, all of it
holds; across that line only what neighbours share does:

    c_i' = s c_i + (1 - s) mean of c around i,    s = cos^4 of the angle between the two views

The mean: of optical masses, by a Gaussian as wide as the smoke's own depth makes the place on a ray unsure.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from scipy import ndimage

from backend.geometry.camera import View
from backend.io.particles import ParticleFrame

REACH = 0.6  # of the standard deviation of the smoke's depth. Tuned, with the power, on puff_front, merging_sources, steady_plume
_POWER = 4
_CELLS = 4  # in one reach
_MOST_CELLS = 96  # along the longest side
_ALIKE = 1e-6  # that the colours keep less than all of


def evened(frame: ParticleFrame, view: View, *, filmed: View) -> ParticleFrame:
    """The frame with the colours that `view` can know, of those that `filmed` saw."""
    mass = frame.optical_masses.astype(np.float64)
    if not mass.sum() > 0.0:
        return frame
    middle = np.average(frame.positions, axis=0, weights=mass)
    before, after = (_direction(middle - place.position) for place in (filmed, view))
    kept = float(before @ after) ** _POWER
    deep = frame.positions @ before
    spread = float(np.sqrt(np.average(np.square(deep - np.average(deep, weights=mass)), weights=mass)))
    if 1.0 - kept <= _ALIKE or not spread > 0.0:
        return frame
    shared = _around(frame.positions, mass, frame.colors, reach=REACH * spread)
    return replace(frame, colors=(kept * frame.colors + (1.0 - kept) * shared).astype(np.float32))


def _around(positions: np.ndarray, mass: np.ndarray, colors: np.ndarray, *, reach: float) -> np.ndarray:
    """[N, 3]: means of colours [N, 3] by masses [N] around positions [N, 3] m; reach: a standard deviation, m."""
    low, high = positions.min(axis=0), positions.max(axis=0)
    size = max(reach / _CELLS, float((high - low).max()) / _MOST_CELLS)
    places = (positions - low) / size
    shape = tuple(int(count) + 2 for count in (high - low) / size)
    flat = np.ravel_multi_index(tuple(np.rint(places).astype(np.int64).T), shape)

    def blurred(weights: np.ndarray) -> np.ndarray:
        summed = np.bincount(flat, weights, int(np.prod(shape))).reshape(shape)
        grid = ndimage.gaussian_filter(summed, reach / size, mode="constant")
        return ndimage.map_coordinates(grid, places.T, order=1, mode="nearest")

    total = blurred(mass)
    known = total > 0.0
    means = [
        np.divide(blurred(mass * channel), total, out=channel.copy(), where=known) for channel in colors.T.astype(np.float64)
    ]
    return np.stack(means, axis=1)


def _direction(way: np.ndarray) -> np.ndarray:
    return way / max(float(np.linalg.norm(way)), 1e-300)
