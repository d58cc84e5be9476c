"""Colours as another side knows them."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest
from particles_of import particles

from backend.geometry.camera import View
from backend.io.particles import ParticleFrame
from backend.render.evening import REACH, evened


def smoke(positions: np.ndarray, brightness: np.ndarray) -> ParticleFrame:
    return particles(positions, np.outer(brightness, [1.0, 0.5, 0.25]))


def speckled(count: int = 4000) -> ParticleFrame:
    """A ball of smoke, bright to one side, every particle brighter or darker than that by chance."""
    draw = np.random.default_rng(3)
    positions = draw.normal(0.0, 1.0, (count, 3))
    return smoke(positions, np.clip(0.5 + 0.05 * positions[:, 2], 0.2, 0.8) + draw.choice([-0.1, 0.1], count))


def camera(degrees: float, *, distance: float = 20.0) -> View:
    """Looks at the origin; only its place counts."""
    matrix = np.eye(4)
    angle = math.radians(degrees)
    matrix[:3, 3] = distance * math.cos(angle), distance * math.sin(angle), 0.0
    return View(width=40, height=30, fx=50.0, fy=50.0, cx=20.0, cy=15.0, camera_to_world=matrix)


def test_where_it_was_filmed_and_behind_it_all_holds() -> None:
    frame = speckled()
    assert evened(frame, camera(30.0), filmed=camera(30.0)) is frame
    shift = np.average(frame.positions, axis=0, weights=frame.optical_masses)
    centred = replace(frame, positions=frame.positions - shift)
    assert evened(centred, camera(180.0, distance=7.0), filmed=camera(0.0)) is centred


def test_from_aside_what_neighbours_do_not_share_is_gone_and_what_they_share_stays() -> None:
    frame = speckled()
    found = evened(frame, camera(90.0), filmed=camera(0.0)).colors[:, 0]
    shared = 0.5 + 0.05 * frame.positions[:, 2]
    inner = np.linalg.norm(frame.positions, axis=1) < 1.5
    off_before, off_after = (np.std((colors - shared)[inner]) for colors in (frame.colors[:, 0], found))
    assert off_before == pytest.approx(0.1, abs=0.01)
    assert off_after < 0.25 * off_before
    assert np.corrcoef(found[inner], shared[inner])[0, 1] > 0.9
    assert found.mean() == pytest.approx(frame.colors[:, 0].mean(), rel=0.01)


def test_the_share_that_is_kept_goes_with_the_angle() -> None:
    frame = speckled()
    own, aside = frame.colors, evened(frame, camera(90.0), filmed=camera(0.0)).colors
    between = evened(frame, camera(45.0), filmed=camera(0.0)).colors
    np.testing.assert_allclose(between, 0.25 * own + 0.75 * aside, atol=2e-3)  # cos^4 of 45 degrees, seen from near by
    np.testing.assert_array_equal(between, evened(frame, camera(45.0), filmed=camera(0.0)).colors)


def test_two_particles_by_hand() -> None:
    """As far apart as the reach: each other's weight is exp(-1/2) of the own, on the grid to a hundredth or two."""
    apart = 1.0
    deep = apart / REACH  # of two thick slabs beside them, too far away to be neighbours, that set the spread
    far = np.array([[deep, 50.0, 0.0], [-deep, 50.0, 0.0]])
    frame = smoke(np.concatenate([[[0.0, 0.0, 0.0], [0.0, apart, 0.0]], far]), np.array([1.0, 0.0, 0.0, 0.0]))
    frame.optical_masses[2:] = 1000.0
    found = evened(frame, camera(90.0, distance=1e6), filmed=camera(0.0, distance=1e6)).colors[:2, 0]
    weight = math.exp(-0.5)
    np.testing.assert_allclose(found, [1.0 / (1.0 + weight), weight / (1.0 + weight)], atol=0.03)


def test_no_smoke_one_particle_and_a_flat_sheet_stay_as_they_are() -> None:
    views = {"view": camera(90.0), "filmed": camera(0.0)}
    nothing = smoke(np.zeros((0, 3)), np.zeros(0))
    assert evened(nothing, **views) is nothing
    one = smoke(np.zeros((1, 3)), np.ones(1))
    assert evened(one, **views) is one
    massless = replace(speckled(10), optical_masses=np.zeros(10, np.float32))
    assert evened(massless, **views) is massless


def test_smoke_that_is_far_apart_costs_no_more_memory_and_stays_finite() -> None:
    draw = np.random.default_rng(0)
    positions = draw.normal(0.0, 1.0, (200, 3)) + np.array([0.0, 1.0, 0.0]) * draw.choice([0.0, 1e6], (200, 1))
    found = evened(smoke(positions, draw.uniform(size=200)), camera(90.0, distance=1e7), filmed=camera(0.0, distance=1e7))
    assert np.isfinite(found.colors).all()
    assert found.colors.min() >= 0.0
