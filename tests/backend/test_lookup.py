"""Values between voxels, against scipy."""

from __future__ import annotations

import numpy as np
import pytest
from scipy import ndimage

from backend.field.lookup import deposited, trilinear


@pytest.mark.parametrize("outside", ["grid-constant", "nearest"])
@pytest.mark.parametrize("shape", [(5, 6, 7), (1, 4, 3), (5, 6, 7, 3), (2, 1, 1, 1)])
def test_it_agrees_with_scipy_inside_at_the_border_and_beyond(outside: str, shape: tuple[int, ...]) -> None:
    draw = np.random.default_rng(0)
    values = draw.normal(size=shape).astype(np.float32)
    places = np.concatenate([draw.uniform(-3.0, 9.0, (4000, 3)), draw.integers(-2, 8, (400, 3)).astype(float)])
    places = np.concatenate([places, np.array([[1e12, 0.0, 0.0], [0.0, -1e12, 1.0]])])
    found = trilinear(values, places, outside=outside)
    channels = [values] if values.ndim == 3 else [values[..., index] for index in range(shape[3])]
    wanted = [ndimage.map_coordinates(channel, places.T, order=1, mode=outside) for channel in channels]
    assert found.dtype == np.float32
    np.testing.assert_allclose(found, wanted[0] if values.ndim == 3 else np.stack(wanted, axis=1), atol=2e-6)


def test_no_points_no_voxels_and_no_numbers() -> None:
    values = np.ones((3, 3, 3), np.float32)
    assert trilinear(values, np.zeros((0, 3)), outside="nearest").shape == (0,)
    assert trilinear(np.ones((3, 3, 3, 2)), np.zeros((0, 3)), outside="nearest").shape == (0, 2)
    assert trilinear(np.zeros((0, 0, 0), np.float32), np.zeros((2, 3)), outside="nearest").tolist() == [0.0, 0.0]
    assert trilinear(values, np.array([[np.nan, 1.0, 1.0], [1.0, 1.0, 1.0]]), outside="nearest").tolist() == [0.0, 1.0]


def test_masses_are_shared_and_kept() -> None:
    rng = np.random.default_rng(1)
    places = rng.uniform(0.0, 7.0, (500, 3))
    masses = rng.random(500)
    total = deposited(places, masses, (8, 8, 8))
    assert total.sum() == pytest.approx(masses.sum())
    middle = np.stack([(total * axis).sum() for axis in np.indices((8, 8, 8))]) / total.sum()
    np.testing.assert_allclose(middle, masses @ places / masses.sum(), atol=1e-9)
    assert deposited(np.array([[40.0] * 3, [np.nan] * 3]), np.ones(2), (8, 8, 8)).sum() == 0.0
