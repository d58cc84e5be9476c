"""Solids: distances and normals by hand and by finite differences, no particle inside, velocities that do not lead in."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from backend.physics.colliders import Box, HalfSpace, Sphere, deflect, push_out
from backend.physics.fluid import FluidState, derive_parameters, step

SOLIDS = [
    HalfSpace(point=(0.1, 0.0, 0.2), normal=(1.0, 2.0, 2.0)),
    Sphere(center=(0.1, 0.2, 0.3), radius=0.5),
    Box(low=(-0.3, -0.2, -0.1), high=(0.5, 0.4, 0.6)),
]


def test_hand_values():
    points = np.array([[0.0, 0.0, 0.0], [3.0, 0.0, 0.0]])
    np.testing.assert_allclose(HalfSpace(normal=(2.0, 0.0, 0.0)).distances(points)[0], [0.0, 3.0])
    np.testing.assert_allclose(Sphere(center=(1.0, 0.0, 0.0), radius=1.5).distances(points)[0], [-0.5, 0.5])
    distances, normals = Box(low=(-1.0, -2.0, -3.0), high=(1.0, 2.0, 3.0)).distances(points)
    np.testing.assert_allclose(distances, [-1.0, 2.0])
    np.testing.assert_allclose(normals, [[1.0, 0.0, 0.0], [1.0, 0.0, 0.0]])
    corner = Box(low=(-1.0, -1.0, -1.0), high=(1.0, 1.0, 1.0)).distances(np.array([[-2.0, 2.0, 2.0]]))
    assert corner[0][0] == pytest.approx(np.sqrt(3.0))
    np.testing.assert_allclose(corner[1][0], np.array([-1.0, 1.0, 1.0]) / np.sqrt(3.0))


@pytest.mark.parametrize("solid", SOLIDS, ids=lambda solid: type(solid).__name__)
def test_normals_are_the_gradient(solid):
    points = np.random.default_rng(0).uniform(-1.0, 1.0, (200, 3))
    distances, normals = solid.distances(points)
    np.testing.assert_allclose(np.linalg.norm(normals, axis=1), 1.0, rtol=1e-12)
    assert distances.min() < 0.0 < distances.max()
    slopes = [(solid.distances(points + shift)[0] - solid.distances(points - shift)[0]) / 2e-6 for shift in 1e-6 * np.eye(3)]
    is_smooth = np.abs(np.linalg.norm(slopes, axis=0) - 1.0) < 1e-4  # not across an edge of the box
    assert is_smooth.mean() > 0.95
    np.testing.assert_allclose(normals[is_smooth], np.transpose(slopes)[is_smooth], atol=1e-5)


@pytest.mark.parametrize("solid", SOLIDS, ids=lambda solid: type(solid).__name__)
def test_pushed_to_the_surface(solid):
    points = np.random.default_rng(1).uniform(-1.0, 1.0, (200, 3))
    outside = push_out(points, [solid])
    np.testing.assert_allclose(solid.distances(outside)[0], np.maximum(solid.distances(points)[0], 0.0), atol=1e-12)


def test_centres_have_a_way_out():
    for solid in (Sphere(center=(0.0, 0.0, 0.0), radius=1.0), Box(low=(-1.0, -1.0, -1.0), high=(1.0, 1.0, 1.0))):
        assert solid.distances(push_out(np.zeros((1, 3)), [solid]))[0][0] == pytest.approx(0.0, abs=1e-12)


def test_deflection_by_hand():
    ground = HalfSpace(friction=0.25)
    velocities = np.array([[1.0, 0.0, -2.0], [1.0, 0.0, 2.0], [1.0, 0.0, -2.0]])
    positions = np.array([[0.0, 0.0, 0.0], [0.0, 0.0, 0.0], [0.0, 0.0, 0.5]])
    expected = [[0.75, 0.0, 0.0], [1.0, 0.0, 2.0], [1.0, 0.0, -2.0]]
    np.testing.assert_allclose(deflect(velocities, positions, [ground], margin=1e-6), expected)


def test_fluid_stays_outside():
    random = np.random.default_rng(2)
    positions = random.random((200, 3)) + np.array([0.0, 0.0, 0.05])
    state = FluidState(
        positions=positions, velocities=np.zeros((200, 3)), masses=np.ones(200), ids=np.arange(200), born=np.zeros(200, np.int32)
    )
    ball = Sphere(center=(0.5, 0.5, 0.3), radius=0.2)
    parameters = replace(derive_parameters(positions), buoyancy=(0.0, 0.0, -9.8), colliders=(HalfSpace(), ball))
    for _ in range(60):
        state, _ = step(state, parameters, 0.04)
        assert HalfSpace().distances(state.positions)[0].min() > -1e-9
        assert ball.distances(state.positions)[0].min() > -0.02  # the ground had the first word, the ball the last
        assert np.isfinite(state.velocities).all()
    assert np.abs(state.velocities[:, 2]).mean() < 1.0


@pytest.mark.parametrize(
    "make",
    [
        lambda: HalfSpace(normal=(0.0, 0.0, 0.0)),
        lambda: HalfSpace(point=(np.nan, 0.0, 0.0)),
        lambda: Sphere(center=(0.0, 0.0, 0.0), radius=0.0),
        lambda: Box(low=(0.0, 0.0, 0.0), high=(1.0, 0.0, 1.0)),
        lambda: HalfSpace(friction=1.5),
    ],
)
def test_bad_solids_are_refused(make):
    with pytest.raises(ValueError):
        make()
