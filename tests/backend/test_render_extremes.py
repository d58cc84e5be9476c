"""The renderer at its limits: nothing, everything, far too small, far too large, and input that must be refused."""

from __future__ import annotations

import numpy as np
import pytest

from backend.geometry.camera import View
from backend.render import splat
from backend.render.gaussians import Gaussians
from backend.render.projection import DILATION, NEAR
from tests.reference.smoke_scenes import cloud, one, plain_view

VIEW = plain_view(96, 64, 80.0)


def everything(gaussians: Gaussians, view: View = VIEW) -> tuple[splat.Splat, splat.Gradients]:
    """Image and gradients, checked to be finite numbers without denormals' worth of surprise."""
    drawn = splat.forward(gaussians, view, features=gaussians.colors)
    gradients = splat.backward(drawn, np.ones_like(drawn.image))
    assert np.isfinite(drawn.image).all()
    assert (drawn.image >= 0).all()
    for name in gradients.__slots__:
        assert np.isfinite(getattr(gradients, name)).all(), name
    assert np.isfinite(splat.adjoint_mass(drawn, np.ones_like(drawn.image[0]))).all()
    return drawn, gradients


def none_at_all() -> Gaussians:
    return Gaussians(
        positions=np.zeros((0, 3)),
        scales=np.zeros((0, 3)),
        rotations=np.zeros((0, 4)),
        optical_masses=np.zeros(0),
        colors=np.zeros((0, 3)),
    )


def test_no_gaussian_is_a_black_image():
    drawn, gradients = everything(none_at_all())
    assert drawn.image.shape == (4, 64, 96)
    assert not drawn.image.any()
    assert gradients.positions.shape == (0, 3)


def test_coincident_gaussians_add_up():
    single = one((0.1, 0.1, 2.0), 0.1, mass=0.2)
    many = Gaussians(**{name: np.repeat(getattr(single, name), 7, axis=0) for name in single.__slots__})
    a, b = everything(single)[0].image, everything(many)[0].image
    np.testing.assert_allclose(b, 7 * a, rtol=0, atol=1e-6 * b.max())


def test_behind_the_camera_and_at_the_near_plane_there_is_nothing():
    for depth in (-5.0, 0.0, NEAR, np.nextafter(NEAR, 0)):
        drawn, gradients = everything(one((0, 0, depth), 0.3))
        assert not drawn.image.any()
        assert not gradients.positions.any()


def test_a_gaussian_fades_in_behind_the_near_plane_without_a_step():
    depths = np.array([1.0 + 1e-6, 1.001, 1.25, 1.5, 1.75, 1.999, 2.0, 2.001]) * NEAR
    light = [everything(one((0, 0, depth), 1e-5, mass=1e-9))[0].image[0].sum() * depth**2 for depth in depths]
    share = np.array(light) / light[-1]
    assert share[0] < 1e-9
    assert share[3] == pytest.approx(0.5, rel=1e-2)
    assert (np.diff(share) > -1e-2).all()
    assert share[5] == pytest.approx(1.0, rel=1e-2)


@pytest.mark.parametrize("pixels", [0.0, 1e-6, 1e-3, 1.0, 1e3, 1e6])
def test_any_size_in_pixels(pixels):
    drawn, _ = everything(one((0.01, 0.01, 2.0), pixels * 2.0 / 80.0, mass=1.0))
    variance = pixels**2 + DILATION
    mass = 80.0 * 80.0 / 4.0
    assert drawn.image[0].max() == pytest.approx(mass / (2 * np.pi * variance), rel=1.0 if pixels < 1 else 0.1)
    if 1e-6 <= pixels <= 1.0:
        assert drawn.image[0].sum() == pytest.approx(mass, rel=0.012)


@pytest.mark.parametrize("turn", [0.0, 0.3, np.pi / 4, 1.3, np.pi / 2])
def test_a_needle_of_aspect_a_million_keeps_its_profile(turn):
    length, depth = 1e6 * 0.02, 2.0  # 0.8 px wide, 800 000 px long
    needle = one((0.0, 0.0, depth), (length, 0.02, 0.02), mass=1e3, rotation=(np.cos(turn / 2), 0, 0, np.sin(turn / 2)))
    drawn, _ = everything(needle)
    across = drawn.image[0][32] if abs(np.sin(turn)) > 0.7 else drawn.image[0][:, 48]
    slant = max(abs(np.sin(turn)), abs(np.cos(turn)))
    expected = 1e3 * 1600 / np.sqrt(2 * np.pi) / (length * 40) / slant  # line density over the slanted cut
    assert across.sum() == pytest.approx(expected, rel=0.01)


