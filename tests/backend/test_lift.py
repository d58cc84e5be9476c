"""Buoyancy told from wind: dense smoke against the thinner smoke beside it."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from backend.fit.lift import buoyancy_of, gain_with_density, shared_out, wind_of
from backend.fit.state import PhysicalRecord

UP = np.array([0.3, -0.2, 0.93])
UP /= np.linalg.norm(UP)


def column(wind: tuple[float, float, float], speed: float = 2.0) -> tuple[np.ndarray, np.ndarray]:
    """A plume's core along z that rises along UP as much as it is dense, in a wind that takes hold of all of it; the wind grows
    along the column, as it does on smoke that has left its source."""
    x, y, z = np.meshgrid(*(np.arange(size) for size in (24, 24, 32)), indexing="ij")
    density = np.exp(-((x - 11.5) ** 2 + (y - 11.5) ** 2) / 18.0) * np.exp(-z / 30.0)
    velocity = speed * density[..., None] * UP + np.array(wind) * (0.5 + z / 32.0)[..., None]
    return density, velocity


def degrees(a: np.ndarray, b: np.ndarray) -> float:
    return math.degrees(math.acos(min(1.0, float(a @ b) / float(np.linalg.norm(a) * np.linalg.norm(b)))))


def record(**fields: np.ndarray) -> PhysicalRecord:
    empty = PhysicalRecord(
        positions=np.zeros((0, 3)),
        velocities=np.zeros((0, 3)),
        masses=np.zeros(0),
        ids=np.zeros(0, np.int64),
        born=np.zeros(0, np.int32),
        next_id=np.asarray(0, np.int64),
        smoothing_length=np.asarray(1.0),
        rest_density=np.asarray(1.0),
        buoyancy=np.zeros(3),
        buoyancy_weight=np.asarray(0.0),
        buoyancy_moment=np.zeros(3),
        buoyancy_square=np.zeros(3),
    )
    return replace(empty, **fields)


def test_exact_where_velocity_is_in_proportion_to_density() -> None:
    density, velocity = column((0.0, 0.0, 0.0))
    inside = density > 0.02 * density.max()
    np.testing.assert_allclose(gain_with_density(density, velocity), 2.0 * density[inside].mean() * UP, rtol=1e-9)


@pytest.mark.parametrize("wind", [(3.0, 0.0, 0.0), (-2.0, 4.0, 0.0), (0.0, -9.0, 1.0)])
def test_no_wind_turns_it(wind: tuple[float, float, float]) -> None:
    """Winds several times as fast as the smoke rises turn the mean velocity by more than 40 degrees, the gain hardly."""
    density, velocity = column(wind)
    mean = (density[..., None] * velocity).sum(axis=(0, 1, 2)) / density.sum()
    assert degrees(mean, UP) > 40.0
    assert degrees(gain_with_density(density, velocity), UP) < 4.0


@given(st.floats(1e-6, 1e6), st.floats(1e-6, 1e6))
@settings(max_examples=20, deadline=None)
def test_units_go_through(unit: float, pace: float) -> None:
    density, velocity = column((1.0, 0.5, 0.0))
    expected = pace * gain_with_density(density, velocity)
    np.testing.assert_allclose(gain_with_density(unit * density, pace * velocity), expected, rtol=1e-6)


@pytest.mark.parametrize("density", [np.zeros((8, 8, 8)), np.ones((8, 8, 8)), np.full((1, 1, 1), 3.0)])
def test_nothing_to_compare(density: np.ndarray) -> None:
    """Nothing, or smoke that is as dense everywhere: no gain, and all of the force stays buoyancy."""
    gain = gain_with_density(density, np.random.default_rng(0).normal(size=(*density.shape, 3)))
    np.testing.assert_array_equal(gain, 0.0)
    buoyancy, rest = shared_out(np.array([1.0, 2.0, 3.0]), gain)
    np.testing.assert_array_equal(buoyancy, [1.0, 2.0, 3.0])
    np.testing.assert_array_equal(rest, 0.0)


def test_a_force_is_shared_out_whole_and_at_right_angles() -> None:
    force = np.array([1.0, -2.0, 3.0])
    for gain in (UP, -UP):  # cold smoke sinks: the axis has no sign, the force has one
        buoyancy, rest = shared_out(force, gain)
        np.testing.assert_allclose(buoyancy + rest, force, rtol=1e-12)
        assert abs(float(buoyancy @ rest)) < 1e-12
        assert float(buoyancy @ force) > 0.0


def test_doubt_along_is_the_forces_and_across_the_axis_own() -> None:
    """By hand: four frames; a force of 2 +- 1 along z; gains of 1 along z that disagree by +- 0.1 along x and,
    seen in the same images, count as two."""
    count = 4.0
    known = record(
        buoyancy=np.array([0.0, 0.0, 2.0]),
        buoyancy_weight=np.asarray(count),
        buoyancy_moment=np.array([0.0, 0.0, 8.0]),
        buoyancy_square=np.array([4.0, 0.0, 4.0 * (4.0 + 1.0)]),
        gain=np.array([0.0, 0.0, 4.0]),
        gain_square=np.array([4.0 * 0.01, 0.0, 4.0]),
    )
    _, doubt = buoyancy_of(known)
    np.testing.assert_allclose(doubt, [2.0 * 0.1, 0.0, 1.0 / math.sqrt(3.0)], rtol=1e-9)
    alone = buoyancy_of(replace(known, gain=np.zeros(3), gain_square=np.zeros(3)))[1]
    np.testing.assert_allclose(alone, [1.0 / math.sqrt(3.0), 0.0, 1.0 / math.sqrt(3.0)], rtol=1e-9)


def test_one_frame_tells_no_spread() -> None:
    once = record(buoyancy=np.array([0.0, -1.0, 2.0]), buoyancy_weight=np.asarray(1.0))
    np.testing.assert_array_equal(buoyancy_of(once)[1], [0.0, 1.0, 2.0])


def test_wind_of_what_is_left() -> None:
    np.testing.assert_allclose(wind_of(record(drift=np.array([1.0, 0.0, 0.0])), drag=0.5), [2.0, 0.0, 0.0])
    np.testing.assert_array_equal(wind_of(record(drift=np.ones(3)), drag=0.0), 0.0)
