"""A proposal made into what a frame can show: less haze, and the sums along its rays that the frame has."""

from __future__ import annotations

import numpy as np

from backend.field.rays import at_voxels, optical_depth
from backend.geometry.camera import View
from backend.geometry.lattice import Lattice
from backend.prior.window import Stand

SHARPNESS = 0.75  # tuned on puff_front, merging_sources and steady_plume, both
LASTING = 1.0
_UPDATES = 4  # towards the frame's own optical depth
_FLOOR = 0.01  # optical depth added to both sides of a ratio
_THIN = 1e-3  # of the largest lasting density, added everywhere
_MOST_RATIO = 4.0
_STEP = 0.75  # voxels along a ray; with 0.5 no figure changes


def sharpened(density: np.ndarray, lasting: np.ndarray) -> np.ndarray:
    """Density [X, Y, Z] 1/m to a power, with the largest as it was, times a power of the lasting density's share of its largest.

    A network that was taught by squared errors answers with a mean over all that could be: a thin haze lies wherever smoke
    might have been, and from aside a picture shows all of it. Once the rays have their sums back, the haze has gone to
    where most smoke is, in this frame and in those around it; there may be several such places on a ray.
    """
    largest, most = float(density.max(initial=0.0)), float(lasting.max(initial=0.0))
    if largest <= 0.0 or most <= 0.0:
        return density
    return largest * (density / largest) ** SHARPNESS * (lasting / most + _THIN) ** LASTING


def agreed(density: np.ndarray, stand: Stand, depth: np.ndarray, view: View) -> np.ndarray:
    """Density [X, Y, Z] 1/m with the optical depth [h, w] that its frame shows in `view`: a few multiplicative updates along
    the rays (Gordon 1970)."""
    lattice, own = stand.lattice, stand.seen(view)
    for _ in range(_UPDATES):
        ratio = ratio_to(depth, density, lattice, own)
        ratio = np.clip(ratio, 1.0 / _MOST_RATIO, _MOST_RATIO).astype(np.float32)
        density = density * at_voxels(ratio, lattice, own, outside=1.0)
    return density


def ratio_to(depth: np.ndarray, density: np.ndarray, lattice: Lattice, view: View) -> np.ndarray:
    """[h, w]: optical depth `depth` over that of a density [X, Y, Z] 1/m; near 1 where both are next to nothing."""
    return (depth + _FLOOR) / (optical_depth(density, lattice, view, step=_STEP) + _FLOOR)
