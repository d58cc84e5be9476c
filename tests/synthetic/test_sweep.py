"""The benchmark's cameras, presets and plan of images."""

from __future__ import annotations

import math

import numpy as np
import pytest

from backend.contract.cameras import parse_cameras
from backend.geometry.camera import view_at
from synthetic.layers import Layer
from synthetic.plan import first_frames, plan_images, view_cameras
from synthetic.presets import PRESETS
from synthetic.sweep import Orbit, look_at, orbit_cameras, still_cameras


def azimuth(matrix: object, target: tuple[float, float, float]) -> float:
    position = np.array(matrix)[:3, 3] - target
    return math.degrees(math.atan2(position[1], position[0]))


def test_a_camera_by_hand() -> None:
    """From -y, looking along +y: right is +x, down is -z."""
    matrix = np.array(look_at((0.0, -10.0, 2.0), (0.0, 0.0, 2.0)))
    np.testing.assert_allclose(matrix[:3, :3], [[1, 0, 0], [0, 0, 1], [0, -1, 0]], atol=1e-12)
    with pytest.raises(ValueError, match="straight"):
        look_at((0, 0, 5), (0, 0, 0))


@pytest.mark.parametrize("name", ["paper", "bench", "tiny"])
def test_the_sweep_is_the_published_one(name: str) -> None:
    """phi(t) = -105 + 60 t / T', pitch 10 degrees (supplement 7.1), and the target in the middle of every image."""
    preset = PRESETS[name]
    cameras = view_cameras(preset)["input"]
    count = preset.num_frames
    assert len(cameras.camera_to_world) == count
    for frame in (0, count // 2, count - 1):
        assert azimuth(cameras.at(frame), preset.orbit.target) == pytest.approx(-105 + 60 * frame / count)
        position = np.array(cameras.at(frame))[:3, 3] - preset.orbit.target
        assert math.degrees(math.asin(position[2] / np.linalg.norm(position))) == pytest.approx(10)
        pixel, depth = view_at(cameras, frame).project(np.array([preset.orbit.target]))
        np.testing.assert_allclose(pixel[0], [preset.width / 2, preset.height / 2], atol=1e-9)
        assert depth[0] == pytest.approx(preset.orbit.distance)


def test_half_height_is_what_is_seen_above_the_target() -> None:
    orbit = Orbit(target=(1.0, 2.0, 3.0), distance=20.0, half_height=5.0, elevation=0.0)
    cameras = orbit_cameras(orbit, width=100, height=200, fps=1, num_frames=4)
    pixel, _ = view_at(cameras, 1).project(np.array([[1.0, 2.0, 8.0]]))
    np.testing.assert_allclose(pixel[0], [50, 0], atol=1e-9)


def test_presets_hold_the_published_numbers() -> None:
    paper, bench = PRESETS["paper"], PRESETS["bench"]
    assert (paper.width, paper.height, paper.num_frames, paper.num_future) == (1080, 1920, 270, 30)
    assert paper.quality.samples <= 200
    assert (bench.width, bench.height, bench.num_frames) == (180, 320, 135)
    for preset in (paper, bench):
        assert preset.num_future * 9 == preset.num_frames
        assert preset.num_frames / preset.fps == pytest.approx(9.0)


def test_test_views_stand_where_they_should() -> None:
    preset = PRESETS["tiny"]
    cameras = view_cameras(preset)
    first = cameras["input"].at(0)
    assert cameras["nvs"].is_still
    np.testing.assert_allclose(cameras["nvs"].at(0), first)
    assert azimuth(cameras["side"].at(0), preset.orbit.target) == pytest.approx(15)
    assert azimuth(cameras["back"].at(0), preset.orbit.target) == pytest.approx(75)
    still = still_cameras(preset.orbit, turned=360.0, width=46, height=80, fps=4)
    np.testing.assert_allclose(still.at(0), first, atol=1e-12)
    for view in cameras.values():
        assert parse_cameras(view.to_json()) == view


def test_the_plan_names_every_image_once_and_leaks_nothing() -> None:
    preset = PRESETS["bench"]
    images = plan_images(preset)
    paths = [str(image.path) for image in images]
    assert len(set(paths)) == len(paths)
    readable = [image for image in images if image.path.parts[0] == "input"]
    assert len(readable) == 120
    assert all(image.layer is Layer.CLIP and image.view == "input" and image.frame < 120 for image in readable)
    assert all(image.path.parts[0] == "truth" for image in images if image not in readable)
    assert sum(image.layer is Layer.SMOKE for image in images) == 4 * 135
    assert sum(image.layer is Layer.DEPTH for image in images) == 135 + 3


def test_the_first_frames_are_first_middle_last() -> None:
    assert first_frames(0, 135) == (0, 67, 134)
    assert first_frames(7, 9) == (7, 8)
    assert first_frames(7, 8) == (7,)
