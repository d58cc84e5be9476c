"""What tells how much levels cost that lie wrong in depth moves them as it says."""

from __future__ import annotations

import numpy as np
import pytest

from benchmarks.depth_levels import Level, moved_levels


def blob() -> np.ndarray:
    x, y, z = np.indices((24, 40, 12), dtype=np.float64)
    return np.exp(-(((x - 11) / 3) ** 2 + ((y - 17 - 0.3 * z) / 3) ** 2 + ((z - 6) / 3) ** 2)).astype(np.float32)


def test_levels_move_in_depth_alone() -> None:
    density = blob()
    before, by = Level.of(density), np.linspace(-4.0, 4.0, 12)
    moved = moved_levels(density, before.middle, by, 1.0)
    after = Level.of(moved)
    np.testing.assert_allclose(after.middle - before.middle, by, atol=0.02)
    np.testing.assert_allclose(after.mass, before.mass, rtol=1e-3)
    np.testing.assert_allclose(moved.sum(axis=1), density.sum(axis=1), rtol=1e-2, atol=1e-3)


def test_levels_are_made_deeper_and_keep_their_mass() -> None:
    density = blob()
    before = Level.of(density)
    after = Level.of(moved_levels(density, before.middle, np.zeros(12), 1.5))
    np.testing.assert_allclose(after.depth, 1.5 * before.depth, rtol=0.05)
    np.testing.assert_allclose(after.mass, before.mass, rtol=1e-2)
    np.testing.assert_allclose(after.middle, before.middle, atol=0.02)


def test_the_depth_of_a_level_is_its_standard_deviation() -> None:
    assert Level.of(blob()).depth[6] == pytest.approx(3 / np.sqrt(2), rel=0.01)
