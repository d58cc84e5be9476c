"""Smoke as another side sees it: sunlight goes on forwards more than it turns back.

Colours of particles are radiance as filmed, towards the camera of their frame. What a view from elsewhere gets of the sun's share
of it is another part of the phase function

    p(cos) = (1 - g^2) / (1 + g^2 - 2 g cos)^(3/2)        Henyey and Greenstein 1941, times 4 pi: one in the mean

cos: of the angle between the ways of the light before and after. The rest of the light is the same from all sides.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from backend.contract.light import Light
from backend.geometry.camera import View
from backend.io.particles import ParticleFrame

ONCE = 0.5  # of the anisotropy: what is scattered more than once has lost part of its way, and where smoke looks into the sun it
# shows its shaded side. Tuned on puff_front, merging_sources and steady_plume


def phase(anisotropy: float, cosine: np.ndarray) -> np.ndarray:
    """p, for anisotropies g between -1 and 1."""
    return (1.0 - anisotropy**2) / (1.0 + anisotropy**2 - 2.0 * anisotropy * cosine) ** 1.5


def seen_from(frame: ParticleFrame, view: View, *, filmed: View, light: Light | None) -> ParticleFrame:
    """The frame with the colours that `view` sees, of those that `filmed` saw."""
    if light is None or light.anisotropy == 0.0:
        return frame
    before, after = (_reaching(light, frame.positions - place) for place in (filmed.position, view.position))
    return replace(frame, colors=(frame.colors * (after / before)[:, None]).astype(np.float32))


def _reaching(light: Light, ways: np.ndarray) -> np.ndarray:
    """[N]: light that leaves smoke against ways [N, 3] from a camera to it, of what leaves it in the mean."""
    lengths = np.linalg.norm(ways, axis=1)
    cosine = ways @ np.asarray(light.direction) / np.maximum(lengths, 1e-300)
    return light.sun_share * phase(ONCE * light.anisotropy, cosine) + (1.0 - light.sun_share)
