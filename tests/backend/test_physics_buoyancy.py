"""Buoyancy from velocities: exact on the step's own motion, within two degrees under noise, honest about what it knows."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest

from backend.physics.buoyancy import solve_buoyancy
from backend.physics.fluid import FluidParameters, FluidState, derive_parameters, step

TILTED = np.array([0.4, -0.3, 1.6])


def angle(a, b):
    return math.degrees(math.acos(min(1.0, float(a @ b) / float(np.linalg.norm(a) * np.linalg.norm(b)))))


def rollout(num_frames=24, num=300, drag=0.8):
    """States of a cloud that rises along TILTED and presses against itself, and the substeps of each frame."""
    random = np.random.default_rng(0)
    state = FluidState(
        positions=random.random((num, 3)) * 0.9,
        velocities=0.2 * random.normal(size=(num, 3)),
        masses=np.ones(num),
        ids=np.arange(num),
        born=np.zeros(num, np.int32),
    )
    parameters = derive_parameters(random.random((num, 3)), drag=drag)
    parameters = replace(parameters, buoyancy=tuple(TILTED), wind=(0.3, 0.0, 0.0))
    states, substeps = [state], []
    for _ in range(num_frames):
        state, report = step(state, parameters, 1.0 / 24.0)
        assert not report.is_limited
        states.append(state)
        substeps.append(report.substeps)
    return states, substeps


def test_by_hand():
    """No drag: b = (v1 - v0) / dt. With drag 2 and dt 0.5: b = (2 v1 - v0) / dt."""
    before, after = np.array([[1.0, 0.0, 0.0]] * 4), np.array([[1.0, 0.0, 2.0]] * 4)
    np.testing.assert_allclose(solve_buoyancy(before, after, np.ones(4), 0.5).vector, [0.0, 0.0, 4.0])
    np.testing.assert_allclose(solve_buoyancy(before, after, np.ones(4), 0.5, drag=2.0).vector, [2.0, 0.0, 8.0])


@pytest.mark.parametrize("substeps", [1, 3])
def test_exact_on_free_particles(substeps):
    parameters = FluidParameters(
        smoothing_length=0.26 / substeps, rest_density=1e9, buoyancy=tuple(TILTED), wind=(0.2, 0.1, 0.0), drag=1.7,
        max_substeps=9,
    )  # fmt: skip
    random = np.random.default_rng(1)
    velocities = random.normal(size=(5, 3))
    velocities *= 1.0 / np.linalg.norm(velocities, axis=1, keepdims=True)
    state = FluidState(
        positions=10.0 * random.random((5, 3)), velocities=velocities, masses=np.ones(5), ids=np.arange(5),
        born=np.zeros(5, np.int32),
    )  # fmt: skip
    after, report = step(state, parameters, 0.1)
    assert report.substeps == substeps
    found = solve_buoyancy(velocities, after.velocities, np.ones(5), 0.1, drag=1.7, wind=(0.2, 0.1, 0.0), substeps=substeps)
    np.testing.assert_allclose(found.vector, TILTED, rtol=1e-10)


def test_tilted_buoyancy_under_noise():
    """Velocities with noise of a tenth of a metre a second, twice the gain of a frame: direction within two degrees."""
    states, substeps = rollout()
    random = np.random.default_rng(2)
    observed = [state.velocities + 0.1 * random.normal(size=state.velocities.shape) for state in states]
    before, after = np.concatenate(observed[:-1]), np.concatenate(observed[1:])
    found = solve_buoyancy(
        before, after, np.ones(len(before)), 1.0 / 24.0, drag=0.8, wind=(0.3, 0.0, 0.0), substeps=max(substeps)
    )
    assert angle(found.vector, TILTED) < 2.0
    assert found.strength == pytest.approx(float(np.linalg.norm(TILTED)), rel=0.03)
    assert angle(found.direction, TILTED) < 2.0


def test_uncertainty_is_what_it_says():
    """Over many draws of noise, the errors spread as the covariance promises."""
    random = np.random.default_rng(3)
    errors, promised = [], []
    for _ in range(400):
        after = 0.1 * TILTED + 0.05 * random.normal(size=(30, 3))
        found = solve_buoyancy(np.zeros((30, 3)), after, random.random(30), 0.1)
        errors.append(found.vector - TILTED)
        promised.append(np.trace(found.covariance))
    assert np.square(errors).sum(axis=1).mean() == pytest.approx(np.mean(promised), rel=0.15)
    assert found.strength_deviation == pytest.approx(0.5 / math.sqrt(22.0), rel=0.5)
    assert 0.0 < found.angle_deviation < 0.3


def test_fewer_independent_observations_are_less_sure():
    random = np.random.default_rng(4)
    arrays = (np.zeros((50, 3)), random.normal(size=(50, 3)), np.ones(50), 0.1)
    sure, unsure = solve_buoyancy(*arrays), solve_buoyancy(*arrays, num_independent=8.0)
    np.testing.assert_allclose(unsure.covariance, sure.covariance * 49.0 / 7.0)
    np.testing.assert_array_equal(sure.vector, unsure.vector)


def test_ridge_pulls_to_the_prior():
    arrays = (np.zeros((4, 3)), np.full((4, 3), 0.1), np.ones(4), 0.1)
    found = solve_buoyancy(*arrays, prior=(0.0, 0.0, 3.0), prior_weight=4.0)
    np.testing.assert_allclose(found.vector, [0.5, 0.5, 2.0])
    np.testing.assert_allclose(solve_buoyancy(*arrays, prior_weight=1e9).vector, 0.0, atol=1e-8)


def test_unweighted_particles_have_no_say():
    before = np.zeros((3, 3))
    after = np.array([[0.0, 0.0, 1.0], [0.0, 0.0, 1.0], [1e6, 0.0, 0.0]])
    np.testing.assert_allclose(solve_buoyancy(before, after, np.array([1.0, 1.0, 0.0]), 1.0).vector, [0.0, 0.0, 1.0])


@pytest.mark.parametrize("num", [0, 1, 5])
def test_without_observations_nothing_is_known(num):
    found = solve_buoyancy(np.zeros((num, 3)), np.ones((num, 3)), np.zeros(num), 0.1, prior=(0.0, 0.0, 2.0))
    np.testing.assert_array_equal(found.vector, [0.0, 0.0, 2.0])
    assert np.isinf(found.covariance).all() and found.strength_deviation == math.inf and found.angle_deviation == math.pi


def test_one_observation_has_no_spread():
    found = solve_buoyancy(np.zeros((1, 3)), np.ones((1, 3)), np.ones(1), 1.0)
    np.testing.assert_array_equal(found.vector, [1.0, 1.0, 1.0])
    assert np.isinf(found.covariance).all()


def test_bad_input_is_refused():
    arrays = [np.zeros((2, 3)), np.zeros((2, 3)), np.ones(2)]
    with pytest.raises(ValueError, match="dt"):
        solve_buoyancy(*arrays, 0.0)
    with pytest.raises(ValueError, match="weights"):
        solve_buoyancy(arrays[0], arrays[1], np.array([1.0, -1.0]), 0.1)
    with pytest.raises(ValueError, match="NaN"):
        solve_buoyancy(np.full((2, 3), np.nan), arrays[1], arrays[2], 0.1)
    with pytest.raises(ValueError, match="shapes"):
        solve_buoyancy(np.zeros((3, 3)), arrays[1], arrays[2], 0.1)
