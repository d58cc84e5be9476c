"""A source: how many, when, where, and the same however time is cut."""

from __future__ import annotations

import itertools

import numpy as np
import pytest

from backend.physics.emission import Source, emit, joined, places_in_ball

SOURCE = Source(position=(1.0, 2.0, 3.0), radius=0.1, rate=10.0, velocity=(0.0, 0.0, 2.0), first_id=100)


def test_by_hand():
    """10/s from 0 to 0.3 s: births at 0.05, 0.15, 0.25 s, so that they have risen by 0.5, 0.3, 0.1 m."""
    point = Source(position=(0.0, 0.0, 0.0), radius=0.0, rate=10.0, velocity=(0.0, 0.0, 2.0), first_id=7, mass=0.5)
    born = emit(point, 0.0, 0.3, frame=4)
    np.testing.assert_allclose(born.positions, [[0.0, 0.0, 0.5], [0.0, 0.0, 0.3], [0.0, 0.0, 0.1]], atol=1e-12)
    np.testing.assert_array_equal(born.ids, [7, 8, 9])
    np.testing.assert_array_equal(born.born, [4, 4, 4])
    np.testing.assert_array_equal(born.masses, [0.5, 0.5, 0.5])
    np.testing.assert_array_equal(born.velocities, [[0.0, 0.0, 2.0]] * 3)


@pytest.mark.parametrize("cuts", [1, 7, 24, 1000])
def test_cutting_time_changes_nothing(cuts):
    whole = emit(SOURCE, 0.0, 5.0, frame=0)
    times = np.linspace(0.0, 5.0, cuts + 1)
    parts = [emit(SOURCE, float(a), float(b), frame=0) for a, b in itertools.pairwise(times)]
    np.testing.assert_array_equal(np.concatenate([part.ids for part in parts]), whole.ids)
    assert len(whole.ids) == 50
    aged = [part.positions + (5.0 - stop) * part.velocities for part, stop in zip(parts, times[1:], strict=True)]
    np.testing.assert_allclose(np.concatenate(aged), whole.positions, atol=1e-12)


def test_places_fill_the_ball():
    places = places_in_ball(np.arange(20_000), seed=3)
    radii = np.linalg.norm(places, axis=1)
    assert radii.max() <= 1.0
    np.testing.assert_allclose(places.mean(axis=0), 0.0, atol=0.02)
    np.testing.assert_allclose(np.cov(places.T), 0.2 * np.eye(3), atol=0.01)  # a uniform ball has 1/5 along each axis
    assert np.mean(radii < 0.5) == pytest.approx(1.0 / 8.0, abs=0.01)
    assert not np.array_equal(places, places_in_ball(np.arange(20_000), seed=4))


def test_joined_keeps_both():
    first, second = emit(SOURCE, 0.0, 1.0, frame=0), emit(SOURCE, 1.0, 2.0, frame=1)
    both = joined(first, second)
    np.testing.assert_array_equal(both.ids, np.arange(100, 120))
    np.testing.assert_array_equal(both.positions[10:], second.positions)


def test_nothing_to_emit():
    silent = Source(position=(0.0, 0.0, 0.0), radius=1.0, rate=0.0)
    assert len(emit(silent, 0.0, 1e6, frame=0).ids) == 0
    assert len(emit(SOURCE, 1.0, 1.0, frame=0).ids) == 0


def test_bad_input_is_refused():
    with pytest.raises(ValueError, match="Source"):
        Source(position=(0.0, np.nan, 0.0), radius=1.0, rate=1.0)
    with pytest.raises(ValueError, match="Source"):
        Source(position=(0.0, 0.0, 0.0), radius=-1.0, rate=1.0)
    with pytest.raises(ValueError, match="span"):
        emit(SOURCE, 1.0, 0.5, frame=0)
    with pytest.raises(ValueError, match="more than"):
        emit(Source(position=(0.0, 0.0, 0.0), radius=1.0, rate=1e12), 0.0, 1.0, frame=0)
