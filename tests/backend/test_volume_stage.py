"""The stage that asks the prior: upright worlds, resume, nothing to see."""

from __future__ import annotations

import io
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest
import torch

from backend.contract.cameras import Cameras
from backend.fit.guide import Guide
from backend.geometry.camera import view_at
from backend.prior.network import PlumeNet
from backend.prior.predict import Prior, save_weights
from backend.reporting import SilentReport
from backend.stages import volume
from synthetic.sweep import Orbit, orbit_cameras

NUM_FRAMES = 6
ORBIT = Orbit(azimuth_stop=-85.0)
CAMERAS = orbit_cameras(ORBIT, width=72, height=128, fps=15.0, num_frames=NUM_FRAMES)


@pytest.fixture(scope="module")
def prior(tmp_path_factory: pytest.TempPathFactory) -> Prior:
    """Of random weights: what is tested here is what stands around it."""
    torch.manual_seed(1)
    net = PlumeNet((16, 16, 16))
    for part in (net.first, net.second):
        torch.nn.init.normal_(part.exit.weight, std=0.2)
    file = io.BytesIO()
    save_weights(net, file)
    path: Path = tmp_path_factory.mktemp("prior") / "weights.npz"
    path.write_bytes(file.getvalue())
    return Prior(path)


def layers() -> list[np.ndarray]:
    """A column of puffs that rises."""
    found = []
    for frame in range(NUM_FRAMES):
        opacity = np.zeros((128, 72), np.float32)
        for height in np.linspace(2.0, 14.0, 20):
            pixel, _ = view_at(CAMERAS, frame).project(np.array([[0.1 * height, 0.0, height + 0.1 * frame]]))
            cv2.circle(opacity, (int(pixel[0, 0]), int(pixel[0, 1])), 6, 0.5, -1)
        opacity = cv2.GaussianBlur(opacity, (0, 0), 2.0)
        found.append(np.repeat(opacity[..., None], 4, axis=2))
    return found


def tilted(cameras: Cameras, tilt: np.ndarray) -> Cameras:
    matrices = [tilt @ np.array(matrix) for matrix in cameras.camera_to_world]
    return replace(cameras, camera_to_world=tuple(tuple(tuple(float(x) for x in row) for row in matrix) for matrix in matrices))


def test_a_tilted_world_gets_the_same_answer_tilted(prior: Prior) -> None:
    angle = np.radians(25.0)
    tilt = np.eye(4)
    tilt[1:3, 1:3] = [[np.cos(angle), -np.sin(angle)], [np.sin(angle), np.cos(angle)]]
    upright = list(volume.run(layers(), CAMERAS, SilentReport(), prior=prior, done=[]))
    leaning = list(volume.run(layers(), tilted(CAMERAS, tilt), SilentReport(), prior=prior, done=[]))
    points = np.random.default_rng(0).normal((0.5, 0.0, 8.0), 2.0, (300, 3))
    for a, b in zip(upright, leaning, strict=True):
        wanted, found = Guide(a), Guide(b)
        moved = points @ tilt[:3, :3].T
        largest = wanted.density.max()
        np.testing.assert_allclose(found.density_at(moved), wanted.density_at(points), atol=0.02 * largest)
        np.testing.assert_allclose(found.velocity_at(moved), wanted.velocity_at(points) @ tilt[:3, :3].T, atol=0.05)


def test_it_goes_on_behind_what_is_done(prior: Prior) -> None:
    whole = list(volume.run(layers(), CAMERAS, SilentReport(), prior=prior, done=[], stride=2))
    rest = list(volume.run(layers(), CAMERAS, SilentReport(), prior=prior, done=whole[:4], stride=2))
    assert len(whole) == NUM_FRAMES
    assert len(rest) == 2
    for a, b in zip(whole[4:], rest, strict=True):
        assert a.density.tobytes() == b.density.tobytes()
        assert a.velocity.tobytes() == b.velocity.tobytes()


def test_a_clip_without_smoke_has_no_volumes(prior: Prior) -> None:
    empty = [np.zeros((128, 72, 4), np.float32)] * NUM_FRAMES
    assert list(volume.run(empty, CAMERAS, SilentReport(), prior=prior, done=[])) == []
