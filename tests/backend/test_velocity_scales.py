"""What tells how right motion is by the size of eddies, on fields of which that is known."""

from __future__ import annotations

import numpy as np
import pytest

from backend.geometry.camera import View, view_at
from backend.score.truth_set import Volume
from benchmarks.velocity_scales import AXES, blurred, means_of_rays, moment
from synthetic.sweep import Orbit, still_cameras

VOXEL = 0.25
SHAPE = (32, 32, 36)


def camera() -> View:
    return view_at(still_cameras(Orbit(), turned=0.0, width=90, height=160, fps=15.0), 0)


def smoke(velocity: np.ndarray) -> Volume:
    density = np.zeros(SHAPE, np.float32)
    density[2:30, 3:29, 2:34] = 1.0
    origin = np.array([-2.0, -2.2, 3.0])
    return Volume(density=density, velocity=velocity.astype(np.float32), voxel_size=VOXEL, origin=origin)


def large_and_small() -> tuple[np.ndarray, np.ndarray]:
    """[X, Y, Z, 3] each: waves of 4 m, and noise from voxel to voxel."""
    x, y, z = VOXEL * np.indices(SHAPE)
    large = np.stack([np.sin(1.5 * z + phase) + np.cos(1.5 * x + phase) + np.sin(1.5 * y) for phase in (0.0, 1.0, 2.0)], axis=-1)
    return large, np.random.default_rng(3).normal(size=(*SHAPE, 3))


def test_who_knows_large_eddies_alone_is_right_once_small_ones_are_forgotten() -> None:
    large, small = large_and_small()
    found = moment(large, smoke(large + small), camera())
    sharp, soft = found["ours, 0"], found["ours, 0.5"]
    assert (sharp < 0.85).all() and (soft > 0.95).all()


def test_who_knows_small_eddies_alone_is_wrong_once_they_are_forgotten() -> None:
    large, small = large_and_small()
    found = moment(small, smoke(large + small), camera())
    assert (found["ours, 0"] > 0.4).all() and (np.abs(found["ours, 0.5"]) < 0.3).all()


def test_the_truth_itself_is_right_at_every_blur_and_loses_by_its_own() -> None:
    large, small = large_and_small()
    found = moment(large + small, smoke(large + small), camera())
    for blur in ("0", "0.25", "0.5", "1"):
        np.testing.assert_allclose(found[f"ours, {blur}"], 1.0, atol=1e-6)
    losses = [found[f"sharpness, {blur}"][AXES.index("up")] for blur in ("0", "0.25", "0.5")]
    assert losses[0] == pytest.approx(1.0) and losses[0] > losses[1] > losses[2]


def test_smoke_that_moves_alike_stays_so_at_its_border() -> None:
    inside = smoke(np.zeros((*SHAPE, 3))).density > 0
    even = np.where(inside[..., None], [1.0, -2.0, 3.0], 100.0)
    np.testing.assert_allclose(blurred(even, inside, 2.0)[inside], np.broadcast_to([1.0, -2.0, 3.0], (inside.sum(), 3)))


def test_rays_know_what_is_across_them_and_nothing_of_what_is_along() -> None:
    view = camera()
    rows, columns, steps = (part.ravel() for part in np.indices((30, 20, 40)))
    points = view.unproject(np.stack([columns + 35.3, rows + 60.3], axis=1), 11.0 + 0.1 * steps)
    across, along = np.sin(0.7 * columns), np.where(steps % 2 == 0, 1.0, -1.0)
    found = means_of_rays(np.stack([across, along, across + along], axis=1), points, view, 0.9 * 11.0 / view.fx)
    np.testing.assert_allclose(found[:, 0], across, atol=1e-9)
    np.testing.assert_allclose(found[:, 1], 0.0, atol=1e-9)
    np.testing.assert_allclose(found[:, 2], across, atol=1e-9)
