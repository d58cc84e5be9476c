"""The renderer's image: against exact ray integrals, against the torch twin, by hand, and what must not change."""

from __future__ import annotations

import math

import numba
import numpy as np
import pytest
import torch

from backend.geometry.camera import View
from backend.render import splat, torch_twin
from backend.render.gaussians import Gaussians
from backend.render.projection import DILATION
from tests.reference.ray_integrals import optical_depth
from tests.reference.smoke_scenes import cloud, one, plain_view, turned_view


def twin_image(gaussians: Gaussians, view: View, features: np.ndarray) -> np.ndarray:
    arrays = (gaussians.positions, gaussians.scales, gaussians.rotations, gaussians.optical_masses, features)
    return torch_twin.render(*(torch.tensor(array, dtype=torch.float64) for array in arrays), view).numpy()


@pytest.mark.parametrize(("width", "height"), [(150, 90), (97, 131), (33, 16), (1, 1)])
def test_the_image_is_the_direct_sum_to_1e_5(width, height):
    view = turned_view(width, height)
    gaussians = cloud(view, 300)
    result = splat.forward(gaussians, view, features=gaussians.colors)
    expected = twin_image(gaussians, view, gaussians.colors)
    assert result.image.shape == (4, height, width) and result.image.dtype == np.float32
    assert np.abs(result.image - expected).max() < 1e-5 * expected[0].max()
    if width > 100:
        assert len(np.unique(result.geometry.levels)) >= 5  # several levels and unseen ones were at work


def test_every_level_alone_is_exact():
    view = plain_view(192, 144, 200.0)
    for size in np.geomspace(0.3, 200.0, 24):  # px; crosses every threshold between levels
        gaussians = one((0.013, -0.021, 2.0), size / 100.0, mass=1e-3)
        image = splat.forward(gaussians, view).image
        expected = twin_image(gaussians, view, np.zeros((1, 0)))
        assert np.abs(image - expected).max() < 1e-5 * expected.max(), f"{size:.2f} px"


@pytest.mark.parametrize("centre", [(0.0, 0.0), (0.9, 0.5)])
def test_small_gaussians_have_the_exact_ray_integral_on_and_off_the_axis(centre):
    view = plain_view(320, 240, 160.0)
    position = np.array([centre[0] * 3, centre[1] * 3, 3.0])
    gaussians = one(position, (0.06, 0.1, 0.075), mass=0.05, rotation=(0.8, 0.3, -0.4, 0.2))
    rotation = torch_twin.quaternion_matrices(torch.tensor(gaussians.rotations)).numpy()[0]
    covariance = rotation @ np.diag(gaussians.scales[0] ** 2) @ rotation.T
    exact = optical_depth(view, position, covariance + np.eye(3) * DILATION * (3 / 160.0) ** 2, 0.05)
    image = splat.forward(gaussians, view).image[0]
    assert np.abs(image - exact).max() < 0.03 * exact.max()  # first-order projection: falls with the size of the splat
    assert image.sum() == pytest.approx(exact.sum(), rel=0.01)


def test_the_whole_mass_arrives_and_by_hand():
    view = plain_view(200, 200, 100.0)
    image = splat.forward(one((0, 0, 4.0), 0.2, mass=0.3), view).image[0]
    assert image.sum(dtype=np.float64) == pytest.approx(0.3 * 100 * 100 / 16, rel=1e-5)
    variance = (0.2 * 100 / 4) ** 2 + DILATION  # 25.3 px^2; the centre lies on a corner of four pixels
    peak = 0.3 * 625 / (2 * math.pi * variance) * math.exp(-0.25 / variance)
    assert image.max() == pytest.approx(peak, rel=2e-5)


