"""Fits of a still camera are judged at the smoke's true distance."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from true_gaussians import true_gaussians

from backend.fit.state import particle_frame
from backend.geometry.camera import view_at
from backend.render.picture import picture
from training import judge_still
from training.judge import SEEN
from training.library import NUM_FRAMES, VELOCITY_EVERY, VOXEL_SIZE, Plume
from training.plumes import SIZE, plume

VIEW = view_at(judge_still.standing(0.0), 0)


@pytest.fixture(scope="module")
def ball() -> Plume:
    shape = tuple(round(size / VOXEL_SIZE) for size in SIZE)
    x, y, z = np.meshgrid(*(np.arange(size) for size in shape), indexing="ij")
    density = (120 * np.exp(-((x - 18) ** 2 + (y - 20) ** 2 + (z - 25) ** 2) / 12)).astype(np.uint8)
    still = np.zeros((*shape, 3), np.float16)
    return Plume(
        scene=plume(3),
        density=np.broadcast_to(density, (NUM_FRAMES, *shape)),
        velocity=np.broadcast_to(still, (NUM_FRAMES // VELOCITY_EVERY + 1, *still.shape)),
        origin=(-5.83, -5.83, 0.17),
    )


@pytest.mark.parametrize("factor", [0.7, 1.0, 1.2])
def test_smoke_that_is_too_near_is_known_and_made_larger(ball: Plume, factor: float) -> None:
    right = true_gaussians(ball, shift=0.0)[0]
    wrong = judge_still.made_larger(right, VIEW, 1 / factor)
    assert judge_still.distance_error(ball, [wrong] * SEEN, VIEW) == pytest.approx(factor, rel=1e-3)
    pictures = [picture(particle_frame(record), VIEW) for record in (right, wrong)]
    assert np.abs(pictures[0] - pictures[1]).max() < 0.02, "before the camera they are the same"
    placed = judge_still.made_larger(wrong, VIEW, factor)
    np.testing.assert_allclose(placed.positions, right.positions, atol=1e-9)
    np.testing.assert_allclose(placed.optical_masses, right.optical_masses, rtol=1e-5)


def test_a_fit_without_smoke_stays_where_it_is(ball: Plume) -> None:
    right = true_gaussians(ball, shift=0.0)[0]
    nothing = replace(right, optical_masses=np.zeros_like(right.optical_masses))
    assert judge_still.distance_error(ball, [nothing] * SEEN, VIEW) == 1.0


def test_it_is_looked_at_from_the_side_and_from_behind() -> None:
    views = judge_still.views_around(0)
    assert set(views) == {"turned_30_db", "side_db", "back_db"}
    ahead = {name: float(view.camera_to_world[:3, 2] @ VIEW.camera_to_world[:3, 2]) for name, view in views.items()}
    assert ahead["turned_30_db"] > 0.8 and abs(ahead["side_db"]) < 0.1 and ahead["back_db"] < -0.8
