"""Particles that follow a volume."""

from __future__ import annotations

import numpy as np
import pytest

from backend.fit.follow import MOST_RATIO, Balance, drawn_level, drawn_near, points_on_rays
from backend.fit.guide import Guide
from backend.fit.state import VolumeRecord
from backend.geometry.camera import view_at
from backend.prior.window import stand_before
from synthetic.sweep import Orbit, orbit_cameras

VIEW = view_at(orbit_cameras(Orbit(), width=180, height=320, fps=15.0, num_frames=135), 40)
MIDDLE = np.array([0.5, -0.3, 8.0])
STAND = stand_before(VIEW, MIDDLE, voxel_size=0.5, shape=(24, 24, 40))
VOLUME = 0.5**3


def guide_of(centre: np.ndarray, size: float = 1.2) -> Guide:
    local = STAND.lattice.centres()
    places = (local - STAND.from_world[:3, 3]) @ STAND.from_world[:3, :3]
    density = np.exp(-0.5 * np.square((places - centre) / size).sum(axis=-1))
    velocity = np.zeros((*density.shape, 3), np.float32)
    return Guide(
        VolumeRecord(
            density=density.astype(np.float32), velocity=velocity, from_world=STAND.from_world, voxel_size=np.asarray(0.5)
        )
    )


def cloud(centre: np.ndarray, size: float, count: int = 40_000) -> np.ndarray:
    return centre + np.random.default_rng(2).normal(0, size, (count, 3))


def test_beside_the_grid_nobody_moves_or_grows() -> None:
    """A volume full to its walls lacks what is beside them, for that is not counted: it must not be asked for."""
    guide = guide_of(MIDDLE, size=20.0)
    corner = STAND.centres()[-1, -1, -1]
    outward = (corner - STAND.centres()[-2, -2, -2]) / 0.5  # voxels along each axis
    points = corner + 0.5 * np.array([[0.0], [1.5], [30.0]]) * outward
    masses = np.full(3, 1e-9)
    balance = Balance(guide, points, masses)
    assert balance.ratios()[0] == pytest.approx(MOST_RATIO)
    np.testing.assert_array_equal(balance.ratios()[1:], 1.0)
    np.testing.assert_array_equal(balance.displacement()[1:], 0.0)
    np.testing.assert_array_equal(drawn_level(guide, points, masses, np.ones(3, bool))[1:], masses[1:])


def test_the_volume_asks_for_what_particles_lack() -> None:
    guide = guide_of(MIDDLE)
    mass = float(guide.density.sum()) * VOLUME
    points = cloud(MIDDLE, 1.2)
    inside = np.linalg.norm(points - MIDDLE, axis=1) < 2.0
    enough = Balance(guide, points, np.full(40_000, mass / 40_000))
    assert abs(np.median(enough.ratios()[inside]) - 1.0) < 0.05
    half = Balance(guide, points, np.full(40_000, 0.5 * mass / 40_000))
    assert abs(np.median(half.ratios()[inside]) - 1.9) < 0.15
    assert Balance(guide, points, np.full(40_000, mass)).ratios().min() == pytest.approx(1 / MOST_RATIO)
    none = Balance(guide, np.zeros((0, 3)), np.zeros(0))
    assert len(none.ratios()) == len(none.displacement()) == 0


@pytest.mark.parametrize("shift", [(0.6, 0.0, 0.0), (0.0, -0.6, 0.0), (0.0, 0.0, 0.6), (0.4, 0.4, -0.4)])
def test_particles_flow_to_where_the_volume_is(shift: tuple[float, float, float]) -> None:
    """A cloud beside its volume: the mean displacement is the shift, in the world's axes; again and again it arrives."""
    guide = guide_of(MIDDLE + shift)
    points = cloud(MIDDLE, 1.2)
    masses = np.full(len(points), 1.0 / len(points))
    first = Balance(guide, points, masses).displacement()
    assert np.linalg.norm(first.mean(axis=0) - shift) < 0.4 * np.linalg.norm(shift)
    assert np.linalg.norm(first, axis=1).max() <= 0.5 + 1e-6
    for _ in range(8):
        points = points + 0.5 * Balance(guide, points, masses).displacement()
    assert np.linalg.norm(points.mean(axis=0) - MIDDLE - shift) < 0.1 * np.linalg.norm(shift)
    np.testing.assert_allclose(points.std(axis=0), 1.2, atol=0.12)


def test_a_cloud_in_its_volume_stays() -> None:
    points = cloud(MIDDLE, 1.2)
    moved = Balance(guide_of(MIDDLE), points, np.full(len(points), 3.0)).displacement()
    assert np.abs(moved.mean(axis=0)).max() < 0.02
    assert np.median(np.linalg.norm(moved, axis=1)) < 0.08


def test_who_is_not_led_stays_and_does_not_count() -> None:
    """A second cloud where the volume has nothing: led, it would be pulled over and thinned out."""
    guide = guide_of(MIDDLE)
    own, other = cloud(MIDDLE + np.array([0.6, 0.0, 0.0]), 1.2, 4000), cloud(MIDDLE - np.array([3.0, 0.0, 0.0]), 0.5, 1000)
    points, masses = np.concatenate([own, other]), np.full(5000, guide.density.sum() * VOLUME / 4000, np.float32)
    is_led = np.arange(5000) < 4000
    moved, heavier = drawn_near(guide, points, masses, is_led), drawn_level(guide, points, masses, is_led)
    np.testing.assert_array_equal(moved[~is_led], other)
    np.testing.assert_array_equal(heavier[~is_led], masses[~is_led])
    np.testing.assert_array_equal(moved[is_led], drawn_near(guide, own, masses[is_led], is_led[is_led]))
    np.testing.assert_array_equal(heavier[is_led], drawn_level(guide, own, masses[is_led], is_led[is_led]))
    assert np.abs(moved[is_led] - own).max() > 0.1
    assert heavier.dtype == np.float32
    all_led = np.ones(5000, bool)
    assert drawn_near(guide, points, masses, all_led)[~is_led, 0].mean() > other[:, 0].mean() + 0.05
    assert drawn_level(guide, points, masses, all_led)[~is_led].mean() < 0.5 * masses[0]


def test_no_smoke_moves_nobody() -> None:
    guide = guide_of(MIDDLE + 1000.0)
    points = cloud(MIDDLE, 1.2, 50)
    assert np.abs(Balance(guide, points, np.ones(50)).displacement()).max() == 0.0


def test_points_on_rays_take_the_volumes_depth() -> None:
    guide = guide_of(MIDDLE, 0.9)
    pixel, depth = VIEW.project(MIDDLE[None])
    pixels = np.repeat(pixel, 4000, axis=0)
    points = points_on_rays(guide, VIEW, pixels, np.zeros((4000, 3)), seed=3)
    again, depths = VIEW.project(points)
    np.testing.assert_allclose(again, pixels, atol=1e-6)
    assert abs(depths.mean() - depth[0]) < 0.03
    assert abs(depths.std() - 0.9) < 0.05
    corner = points_on_rays(guide, VIEW, np.zeros((1, 2)), np.full((1, 3), 7.0), seed=3)
    np.testing.assert_array_equal(corner, np.full((1, 3), 7.0))
    assert points_on_rays(guide, VIEW, np.zeros((0, 2)), np.zeros((0, 3)), seed=3).shape == (0, 3)
