"""Smoke as another side sees it."""

from __future__ import annotations

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
from particles_of import particles
from scipy.integrate import quad

from backend.contract.cameras import Cameras
from backend.contract.light import Light
from backend.geometry.camera import View, view_at
from backend.io.particles import ParticleFrame
from backend.render.picture import picture, picture_of
from backend.render.scattering import ONCE, phase, seen_from

SUN = Light(
    direction=(1.0, 0.0, 0.0), sun=(0.8, 0.7, 0.5), ambient=(0.1, 0.1, 0.2), softness=0.7, explained=0.8, doubt_degrees=9.0,
    anisotropy=0.4, sun_share=0.75,
)  # fmt: skip


def frame(positions: np.ndarray) -> ParticleFrame:
    return particles(positions, np.array([0.5, 0.4, 0.3]))


def camera(place: tuple[float, float, float]) -> View:
    matrix = np.eye(4)
    matrix[:3, 3] = place
    return View(width=40, height=30, fx=50.0, fy=50.0, cx=20.0, cy=15.0, camera_to_world=matrix)


@pytest.mark.parametrize("anisotropy", [-0.5, 0.0, 0.3, 0.9])
def test_no_light_is_made_and_its_mean_cosine_is_the_anisotropy(anisotropy: float) -> None:
    total, cosine = (quad(lambda c, n=n: 0.5 * phase(anisotropy, np.asarray(c)) * c**n, -1, 1)[0] for n in (0, 1))
    assert total == pytest.approx(1.0, abs=1e-6)
    assert cosine == pytest.approx(anisotropy, abs=1e-6)


def test_by_hand_with_the_sun_behind_the_camera_and_before_it() -> None:
    smoke, behind, before = frame(np.zeros((1, 3))), camera((9.0, 0.0, 0.0)), camera((-5.0, 0.0, 0.0))
    g = ONCE * SUN.anisotropy
    turned_back, gone_on = ((1 - g * g) / (1 + sign * g) ** 3 for sign in (1, -1))  # cosine -1 and 1
    wanted = (0.75 * gone_on + 0.25) / (0.75 * turned_back + 0.25)
    assert wanted > 1.5
    found = seen_from(smoke, before, filmed=behind, light=SUN)
    np.testing.assert_allclose(found.colors, wanted * smoke.colors, rtol=1e-6)
    back = seen_from(found, behind, filmed=before, light=SUN)
    np.testing.assert_allclose(back.colors, smoke.colors, rtol=1e-6)


def test_the_view_that_filmed_it_sees_it_as_it_was() -> None:
    smoke = frame(np.random.default_rng(0).normal(size=(50, 3)))
    view = camera((3.0, 1.0, 2.0))
    np.testing.assert_array_equal(seen_from(smoke, view, filmed=view, light=SUN).colors, smoke.colors)


def test_without_a_light_or_with_one_that_goes_on_alike_to_all_sides_nothing_changes() -> None:
    smoke = frame(np.ones((3, 3)))
    views = {"view": camera((5.0, 0.0, 0.0)), "filmed": camera((0.0, 5.0, 0.0))}
    assert seen_from(smoke, **views, light=None) is smoke
    assert seen_from(smoke, **views, light=replace(SUN, anisotropy=0.0)) is smoke


def test_a_particle_in_the_camera_s_own_place_and_none_at_all_stay_finite() -> None:
    views = {"view": camera((5.0, 0.0, 0.0)), "filmed": camera((0.0, 5.0, 0.0))}
    there = seen_from(frame(np.array([[5.0, 0.0, 0.0], [0.0, 5.0, 0.0]])), **views, light=replace(SUN, anisotropy=0.99))
    assert np.isfinite(there.colors).all() and (there.colors > 0).all()
    assert seen_from(frame(np.zeros((0, 3))), **views, light=SUN).count == 0


def test_pictures_of_an_asset_are_lit_for_their_view_by_the_camera_of_their_frame() -> None:
    """The clip's own pictures are the particles' own; a forecast, which nobody filmed, has the last camera's colours."""
    smoke = frame(np.random.default_rng(1).normal(0.0, 0.3, (40, 3)))
    matrices = []
    for way in ((1.0, 0.0), (0.0, 1.0)):  # looks into the sun, then across its light
        away = np.array([*way, 0.0])
        matrix = np.eye(4)
        matrix[:3, :3] = np.stack([np.cross(away, [0.0, 0.0, 1.0]), [0.0, 0.0, -1.0], away], axis=1)
        matrix[:3, 3] = -4.0 * away
        matrices.append(matrix.tolist())
    cameras = Cameras(width=40, height=30, fx=50.0, fy=50.0, cx=20.0, cy=15.0, fps=24.0, camera_to_world=matrices)
    asset = SimpleNamespace(info=SimpleNamespace(cameras=cameras, light=SUN), num_frames=2)
    first, last = (view_at(cameras, index) for index in (0, 1))
    for index, own in ((0, first), (1, last), (2, last), (7, last)):
        np.testing.assert_array_equal(picture_of(asset, smoke, index, own), picture(smoke, own))  # type: ignore[arg-type]
    lit, as_filmed = picture_of(asset, smoke, 1, first), picture(smoke, first)  # type: ignore[arg-type]
    np.testing.assert_array_equal(lit[..., 3], as_filmed[..., 3])
    assert lit[..., 0].sum() > 1.2 * as_filmed[..., 0].sum(), "before the sun smoke is brighter"
