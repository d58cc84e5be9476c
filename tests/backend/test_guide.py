"""A volume that guides particles."""

from __future__ import annotations

import cv2
import numpy as np

from backend.fit.depth_prior import inflate, sample_points
from backend.fit.guide import Guide
from backend.fit.state import VolumeRecord
from backend.geometry.camera import view_at
from backend.prior.window import stand_before
from synthetic.sweep import Orbit, orbit_cameras

VIEW = view_at(orbit_cameras(Orbit(), width=180, height=320, fps=15.0, num_frames=135), 40)
MIDDLE = np.array([0.5, -0.3, 8.0])
STAND = stand_before(VIEW, MIDDLE, voxel_size=0.5, shape=(24, 24, 40))


def world_of(voxels: np.ndarray) -> np.ndarray:
    local = np.asarray(STAND.lattice.origin) + STAND.lattice.voxel_size * voxels
    return (local - STAND.from_world[:3, 3]) @ STAND.from_world[:3, :3]


def record(density: np.ndarray, velocity: np.ndarray | None = None) -> VolumeRecord:
    return VolumeRecord(
        density=density.astype(np.float32),
        velocity=np.zeros((*density.shape, 3), np.float32) if velocity is None else velocity.astype(np.float32),
        from_world=STAND.from_world,
        voxel_size=np.asarray(0.5),
    )


def blob(centre: np.ndarray, size: float = 1.2) -> np.ndarray:
    places = world_of(np.moveaxis(np.indices((24, 24, 40)), 0, -1).astype(float))
    return np.exp(-0.5 * np.square((places - centre) / size).sum(axis=-1))


def test_it_is_looked_up_in_the_world() -> None:
    centre = MIDDLE + np.array([0.7, -0.4, 1.1])
    guide = Guide(record(blob(centre)))
    points = centre + np.random.default_rng(0).normal(0, 0.8, (200, 3))
    wanted = np.exp(-0.5 * np.square((points - centre) / 1.2).sum(axis=1))
    np.testing.assert_allclose(guide.density_at(points), wanted, atol=0.05)
    assert guide.density_at(MIDDLE[None] + 100.0)[0] == 0.0
    np.testing.assert_allclose(guide.stand.voxels(MIDDLE[None])[0], (11.5, 11.5, 19.5), atol=1e-9)


def test_it_tells_the_middle_and_the_thickness_on_each_ray() -> None:
    centre = MIDDLE + np.array([0.0, 0.6, 1.0])
    density = blob(centre, 0.9)
    guide = Guide(record(np.where(density > 1e-3, density, 0.0)))
    tau = np.zeros((VIEW.height, VIEW.width), np.float32)
    pixel, depth = VIEW.project(centre[None])
    cv2.circle(tau, (int(pixel[0, 0]), int(pixel[0, 1])), 25, 1.0, -1)
    solid = inflate(tau, VIEW, MIDDLE)
    prior = guide.prior_of(VIEW, solid)
    row, column = int(pixel[0, 1]), int(pixel[0, 0])
    assert abs(prior.center_depth[row, column] - depth[0]) < 0.08
    assert abs(prior.half_thickness[row, column] - np.sqrt(6) * 0.9) < 0.25
    np.testing.assert_array_equal(prior.center_depth[:20], solid.center_depth[:20])  # no ray up there meets the volume
    points, pixels = sample_points(tau, 5000, prior, VIEW, seed=0)
    again, depths = VIEW.project(points)
    np.testing.assert_allclose(again, pixels, atol=1e-6)
    assert abs(depths.std() - 0.9) < 0.1


def test_what_it_carries_turns_with_the_flow() -> None:
    """Solid rotation about the grid's middle: a quarter of a turn in 60 steps keeps the distance."""
    places = world_of(np.moveaxis(np.indices((24, 24, 40)), 0, -1).astype(float)) - MIDDLE
    rate = 0.5 * np.pi
    velocity = np.stack([-rate * places[..., 1], rate * places[..., 0], 0 * places[..., 2]], axis=-1)
    guide = Guide(record(blob(MIDDLE), velocity))
    points = MIDDLE + np.array([[2.0, 0.0, 1.0]])
    for _ in range(60):
        points = guide.carried(points, guide, seconds=1 / 60)
    np.testing.assert_allclose(points[0], MIDDLE + np.array([0.0, 2.0, 1.0]), atol=5e-3)
