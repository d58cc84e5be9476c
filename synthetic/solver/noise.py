"""Flicker and stirring of the sources: sums of random waves in space and time, seeded, the same at every resolution."""

from __future__ import annotations

import numpy as np

_NUM_WAVES = 24


class SourceNoise:
    """Random waves around one source: smooth fields of position and time with zero mean and unit variance."""

    def __init__(self, *, seed: int, radius: float) -> None:
        random = np.random.Generator(np.random.PCG64(seed))
        direction = random.normal(size=(_NUM_WAVES, 3))
        direction /= np.linalg.norm(direction, axis=1, keepdims=True)
        length = radius * random.uniform(0.5, 2.0, size=(_NUM_WAVES, 1))  # wavelength, m
        self._wave_vectors = 2 * np.pi * direction / length  # [W, 3] 1/m
        self._rates = 2 * np.pi * random.uniform(0.5, 4.0, size=_NUM_WAVES)  # [W] rad/s
        self._phases = random.uniform(0, 2 * np.pi, size=(2, _NUM_WAVES))
        # A swirl perpendicular to its wave vector has no divergence.
        swirl = np.cross(direction, random.normal(size=(_NUM_WAVES, 3)))
        self._swirls = swirl / np.linalg.norm(swirl, axis=1, keepdims=True)

    def flicker(self, positions: np.ndarray, time: float) -> np.ndarray:  # [..., 3] m, s -> [...]
        """Scalar noise."""
        waves = np.cos(positions @ self._wave_vectors.T + self._rates * time + self._phases[0])
        return waves.sum(axis=-1) * np.sqrt(2 / _NUM_WAVES)

    def stirring(self, positions: np.ndarray, time: float) -> np.ndarray:  # [..., 3] m, s -> [..., 3]
        """Vector noise without divergence; a component has variance 1."""
        waves = np.cos(positions @ self._wave_vectors.T + self._rates * time + self._phases[1])
        return waves @ self._swirls * np.sqrt(6 / _NUM_WAVES)
