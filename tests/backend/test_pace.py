"""How fast smoke moves, from its images."""

from __future__ import annotations

import cv2
import numpy as np
import pytest

from backend.fit.pace import longest_stride, stride_of
from backend.fit.region import Pictures, Region
from backend.geometry.camera import View, view_at
from synthetic.sweep import Orbit, orbit_cameras

CAMERAS = orbit_cameras(Orbit(), width=60, height=100, fps=15.0, num_frames=60)
VIEWS = tuple(view_at(CAMERAS, frame) for frame in range(60))
SOURCE = np.array([0.0, 0.0, 2.0])
VOXEL_SIZE = 0.4


def region(speed: float, views: tuple[View, ...] = VIEWS) -> Region:
    """Textured smoke that rises by `speed` m a frame."""
    noise = cv2.GaussianBlur(np.random.default_rng(0).random((400, 60), dtype=np.float32), (0, 0), 2.0)
    noise = np.clip((noise - noise.mean()) / noise.std() + 1.5, 0.0, 4.0)
    pixel = views[0].to_camera(SOURCE[None])[0, 2] / views[0].fx
    depths = []
    for frame in range(len(views)):
        shift = np.array([[1, 0, 0], [0, 1, -speed / pixel * frame - 100]], np.float32)
        depths.append(cv2.warpAffine(noise, shift, (60, 100)))
    return shown(np.stack(depths), views)


def shown(depths: np.ndarray, views: tuple[View, ...]) -> Region:
    pictures = Pictures(depths=depths, views=views)
    return Region(centre=SOURCE, source=SOURCE, voxel_size=VOXEL_SIZE, pictures=pictures, fineness=1.0, finer=pictures)


@pytest.mark.parametrize("speed", [0.05, 0.12, 0.3])
def test_smoke_moves_about_a_voxel_in_a_stride(speed: float) -> None:
    still = (VIEWS[0],) * 60
    found = stride_of(region(speed, still))
    assert abs(found - 0.9 * VOXEL_SIZE / speed) < 0.25 * VOXEL_SIZE / speed + 0.5


def test_what_stands_or_is_not_there_has_the_shortest_stride() -> None:
    still = (VIEWS[0],) * 60
    assert stride_of(shown(np.zeros((60, 100, 60), np.float32), still)) == 1
    assert stride_of(shown(np.ones((1, 100, 60), np.float32), still[:1])) == 1


@pytest.mark.parametrize(("num_frames", "longest"), [(1, 1), (15, 3), (30, 7), (120, 16)])
def test_a_clip_holds_some_strides(num_frames: int, longest: int) -> None:
    assert longest_stride(num_frames) == longest
