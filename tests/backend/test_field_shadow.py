"""How much smoke stands between a voxel and a far light."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.stats import norm

from backend.field.shadow import depth_towards
from backend.geometry.lattice import Lattice

LATTICE = Lattice(origin=(-5.9, -5.9, -5.9), voxel_size=0.2, shape=(60, 60, 60))
DIRECTIONS = [(0, 0, 1), (1, 0, 0), (0, -1, 0), (0.5, 0.3, 0.8), (-0.9, 0.2, 0.3), (0.57, -0.58, -0.58)]


def ball() -> np.ndarray:
    """A Gaussian ball of standard deviation 1 m."""
    return np.exp(-0.5 * np.square(LATTICE.centres()).sum(axis=-1)).astype(np.float32)


@pytest.mark.parametrize("direction", DIRECTIONS)
def test_a_gaussian_ball_casts_the_shadow_of_its_integral(direction: tuple[float, float, float]) -> None:
    """Along a ray the integral is known: sqrt(2 pi) exp(-r^2 / 2) (1 - Phi(s)), r from the axis, s towards the light."""
    unit = np.array(direction) / np.linalg.norm(direction)
    places = LATTICE.centres()
    along = places @ unit
    across = np.square(places).sum(axis=-1) - along**2
    wanted = np.sqrt(2 * np.pi) * np.exp(-0.5 * across) * norm.sf(along)
    found = depth_towards(ball(), LATTICE, np.array(direction))
    inside = (np.abs(places) < 2.5).all(axis=-1)
    assert np.abs(found - wanted)[inside].max() < 0.03
    assert np.sqrt(np.mean((found - wanted)[inside] ** 2)) < 0.005


def test_opposite_lights_see_all_smoke_of_a_line() -> None:
    density = np.random.default_rng(0).random((7, 5, 6), dtype=np.float32)
    lattice = Lattice(origin=(0.0, 0.0, 0.0), voxel_size=0.5, shape=density.shape)
    for axis in range(3):
        direction = np.eye(3)[axis]
        both = depth_towards(density, lattice, direction) + depth_towards(density, lattice, -direction)
        line = 0.5 * density.sum(axis=axis)
        np.testing.assert_allclose(both, np.broadcast_to(np.expand_dims(line, axis), density.shape), rtol=1e-5)


def test_a_light_from_nowhere_is_refused() -> None:
    with pytest.raises(ValueError, match="no light"):
        depth_towards(ball(), LATTICE, np.zeros(3))