def test_a_sub_pixel_gaussian_keeps_its_mass():
    view = plain_view(64, 64, 100.0)
    for offset in (0.0, 0.003, 0.005):
        image = splat.forward(one((offset, offset, 1.0), 1e-6, mass=1e-4), view).image[0]
        assert image.sum(dtype=np.float64) == pytest.approx(1.0, rel=0.012)  # sampling 0.55 px wide: 2 exp(-2 pi^2 0.3) an axis


def test_halving_a_gaussian_twice_over_changes_nothing():
    view = turned_view(120, 80)
    whole = cloud(view, 50)
    halves = Gaussians(
        positions=np.repeat(whole.positions, 2, axis=0),
        scales=np.repeat(whole.scales, 2, axis=0),
        rotations=np.repeat(whole.rotations, 2, axis=0),
        optical_masses=np.repeat(whole.optical_masses, 2) / 2,
        colors=np.repeat(whole.colors, 2, axis=0),
    )
    a = splat.forward(whole, view, features=whole.colors).image
    b = splat.forward(halves, view, features=halves.colors).image
    np.testing.assert_allclose(a, b, rtol=0, atol=2e-6 * a[0].max())


def test_more_mass_lets_less_light_through_everywhere_it_reaches():
    view = turned_view(120, 80)
    gaussians = cloud(view, 40)
    thin = splat.forward(gaussians, view)
    thick = splat.reweighted(thin, gaussians.optical_masses * 1.5)
    reached = thin.image[0] > 1e-12
    assert reached.mean() > 0.5
    assert (np.exp(-thick.image[0].astype(np.float64)) < np.exp(-thin.image[0].astype(np.float64)))[reached].all()


def test_the_order_of_the_gaussians_matters_to_rounding_only():
    view = turned_view(120, 80)
    a = cloud(view, 60)
    order = np.random.default_rng(3).permutation(60)
    b = Gaussians(**{name: getattr(a, name)[order] for name in a.__slots__})
    image = splat.forward(a, view).image
    np.testing.assert_allclose(image, splat.forward(b, view).image, rtol=0, atol=1e-6 * image.max())


def test_a_world_a_million_metres_away_gives_the_same_image():
    near = turned_view(120, 80, at=(0.0, 0.0, 0.0))
    far_at = np.array([1e6, -1e6, 1e6])
    far = turned_view(120, 80, at=tuple(far_at))
    here = cloud(near, 60)
    there = Gaussians(**{name: getattr(here, name) for name in here.__slots__} | {"positions": here.positions + far_at})
    image = splat.forward(here, near).image
    np.testing.assert_allclose(image, splat.forward(there, far).image, rtol=0, atol=1e-5 * image.max())


def test_reweighting_is_drawing_again():
    view = turned_view(120, 80)
    a = cloud(view, 60)
    masses, features = a.optical_masses * np.linspace(0, 2, 60), a.colors[:, ::-1]
    again = Gaussians(**{name: getattr(a, name) for name in a.__slots__} | {"optical_masses": masses})
    expected = splat.forward(again, view, features=features).image
    np.testing.assert_array_equal(splat.reweighted(splat.forward(a, view), masses, features).image, expected)


def test_the_same_bits_for_one_and_two_threads():
    if numba.config.NUMBA_NUM_THREADS < 2:
        pytest.skip("this machine gives numba a single thread")
    view = turned_view(160, 120)
    gaussians = cloud(view, 1500)
    found = []
    before = numba.get_num_threads()
    try:
        for num_threads in (1, 2, 2):
            numba.set_num_threads(num_threads)
            drawn = splat.forward(gaussians, view, features=gaussians.colors)
            noise = np.random.default_rng(5).normal(size=drawn.image.shape).astype(np.float32)
            gradients = splat.backward(drawn, noise)
            adjoint = splat.adjoint_mass(drawn, noise[0])
            found.append([drawn.image, adjoint, *(getattr(gradients, name) for name in gradients.__slots__)])
    finally:
        numba.set_num_threads(before)
    for other in found[1:]:
        for a, b in zip(found[0], other, strict=True):
            assert a.tobytes() == b.tobytes()
