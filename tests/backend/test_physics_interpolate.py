"""Velocity between particles: against direct sums, continuity out to far away, constants kept, extremes."""

from __future__ import annotations

import numpy as np
import pytest

from backend.physics.fluid import FluidState
from backend.physics.interpolate import interpolate_velocity, smooth
from tests.reference import fluid_loops


def state_of(positions, velocities):
    num = len(positions)
    return FluidState(
        positions=np.asarray(positions, np.float64),
        velocities=np.asarray(velocities, np.float64),
        masses=np.ones(num),
        ids=np.arange(num),
        born=np.zeros(num, np.int32),
    )


def cloud(num=200, seed=0):
    random = np.random.default_rng(seed)
    return state_of(random.random((num, 3)), random.normal(size=(num, 3)))


def test_hand_value():
    """Two particles at 0 and 1, h = 2, point at 0.5: equal weights (15/16)^3."""
    state = state_of([[0.0, 0.0, 0.0], [1.0, 0.0, 0.0]], [[0.0, 0.0, 2.0], [4.0, 0.0, 0.0]])
    velocity, weight = interpolate_velocity(np.array([[0.5, 0.0, 0.0]]), state, 2.0)
    np.testing.assert_allclose(velocity, [[2.0, 0.0, 1.0]], rtol=1e-12)
    assert weight[0] == pytest.approx(2.0 * (15.0 / 16.0) ** 3, rel=1e-12)


def test_against_direct_sums():
    state, length = cloud(), 0.4
    points = np.random.default_rng(1).uniform(0.2, 0.8, (30, 3))
    velocities, weights = interpolate_velocity(points, state, length)
    for point, velocity, weight in zip(points, velocities, weights, strict=True):
        kernel = np.array([fluid_loops.poly6(float(np.linalg.norm(point - x)), length) for x in state.positions])
        assert weight == pytest.approx(kernel.sum() / fluid_loops.poly6(0.0, length), rel=1e-12)
        np.testing.assert_allclose(velocity, kernel @ state.velocities / kernel.sum(), rtol=1e-10, atol=1e-12)


def test_smooth_against_direct_sums():
    state, length = cloud(), 0.3
    field = np.random.default_rng(2).normal(size=(200, 3))
    kernel = [[fluid_loops.poly6(float(np.linalg.norm(a - b)), length) for b in state.positions] for a in state.positions]
    expected = np.array(kernel) @ field / np.sum(kernel, axis=1, keepdims=True)
    np.testing.assert_allclose(smooth(field, state, length), expected, rtol=1e-10, atol=1e-12)


@pytest.mark.parametrize("num", [1, 2, 8, 9, 10, 200])
def test_constants_are_kept_everywhere(num):
    state = cloud(num)
    state = state_of(state.positions, np.broadcast_to([1.0, -2.0, 3.0], (num, 3)))
    points = np.concatenate([np.random.default_rng(3).normal(size=(100, 3)) * scale for scale in (0.1, 1.0, 1e3, 1e9)])
    velocities, _ = interpolate_velocity(points, state, 0.2)
    np.testing.assert_allclose(velocities, np.broadcast_to([1.0, -2.0, 3.0], points.shape), rtol=1e-12)
    np.testing.assert_allclose(smooth(state.velocities, state, 0.2), state.velocities, rtol=1e-12)


def test_continuous_from_the_middle_to_far_away():
    """Along a line through the cloud and out of it, no jump between samples a thousandth of a smoothing length apart."""
    state, length = cloud(60), 0.15
    along = np.arange(-20.0 * length, 20.0 * length, 1e-3 * length)
    points = np.array([0.5, 0.5, 0.5]) + along[:, None] * np.array([[0.6, 0.64, 0.48]])
    velocities, weights = interpolate_velocity(points, state, length)
    assert weights.min() == 0.0 and weights.max() > 0.2
    assert np.abs(np.diff(velocities, axis=0)).max() < 0.05
    lowest, highest = state.velocities.min(axis=0), state.velocities.max(axis=0)
    assert np.all(velocities >= lowest - 1e-12) and np.all(velocities <= highest + 1e-12)


def test_rigid_rotation_is_followed():
    axis = np.linspace(0.0, 1.0, 12)
    positions = np.stack(np.meshgrid(axis, axis, axis), axis=-1).reshape(-1, 3)
    turning = np.cross([0.0, 0.0, 1.0], positions)
    points = np.random.default_rng(4).uniform(0.3, 0.7, (50, 3))
    velocities, _ = interpolate_velocity(points, state_of(positions, turning), 0.2)
    np.testing.assert_allclose(velocities, np.cross([0.0, 0.0, 1.0], points), atol=0.01)


def test_smoothing_lowers_noise_and_keeps_the_particle():
    state = cloud(1000)
    smoothed = smooth(state.velocities, state, 0.25)
    assert np.std(smoothed) < 0.5 * np.std(state.velocities)
    lonely = state_of([[0.0, 0.0, 0.0], [100.0, 0.0, 0.0]], np.eye(2, 3))
    np.testing.assert_array_equal(smooth(lonely.velocities, lonely, 0.1), lonely.velocities)


def test_coincident_particles_average():
    state = state_of(np.zeros((20, 3)), np.arange(60.0).reshape(20, 3))
    mean = state.velocities.mean(axis=0)
    np.testing.assert_allclose(smooth(state.velocities, state, 0.1), np.broadcast_to(mean, (20, 3)), rtol=1e-12)
    velocities, _ = interpolate_velocity(np.array([[0.0, 0.0, 0.0], [5.0, 0.0, 0.0]]), state, 0.1)
    np.testing.assert_allclose(velocities[0], mean, rtol=1e-12)
    assert np.isfinite(velocities).all()


def test_nothing_at_all():
    empty = cloud(0)
    velocities, weights = interpolate_velocity(np.ones((3, 3)), empty, 0.1)
    assert not velocities.any() and not weights.any()
    assert smooth(np.zeros((0, 3)), empty, 0.1).shape == (0, 3)
    velocities, weights = interpolate_velocity(np.zeros((0, 3)), cloud(5), 0.1)
    assert velocities.shape == (0, 3) and weights.shape == (0,)


@pytest.mark.parametrize("scale", [1e-6, 1e6])
def test_scale_invariance(scale):
    state = cloud()
    points = np.random.default_rng(5).uniform(-1.0, 2.0, (100, 3))
    plain = interpolate_velocity(points, state, 0.2)
    scaled = interpolate_velocity(scale * points, state_of(scale * state.positions, state.velocities), scale * 0.2)
    np.testing.assert_allclose(scaled[0], plain[0], rtol=1e-7, atol=1e-9)
    np.testing.assert_allclose(scaled[1], plain[1], rtol=1e-9, atol=1e-12)


def test_bad_input_is_refused():
    state = cloud(4)
    with pytest.raises(ValueError, match="points"):
        interpolate_velocity(np.array([[np.nan, 0.0, 0.0]]), state, 0.1)
    with pytest.raises(ValueError, match="points"):
        interpolate_velocity(np.zeros((3, 2)), state, 0.1)
    with pytest.raises(ValueError, match="smoothing_length"):
        interpolate_velocity(np.zeros((3, 3)), state, 0.0)
    with pytest.raises(ValueError, match="rows"):
        smooth(np.zeros((3, 3)), state, 0.1)
