"""The camera of every frame: a still one by hand, given ones cut, scaled and refused."""

from __future__ import annotations

import dataclasses
import math

import numpy as np
import pytest

from backend.contract.cameras import Cameras, parse_cameras
from backend.contract.errors import BackendError
from backend.contract.job import CamerasConfig
from backend.fit.stabilise import ImageMotion
from backend.geometry.camera import view_at
from backend.reporting import SilentReport
from backend.stages import cameras

STILL = ImageMotion(frames=(0,), to_first=np.eye(3)[None], num_tracks=50, displacement=0.0, parallax=0.0)
MOVING = dataclasses.replace(STILL, displacement=0.1)


def solve(config=None, given=None, motion=STILL, **changes) -> tuple[Cameras, SilentReport]:
    report = SilentReport()
    arguments = {"num_frames": 10, "frame_start": 0, "size": (320, 180), "fps": 24.0} | changes
    solved = cameras.run(**arguments, config=config or CamerasConfig(), given=given, motion=lambda: motion, report=report)
    return solved, report


def moving(num: int, width: int = 1920, height: int = 1080) -> Cameras:
    """Cameras that step 1 m along x a frame."""
    matrices = []
    for k in range(num):
        matrix = np.array(cameras.still_camera((width, height), 24.0, CamerasConfig()).camera_to_world[0])
        matrix[0, 3] = k
        matrices.append(tuple(map(tuple, matrix.tolist())))
    return Cameras(
        width=width, height=height, fx=1500.0, fy=1500.0, cx=960.0, cy=540.0, fps=24.0, camera_to_world=tuple(matrices)
    )


def test_still_camera_by_hand() -> None:
    """Looks along +y at the origin from 10 m; a metre to the right and up of it is right and up in the picture."""
    solved, report = solve()
    assert report.warnings == [] and solved.is_still
    assert solved.fx == solved.fy == pytest.approx(160 / math.tan(math.radians(20.0)))
    pixels, depth = view_at(solved, 0).project(np.array([[0.0, 0, 0], [1, 0, 0], [0, 0, 1], [0, 1, 0]]))
    assert depth == pytest.approx([10, 10, 10, 11])
    step = solved.fx / 10.0
    assert pixels == pytest.approx(np.array([[160, 90], [160 + step, 90], [160, 90 - step], [160, 90]]))


@pytest.mark.parametrize("elevation", [-60.0, 0.0, 30.0, 89.0])
def test_elevation_looks_down_at_the_origin(elevation) -> None:
    solved, _ = solve(CamerasConfig(elevation_deg=elevation, distance_m=4.0))
    view = view_at(solved, 0)
    assert view.position == pytest.approx([0, -4 * math.cos(math.radians(elevation)), 4 * math.sin(math.radians(elevation))])
    pixels, depth = view.project(np.array([[0.0, 0, 0], [0, 0, 0.1]]))
    assert pixels[0] == pytest.approx([160, 90]) and depth[0] == pytest.approx(4.0)
    assert pixels[1, 1] < 90.0  # up stays up
    rotation = view.camera_to_world[:3, :3]
    assert np.allclose(rotation.T @ rotation, np.eye(3)) and np.linalg.det(rotation) == pytest.approx(1.0)
    assert parse_cameras(solved.to_json()).camera_to_world == solved.camera_to_world


def test_field_of_view_is_of_the_longer_side() -> None:
    tall, _ = solve(size=(180, 320))
    wide, _ = solve()
    assert tall.fx == wide.fx


def test_moving_camera_is_treated_as_still_and_says_so() -> None:
    solved, report = solve(motion=MOVING)
    assert solved.is_still and [code for code, _ in report.warnings] == ["camera_moves"]
    assert "cameras.json" in report.warnings[0][1]

    def unused() -> ImageMotion:
        raise AssertionError("nothing to measure when the settings decide")

    report = SilentReport()
    config = CamerasConfig(mode="still")
    cameras.run(num_frames=3, size=(320, 180), fps=24.0, config=config, given=None, motion=unused, report=report)
    assert report.warnings == []


def test_given_cameras_are_scaled_to_the_picture() -> None:
    solved, report = solve(given=moving(10))
    assert report.warnings == [] and len(solved.camera_to_world) == 10
    point = np.array([[0.4, 0.2, 0.3]])
    before, after = (view_at(c, 3).project(point)[0] for c in (moving(10), solved))
    assert after == pytest.approx(before / 6.0)


def test_given_cameras_are_those_of_the_fitted_frames() -> None:
    """Of a whole clip's cameras those from frame A on, with the later ones for a forecast; of exactly B - A all."""
    solved, _ = solve(given=moving(40), frame_start=5)
    assert solved.at(0)[0][3] == 5.0 and len(solved.camera_to_world) == 35
    solved, _ = solve(given=moving(10), frame_start=5)
    assert solved.at(0)[0][3] == 0.0
    one, _ = solve(given=moving(1), frame_start=5)
    assert one.is_still


def refused(**arguments) -> str:
    with pytest.raises(BackendError) as caught:
        solve(**arguments)
    return caught.value.code


def test_given_cameras_that_do_not_fit() -> None:
    assert refused(given=moving(12), frame_start=5) == "cameras_too_few"
    assert refused(given=moving(10, 1440, 1080)) == "cameras_aspect"
    assert refused(config=CamerasConfig(mode="given")) == "cameras_missing"
    _, report = solve(given=dataclasses.replace(moving(10), fps=30.0))
    assert [code for code, _ in report.warnings] == ["cameras_fps"]
    solved, report = solve(config=CamerasConfig(mode="still"), given=moving(10))
    assert solved.is_still and [code for code, _ in report.warnings] == ["cameras_ignored"]


@pytest.mark.parametrize("is_moving", [True, False])
def test_smoke_does_not_pass_for_a_moving_camera(is_moving) -> None:
    """Contrasty smoke rises over a faint still background; with the camera moving, the background moves too."""
    rng = np.random.default_rng(0)
    background = (0.3 + 0.02 * rng.random((140, 240, 3))).astype(np.float32)
    rising = rng.random((400, 60, 3)).astype(np.float32)
    frames, layers = [], []
    for k in range(8):
        shift = 3 * k * is_moving
        image = background[10:110, 10 + shift : 170 + shift].copy()
        image[20:80, 50:110] = rising[5 * k : 5 * k + 60]
        layer = np.zeros((100, 160, 4), np.float32)
        layer[20:80, 50:110, 3] = 1.0
        frames.append(image)
        layers.append(layer)
    assert cameras.measure_motion(frames, SilentReport(), smoke=layers).is_still != is_moving
