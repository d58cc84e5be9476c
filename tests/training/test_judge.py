"""The judge of volumes knows a right one from one that is not."""

from __future__ import annotations

import math
from pathlib import Path

import numpy as np
import pytest
from made_plumes import grid, made_plume, true_gaussians

from backend.fit.state import VolumeRecord
from backend.geometry.camera import view_at
from backend.prior.window import SHAPE, stand_before
from synthetic.sweep import Orbit, orbit_cameras
from training.judge import film, judge, judge_particles, levels_off
from training.library import FPS, NUM_FRAMES, VELOCITY_EVERY, Plume
from training.samples import truth
from training.train import held_back

CELL = 0.5  # m


@pytest.fixture(scope="module")
def column() -> Plume:
    """Smoke that leans to one side and swirls."""
    x, y, z = grid()
    density = 120 * np.exp(-((x - 18 - 0.1 * z) ** 2 + (y - 18) ** 2) / 12)
    return made_plume(density, np.stack([np.sin(0.3 * z), np.cos(0.3 * z), 1.0 + 0.1 * x], axis=-1))


def records(of: Plume, *, shift: int) -> list[VolumeRecord]:
    """The true volumes, moved away from the camera by some voxels."""
    cameras = orbit_cameras(Orbit(), width=90, height=160, fps=FPS, num_frames=NUM_FRAMES)
    found = []
    for frame in range(0, 120, 2 * VELOCITY_EVERY):
        stand = stand_before(view_at(cameras, frame), np.array([0.5, 0.0, 10.0]), voxel_size=CELL, shape=SHAPE)
        density, velocity = truth(of, frame, stand)
        record = VolumeRecord(
            density=np.roll(density, shift, axis=1),
            velocity=(velocity @ stand.from_world[:3, :3]).astype(np.float32),
            from_world=stand.from_world,
            voxel_size=np.asarray(CELL),
        )
        found += [record] * (2 * VELOCITY_EVERY)
    return found


def test_the_truth_is_right(column: Plume) -> None:
    scores = judge(column, records(column, shift=0))
    assert scores["level_m"] < 1e-3
    assert min(scores[name] for name in ("density", "sideways", "depth", "up")) > 0.999
    assert min(scores["nvs_last_db"], scores["side_db"]) > 35.0  # half a metre a voxel


def test_smoke_too_far_away_is_told_by_how_far(column: Plume) -> None:
    right, moved = (judge(column, records(column, shift=shift)) for shift in (0, 2))
    assert moved["level_m"] == pytest.approx(2 * CELL, abs=0.02)
    assert moved["density"] < 0.8 * right["density"]
    assert moved["side_db"] < right["side_db"] - 10.0
    assert moved["nvs_last_db"] < right["nvs_last_db"] - 5.0
    assert moved["sideways"] == right["sideways"]


def test_particles_are_judged_as_volumes_are(column: Plume) -> None:
    _, cameras = film(column, np.random.default_rng(0))
    right, moved = (judge_particles(column, cameras, true_gaussians(column, shift=shift)) for shift in (0.0, 1.0))
    assert min(right[name] for name in ("density", "sideways", "depth", "up")) > 0.97
    assert min(right["nvs_last_db"], right["side_db"]) > 33.0
    assert moved["density"] < 0.8 * right["density"]
    assert moved["nvs_last_db"] < right["nvs_last_db"] - 5.0
    assert set(right) == set(judge(column, records(column, shift=0))) - {"level_m"}


def test_levels_of_nothing_are_nowhere() -> None:
    assert math.isnan(levels_off(np.zeros((2, 2, 2)), np.ones((2, 2, 2))))


def test_a_film_has_what_a_fit_is_given(column: Plume) -> None:
    layers, cameras = film(column, np.random.default_rng(0))
    assert len(layers) == len(cameras.camera_to_world) == 120
    assert layers[0].shape == (160, 90, 4)
    assert layers[0][..., 3].max() > 0.5
    assert layers[0][..., 3].max() < 1.0


def test_every_tenth_plume_is_held_back() -> None:
    assert held_back([Path(str(number)) for number in range(30)]) == [Path("5"), Path("15"), Path("25")]
