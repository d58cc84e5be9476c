"""Where smoke lasts: the one density that explains the images of many frames around a moment, as well as one can.

What is proposed for a frame is unsure in depth; what other frames show from elsewhere is not known of smoke that has moved
on since. But plumes stay roughly where they are: from all sides of the camera's way their mean is seen as a still thing is
in tomography, and where the mean is thin a frame's own smoke seldom lies.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from backend.field.rays import at_voxels, optical_depth
from backend.geometry.camera import View
from backend.geometry.lattice import Lattice

_UPDATES = 6
_FLOOR = 0.01  # optical depth added to both sides of a ratio


@dataclass(frozen=True, slots=True, kw_only=True)
class Sighting:
    """A frame's optical depth [h, w], its view, and how much it counts."""

    depth: np.ndarray
    view: View
    weight: float


def lasting(density: np.ndarray, lattice: Lattice, sightings: Sequence[Sighting]) -> np.ndarray:
    """Density [X, Y, Z] 1/m, from a first guess that is nowhere zero where smoke may be.

    Maximum likelihood by expectation maximisation (Shepp and Vardi 1982), of images whose smoke is counted; voxels that no
    image shows stay as they are.
    """
    shown = [sighting.weight * at_voxels(np.ones_like(sighting.depth), lattice, sighting.view) for sighting in sightings]
    share = np.sum(shown, axis=0)
    for _ in range(_UPDATES):
        total = np.zeros_like(share)
        for sighting in sightings:
            ratio = (sighting.depth + _FLOOR) / (optical_depth(density, lattice, sighting.view) + _FLOOR)
            total += np.float32(sighting.weight) * at_voxels(ratio, lattice, sighting.view)
        density = density * np.where(share > 0.0, total / np.maximum(share, 1e-6), 1.0)
    return density
