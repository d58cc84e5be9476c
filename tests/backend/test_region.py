"""The part of the world that a clip's smoke fills."""

from __future__ import annotations

import cv2
import numpy as np
import pytest

from backend.fit.region import CELLS_HIGH, FINER, PIXELS_A_CELL, find_region
from backend.fit.scene import Scene
from backend.geometry.camera import view_at
from synthetic.sweep import Orbit, orbit_cameras

ORBIT = Orbit(target=(0.0, 0.0, 8.0), distance=32.0, half_height=10.0, elevation=0.0)
CAMERAS = orbit_cameras(ORBIT, width=120, height=200, fps=15.0, num_frames=20)
VIEWS = tuple(view_at(CAMERAS, frame) for frame in range(20))
SOURCE = np.array([0.0, 0.0, 2.0])


def layers(low: float, high: float, drift: tuple[float, float]) -> list[np.ndarray]:
    """A column of balls from `low` to `high` m that leans towards drift at its top."""
    found = []
    for view in VIEWS:
        opacity = np.zeros((200, 120), np.float32)
        for share in np.linspace(0, 1, 30):
            point = np.array([drift[0] * share, drift[1] * share, low + share * (high - low)])
            pixel, _ = view.project(point[None])
            cv2.circle(opacity, (int(pixel[0, 0]), int(pixel[0, 1])), 7, 0.6, -1)
        found.append(np.repeat(opacity[..., None], 4, axis=2))
    return found


def test_the_grid_is_as_high_as_the_smoke_and_stands_in_its_middle() -> None:
    region = find_region(layers(2.0, 14.0, (3.0, -2.0)), Scene(views=VIEWS, seconds_per_frame=1 / 15, anchor=SOURCE))
    assert region is not None
    assert abs(region.centre[2] - 8.0) < 0.4
    assert np.abs(region.centre[:2] - (1.5, -1.0)).max() < 0.7  # drawn to the source a little
    assert abs(region.voxel_size - 13.4 / CELLS_HIGH) < 0.04
    metres_a_pixel = 32.0 / region.pictures.views[0].fx
    assert abs(region.voxel_size / metres_a_pixel - PIXELS_A_CELL) < 0.1
    assert region.pictures.depths.shape == (20, region.pictures.views[0].height, region.pictures.views[0].width)


def test_what_proposals_are_compared_with_is_finer_where_the_clip_is() -> None:
    region = find_region(layers(2.0, 14.0, (3.0, -2.0)), Scene(views=VIEWS, seconds_per_frame=1 / 15, anchor=SOURCE))
    assert region is not None
    assert region.finer.depths.shape == (20, region.finer.views[0].height, region.finer.views[0].width)
    finer = min(FINER, VIEWS[0].height / region.pictures.views[0].height)
    assert region.finer.views[0].height == pytest.approx(finer * region.pictures.views[0].height, abs=1)
    assert region.finer.depths.mean() == pytest.approx(region.pictures.depths.mean(), rel=0.02)


def test_nothing_is_nowhere() -> None:
    empty = [np.zeros((200, 120, 4), np.float32)] * 20
    assert find_region(empty, Scene(views=VIEWS, seconds_per_frame=1 / 15, anchor=SOURCE)) is None


def test_frames_without_smoke_do_not_count() -> None:
    frames = layers(2.0, 14.0, (3.0, -2.0))
    scene = Scene(views=VIEWS, seconds_per_frame=1 / 15, anchor=SOURCE)
    whole = find_region(frames, scene)
    frames[3] = np.zeros_like(frames[3])
    part = find_region(frames, scene)
    assert whole is not None
    assert part is not None
    assert abs(part.voxel_size - whole.voxel_size) < 0.05
    assert np.abs(part.centre - whole.centre).max() < 0.3