@pytest.mark.parametrize("mass", [0.0, 1e-30, 1e-6, 1.0, 1e6])
def test_any_mass(mass):
    drawn, gradients = everything(one((0, 0, 2.0), 0.1, mass=mass))
    unit = splat.forward(one((0, 0, 2.0), 0.1), VIEW).image[0]
    np.testing.assert_allclose(drawn.image[0], unit * mass, rtol=1e-5, atol=1e-18)
    assert gradients.optical_masses[0] > 0  # also where the mass is zero


def test_far_off_axis_nothing_grows_without_bound():
    for x in (3.0, 30.0, 3e3, 3e6):
        drawn, _ = everything(one((x, 0.0, 0.05), 0.5, mass=0.01))
        assert drawn.image[0].max() < 1e3


def test_the_kernels_produce_no_denormals():
    gaussians = cloud(VIEW, 200)
    drawn = splat.forward(gaussians, VIEW, features=gaussians.colors)
    thin = splat.reweighted(drawn, gaussians.optical_masses * 1e-12)
    tiny = np.finfo(np.float32).tiny
    for image in (drawn.image, thin.image):
        assert not ((image > 0) & (image < tiny)).any()


@pytest.mark.parametrize("name", ["positions", "scales", "rotations", "optical_masses", "colors"])
@pytest.mark.parametrize("bad", [np.nan, np.inf])
def test_a_number_that_is_none_is_refused_by_the_arrays_name(name, bad):
    good = cloud(VIEW, 5)
    array = getattr(good, name).copy()
    array.reshape(-1)[3] = bad
    with pytest.raises(ValueError, match=name):
        Gaussians(**{key: getattr(good, key) for key in good.__slots__} | {name: array})


def test_wrong_shapes_negative_and_zero_values_are_refused():
    good = cloud(VIEW, 5)
    arrays = {key: getattr(good, key) for key in good.__slots__}
    for name, array, words in (
        ("scales", good.scales[:, :2], "scales has shape"),
        ("scales", -good.scales, "scales holds negative"),
        ("optical_masses", -good.optical_masses, "optical_masses holds negative"),
        ("rotations", np.zeros((5, 4)), "length zero"),
        ("rotations", good.rotations[:4], "rotations has shape"),
        ("colors", good.colors.astype(str), "real numbers"),
    ):
        with pytest.raises(ValueError, match=words):
            Gaussians(**arrays | {name: array})


def test_bad_features_gradients_and_cameras_are_refused_by_name():
    good = cloud(VIEW, 5)
    drawn = splat.forward(good, VIEW)
    with pytest.raises(ValueError, match="features"):
        splat.forward(good, VIEW, features=np.full((5, 1), np.nan))
    with pytest.raises(ValueError, match="features"):
        splat.forward(good, VIEW, features=np.zeros((4, 1)))
    with pytest.raises(ValueError, match="optical_masses"):
        splat.reweighted(drawn, np.full(5, np.nan))
    with pytest.raises(ValueError, match="optical_masses"):
        splat.reweighted(drawn, np.full(5, -1.0))
    with pytest.raises(ValueError, match="grad_image"):
        splat.backward(drawn, np.zeros((2, 64, 96), np.float32))
    hole = np.zeros((1, 64, 96), np.float32)
    hole[0, 5, 7] = np.nan
    with pytest.raises(ValueError, match="grad_image"):
        splat.backward(drawn, hole)
    with pytest.raises(ValueError, match="image_grad"):
        splat.adjoint_mass(drawn, hole[0])
    broken = np.eye(4)
    broken[0, 3] = np.nan
    with pytest.raises(ValueError, match="camera_to_world"):
        splat.forward(good, View(width=8, height=8, fx=8, fy=8, cx=4, cy=4, camera_to_world=broken))
    with pytest.raises(ValueError, match="no camera"):
        splat.forward(good, View(width=8, height=8, fx=0, fy=8, cx=4, cy=4, camera_to_world=np.eye(4)))
