"""Fits of a still camera are judged at the smoke's true distance."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from made_plumes import ball, made_plume, true_gaussians

from backend.fit.state import particle_frame
from backend.geometry.camera import view_at
from backend.render.picture import picture
from training import judge_still
from training.judge import SEEN, standing
from training.library import Plume

VIEW = view_at(standing(0.0), 0)


@pytest.fixture(scope="module")
def smoke() -> Plume:
    return made_plume(ball())


@pytest.mark.parametrize("factor", [0.7, 1.0, 1.2])
def test_smoke_that_is_too_near_is_known_and_made_larger(smoke: Plume, factor: float) -> None:
    right = true_gaussians(smoke, shift=0.0)[0]
    wrong = judge_still.made_larger(right, VIEW, 1 / factor)
    assert judge_still.distance_error(smoke, [wrong] * SEEN, VIEW) == pytest.approx(factor, rel=1e-3)
    pictures = [picture(particle_frame(record), VIEW) for record in (right, wrong)]
    assert np.abs(pictures[0] - pictures[1]).max() < 0.02, "before the camera they are the same"
    placed = judge_still.made_larger(wrong, VIEW, factor)
    np.testing.assert_allclose(placed.positions, right.positions, atol=1e-9)
    np.testing.assert_allclose(placed.optical_masses, right.optical_masses, rtol=1e-5)


def test_a_fit_without_smoke_stays_where_it_is(smoke: Plume) -> None:
    right = true_gaussians(smoke, shift=0.0)[0]
    nothing = replace(right, optical_masses=np.zeros_like(right.optical_masses))
    assert judge_still.distance_error(smoke, [nothing] * SEEN, VIEW) == 1.0


def test_it_is_looked_at_from_the_side_and_from_behind() -> None:
    views = judge_still.views_around(0)
    assert set(views) == {"turned_30_db", "side_db", "back_db"}
    ahead = {name: float(view.camera_to_world[:3, 2] @ VIEW.camera_to_world[:3, 2]) for name, view in views.items()}
    assert ahead["turned_30_db"] > 0.8 and abs(ahead["side_db"]) < 0.1 and ahead["back_db"] < -0.8
