"""Divergence of moving particles: exact on linear fields, against slow loops, and what sparseness does to both forms."""

from __future__ import annotations

import math

import numpy as np
import pytest

from backend.physics.divergence import MIN_NEIGHBOURS, both_divergences, divergence, divergence_as_published
from tests.reference import fluid_loops

FIELD = np.array([[0.5, 2.0, -1.0], [0.3, -0.2, 0.7], [-0.4, 0.6, 1.1]])  # 1/s, trace 1.4


def cloud(num=300, seed=0):
    return np.random.default_rng(seed).random((num, 3))


def test_linear_field_is_exact():
    positions = cloud()
    found = divergence(positions, positions @ FIELD.T, 0.3)
    assert found.coverage > 0.9
    np.testing.assert_allclose(found.values[np.isfinite(found.values)], 1.4, rtol=1e-3)
    assert found.mean_absolute == pytest.approx(1.4, rel=1e-4)


def test_rotation_and_shift_have_none():
    positions = cloud()
    found = divergence(positions, np.cross([1.0, 2.0, 3.0], positions) + 5.0, 0.3)
    assert found.mean_absolute < 1e-9


def test_published_form_against_slow_loops():
    positions = cloud(60)
    velocities = np.random.default_rng(1).normal(size=(60, 3))
    found = divergence_as_published(positions, velocities, 0.35, regularisation=1e-3)
    expected = fluid_loops.divergences(positions, velocities, 0.35, 1e-3)
    np.testing.assert_allclose(found.values, expected, rtol=1e-9, atol=1e-12)
    assert found.mean_absolute == pytest.approx(np.abs(expected).mean(), rel=1e-9)
    assert found.coverage == 1.0


def test_both_at_once_are_each_alone():
    positions = np.concatenate([cloud(120), [[9.0, 0.0, 0.0]]])
    velocities = np.random.default_rng(2).normal(size=positions.shape)
    published, corrected = both_divergences(positions, velocities, 0.4)
    alone = divergence_as_published(positions, velocities, 0.4), divergence(positions, velocities, 0.4)
    for together, apart in zip((published, corrected), alone, strict=True):
        np.testing.assert_array_equal(together.values, apart.values)
        assert (together.mean_absolute, together.coverage) == (apart.mean_absolute, apart.coverage)
    assert published.coverage == 1.0 > corrected.coverage


def test_sparse_sets_look_better_only_as_published():
    """The same flow seen through fewer particles in smaller units: the published figure shrinks, the corrected stays."""
    published, corrected = [], []
    for scale in (1.0, 1e-2):
        positions = scale * cloud()
        published.append(divergence_as_published(positions, positions @ FIELD.T, 0.3 * scale).mean_absolute)
        corrected.append(divergence(positions, positions @ FIELD.T, 0.3 * scale).mean_absolute)
    assert published[1] < 0.5 * published[0]
    assert corrected[1] == pytest.approx(corrected[0], rel=1e-9)


def test_few_neighbours_have_no_value():
    positions = np.concatenate([cloud(200), [[50.0, 0.0, 0.0], [50.1, 0.0, 0.0]]])
    found = divergence(positions, positions @ FIELD.T, 0.3)
    assert np.isnan(found.values[-2:]).all()
    assert found.coverage == pytest.approx(np.isfinite(found.values).mean())
    near = np.linalg.norm(positions[:, None] - positions[None], axis=2) < 0.3
    np.testing.assert_array_equal(np.isfinite(found.values), near.sum(axis=1) - 1 >= MIN_NEIGHBOURS)
    published = divergence_as_published(positions, positions @ FIELD.T, 0.3)
    assert published.values[-1] == pytest.approx(0.5 * 1.0, rel=0.1)  # it sees one direction out of three


@pytest.mark.parametrize("num", [0, 1, 2])
def test_few_particles(num):
    found = divergence(np.zeros((num, 3)), np.zeros((num, 3)), 1.0)
    assert math.isnan(found.mean_absolute) and found.coverage == 0.0
    published = divergence_as_published(np.zeros((num, 3)), np.zeros((num, 3)), 1.0)
    assert published.coverage == (1.0 if num else 0.0)


def test_coincident_and_flat_sets_stay_finite():
    flat = cloud() * np.array([1.0, 1.0, 0.0])
    found = divergence(flat, flat @ FIELD.T, 0.3)
    assert np.isfinite(found.values).mean() == found.coverage > 0.9
    assert found.mean_absolute == pytest.approx(abs(FIELD[0, 0] + FIELD[1, 1]), rel=1e-3)
    pile = divergence(np.zeros((20, 3)), cloud(20), 0.3)
    assert pile.coverage == 0.0


def test_bad_input_is_refused():
    with pytest.raises(ValueError, match="NaN"):
        divergence(np.full((3, 3), np.nan), np.zeros((3, 3)), 1.0)
    with pytest.raises(ValueError, match="regularisation"):
        divergence_as_published(np.zeros((3, 3)), np.zeros((3, 3)), 1.0, regularisation=0.0)
    with pytest.raises(ValueError, match="both"):
        divergence(np.zeros((3, 3)), np.zeros((2, 3)), 1.0)
