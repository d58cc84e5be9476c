"""Which way is up."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from backend.geometry.camera import View, view_at
from backend.geometry.upright import turned, up_of, upright
from synthetic.sweep import Orbit, orbit_cameras

Z = np.array([0.0, 0.0, 1.0])


def sweep(degrees: float) -> list[View]:
    cameras = orbit_cameras(Orbit(azimuth_stop=-105.0 + degrees), width=18, height=32, fps=15.0, num_frames=12)
    return [view_at(cameras, frame) for frame in range(12)]


def rotation(axis: list[float], degrees: float) -> np.ndarray:
    unit = np.array(axis) / np.linalg.norm(axis)
    skew = np.array([[0, -unit[2], unit[1]], [unit[2], 0, -unit[0]], [-unit[1], unit[0], 0]])
    angle, matrix = np.radians(degrees), np.eye(4)
    matrix[:3, :3] += np.sin(angle) * skew + (1 - np.cos(angle)) * skew @ skew
    return matrix


@pytest.mark.parametrize("degrees", [0.0, 20.0, 75.0, 120.0, 180.0])
def test_a_tilted_world_is_found_and_set_upright(degrees: float) -> None:
    tilt = rotation([1.0, 0.4, 0.1], degrees)
    views = [turned(view, tilt) for view in sweep(60.0)]
    up = up_of(views)
    np.testing.assert_allclose(up, tilt[:3, :3] @ Z, atol=1e-9)
    straight = upright(up)
    np.testing.assert_allclose(straight[:3, :3] @ up, Z, atol=1e-9)
    np.testing.assert_allclose(straight[:3, :3] @ straight[:3, :3].T, np.eye(3), atol=1e-9)
    np.testing.assert_allclose(up_of([turned(view, straight) for view in views]), Z, atol=1e-9)


def test_a_camera_that_hardly_turns_or_rolls_tells_nothing() -> None:
    tilt = rotation([1.0, 0.0, 0.0], 30.0)
    np.testing.assert_array_equal(up_of([turned(view, tilt) for view in sweep(0.0)[:1]]), Z)
    np.testing.assert_array_equal(up_of([turned(view, tilt) for view in sweep(2.0)]), Z)
    rolls = [rotation([0.0, 0.0, 1.0], 20.0 * (-1) ** frame) for frame in range(12)]
    rolling = [replace(view, camera_to_world=view.camera_to_world @ roll) for view, roll in zip(sweep(60.0), rolls, strict=True)]
    np.testing.assert_array_equal(up_of(rolling), Z)


def test_a_shaky_hand_is_forgiven() -> None:
    rng = np.random.default_rng(0)
    shaken = [turned(view, rotation(list(rng.normal(size=3)), 1.0)) for view in sweep(60.0)]
    assert up_of(shaken) @ Z > np.cos(np.radians(2.0))
