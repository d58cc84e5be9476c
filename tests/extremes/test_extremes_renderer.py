"""The renderer at its limits: nothing, everything, far too small, far too large, and input that must be refused."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st

from backend.geometry.camera import View
from backend.render import layers, splat, torch_twin
from backend.render.gaussians import Gaussians
from backend.render.projection import DILATION, NEAR
from tests.extremes.draws import same_draws
from tests.reference.ray_integrals import optical_depth
from tests.reference.refusals import refuses
from tests.reference.smoke_scenes import cloud, one, plain_view

PART = "Renderer"
pytestmark = pytest.mark.timeout(3600)  # of the whole ranges, on a busy core
VIEW = plain_view(96, 64, 80.0)


def everything(gaussians: Gaussians, view: View = VIEW, *, near: float | None = None) -> tuple[splat.Splat, splat.Gradients]:
    """Image and gradients, checked to be finite, the image not negative."""
    drawn = splat.forward(gaussians, view, features=gaussians.colors, near=near)
    gradients = splat.backward(drawn, np.ones_like(drawn.image))
    assert np.isfinite(drawn.image).all()
    assert (drawn.image >= 0).all()
    for name in gradients.__slots__:
        assert np.isfinite(getattr(gradients, name)).all(), name
    assert np.isfinite(splat.adjoint_mass(drawn, np.ones_like(drawn.image[0]))).all()
    return drawn, gradients


def many(single: Gaussians, count: int) -> Gaussians:
    return Gaussians(**{name: np.repeat(getattr(single, name), count, axis=0) for name in single.__slots__})


def scaled(gaussians: Gaussians, scale: float) -> Gaussians:
    """The same scene with other metres."""
    return replace(
        gaussians,
        positions=scale * gaussians.positions,
        scales=scale * gaussians.scales,
        optical_masses=scale**2 * gaussians.optical_masses,
    )


# -- how much there is -------------------------------------------------------------------------------------------------


def test_no_gaussian_is_a_black_image(table):
    nothing = Gaussians(**{name: getattr(one((0, 0, 2), 0.1), name)[:0] for name in Gaussians.__slots__})
    worst = 0.0
    for view in (VIEW, plain_view(1, 1, 1.0), plain_view(1, 4000, 10.0)):
        drawn, gradients = everything(nothing, view)
        assert drawn.image.shape == (4, view.height, view.width)
        assert gradients.positions.shape == (0, 3)
        worst = max(worst, float(drawn.image.max()))
    table.row(
        "no particle", tried="0 particles, three sizes of image", happens="black", measure="largest value", worst=worst,
        bound=0,
    )  # fmt: skip


def test_coincident_gaussians_add_up(table):
    single = one((0.1, 0.1, 2.0), 0.1, mass=0.2)
    unit = everything(single)[0].image.astype(np.float64)
    counts = (1, 7, 10_000, 1_000_000) if table.is_full else (1, 7, 10_000)
    worst = 0.0
    for count in counts:
        image = everything(many(single, count))[0].image
        worst = max(worst, float(np.abs(image / count - unit).max() / unit.max()))
    table.row(
        "all particles in one place", tried=f"1 to {max(counts):,}",
        happens="their optical depths add up; sums in float32 lose digits from 1e5 on", measure="error / largest optical depth",
        worst=worst, bound=1e-2,
    )  # fmt: skip


def test_many_particles_hold_their_mass(table):
    count = 1_000_000 if table.is_full else 20_000
    random = np.random.default_rng(0)
    positions = np.concatenate([random.uniform(-0.25, 0.25, (count, 2)), random.uniform(1.9, 2.1, (count, 1))], axis=1)
    masses = random.uniform(0.5, 1.5, count) / count
    gaussians = Gaussians(
        positions=positions, scales=np.exp(random.uniform(-9, -4, (count, 3))), rotations=random.normal(size=(count, 4)),
        optical_masses=masses, colors=random.uniform(size=(count, 3)),
    )  # fmt: skip
    image = everything(gaussians)[0].image[0]
    x, y, z = positions.T
    expected = float(np.sum(masses * 80.0 * 80.0 * np.sqrt(1 + (x / z) ** 2 + (y / z) ** 2) / z**2))
    worst = abs(float(image.sum(dtype=np.float64)) / expected - 1)
    table.row(
        "number of particles", tried=f"{count:,} at random places and sizes", happens="the image holds all of their mass",
        measure="relative error of the image's sum", worst=worst, bound=1e-4,
    )  # fmt: skip


# -- how large ---------------------------------------------------------------------------------------------------------


def test_any_size_in_pixels(table):
    worst = 0.0
    sizes = [0.0, *10.0 ** np.arange(-6, 7)]
    for pixels in sizes:
        drawn, _ = everything(one((0.0, 0.0, 2.0), pixels * 2.0 / 80.0))
        variance = pixels**2 + DILATION
        expected = 80.0 * 80.0 / 4.0 / (2 * np.pi * variance) * np.exp(-0.25 / variance)  # half a px off in both axes
        worst = max(worst, abs(float(drawn.image[0, 32, 48]) / expected - 1))
    table.row(
        "size of a splat", tried="0 and 1e-6 to 1e6 px", happens="below 0.55 px drawn as wide as a pixel, with its mass kept",
        measure="relative error of the peak", worst=worst, bound=1e-4,
    )  # fmt: skip


def test_a_needle_keeps_its_profile(table):
    worst = 0.0
    for aspect in (1.0, 1e2, 1e4, 1e6):
        for turn in (0.0, 0.3, np.pi / 4, 1.3, np.pi / 2):
            length = aspect * 0.02  # 0.8 px wide, at most 800 000 px long
            rotation = (np.cos(turn / 2), 0, 0, np.sin(turn / 2))
            drawn, _ = everything(one((0.0, 0.0, 2.0), (length, 0.02, 0.02), mass=1e3, rotation=rotation))
            if aspect < 1e4:
                continue
            across = drawn.image[0][32] if abs(np.sin(turn)) > 0.7 else drawn.image[0][:, 48]
            slant = max(abs(np.sin(turn)), abs(np.cos(turn)))
            expected = 1e3 * 1600 / np.sqrt(2 * np.pi) / (length * 40) / slant  # line density over the slanted cut
            worst = max(worst, abs(float(across.sum()) / expected - 1))
    table.row(
        "aspect of a splat", tried="1 to 1e6, five directions", happens="a needle keeps its width and its mass per length",
        measure="relative error across", worst=worst, bound=1e-4,
    )  # fmt: skip


def test_any_optical_depth(table):
    unit = splat.forward(one((0, 0, 2.0), 0.1), VIEW).image[0].astype(np.float64)
    worst = worst_opacity = 0.0
    for tau in (0.0, 1e-30, 1e-20, *10.0 ** np.arange(-12, 7)):
        mass = tau / unit.max()
        drawn, gradients = everything(one((0, 0, 2.0), 0.1, mass=mass))
        assert gradients.optical_masses[0] > 0  # also where the mass is zero
        if tau >= 1e-12:
            worst = max(worst, float(np.abs(drawn.image[0] / mass - unit).max() / unit.max()))
        color, opacity = splat.composite(drawn.image)
        assert (color >= 0).all() and (opacity <= 1).all()
        there = drawn.image[0] > 0
        exact = -np.expm1(-drawn.image[0].astype(np.float64))
        worst_opacity = max(worst_opacity, float(np.abs(opacity / np.where(there, exact, 1) - 1)[there].max(initial=0.0)))
        slope = splat.composite_backward(drawn.image, np.ones_like(color), np.ones_like(opacity))
        assert np.isfinite(slope).all()
    table.row(
        "optical depth", tried="0 and 1e-30 to 1e6", happens="linear in the mass; below 1e-20 taken as 0",
        measure="error / largest optical depth", worst=worst, bound=1e-6,
    )  # fmt: skip
    table.row(
        "opacity of thin and dense smoke", tried="optical depth 0 and 1e-20 to 1e6",
        happens="all digits kept where 1 - exp(-tau) has none", measure="relative error", worst=worst_opacity, bound=1e-6,
    )  # fmt: skip


def test_the_coloured_mode_at_any_optical_depth(table):
    """Splats end where they are 4e-6 of their peak: with more optical depth than that shows, each mode ends on its own pixel."""
    rows, columns = np.mgrid[0:64, 0:96]
    inside = np.hypot(columns - 47.5, rows - 31.5) < 4 * 4  # standard deviations of 4 px
    unit = float(splat.forward(one((0, 0, 2.0), 0.1), VIEW).image[0].max())
    worst = 0.0
    for tau in (0.0, 1e-12, 1e-3, 1.0, 80.0, 1e3, 1e6):
        gaussians = many(one((0, 0, 2.0), 0.1, mass=tau / unit / 3), 3)
        found = layers.forward(gaussians, VIEW, gaussians.colors)
        back = layers.backward(found, np.ones_like(found.color), np.ones_like(found.opacity))
        for name in back.__slots__:
            assert np.isfinite(getattr(back, name)).all(), name
        assert (found.opacity >= 0).all() and (found.opacity <= 1).all() and (found.color <= 1).all()
        color, opacity = splat.composite(splat.forward(gaussians, VIEW, features=gaussians.colors).image)
        worst = max(
            worst, float(np.abs(found.opacity - opacity)[inside].max()), float(np.abs(found.color - color)[:, inside].max())
        )
    table.row(
        "coloured mode, front to back", tried="optical depth 0 to 1e6", happens="white on white agrees with the sum",
        measure="error of colour and opacity", worst=worst, bound=2e-3,
    )  # fmt: skip


# -- where -------------------------------------------------------------------------------------------------------------


def test_behind_the_camera_and_at_the_near_plane_there_is_nothing(table):
    worst = 0.0
    for depth in (-1e6, -5.0, 0.0, NEAR, np.nextafter(NEAR, 0)):
        drawn, gradients = everything(one((0, 0, depth), 0.3), near=NEAR)
        assert not gradients.positions.any()
        worst = max(worst, float(drawn.image.max()))
    behind = cloud(VIEW, 500)
    drawn, _ = everything(replace(behind, positions=-behind.positions))
    worst = max(worst, float(drawn.image.max()))
    table.row(
        "behind and on the near plane", tried="depth -1e6 m to the near plane; 500 at once", happens="nothing is drawn",
        measure="largest value", worst=worst, bound=0,
    )  # fmt: skip


def test_a_gaussian_fades_in_behind_the_near_plane_without_a_step():
    depths = np.array([1.0 + 1e-6, 1.001, 1.25, 1.5, 1.75, 1.999, 2.0, 2.001]) * NEAR
    light = [everything(one((0, 0, z), 1e-5, mass=1e-9), near=NEAR)[0].image[0].sum() * z**2 for z in depths]
    share = np.array(light) / light[-1]
    assert share[0] < 1e-9
    assert share[3] == pytest.approx(0.5, rel=1e-2)
    assert (np.diff(share) > -1e-2).all()
    assert share[5] == pytest.approx(1.0, rel=1e-2)


def test_far_off_axis_nothing_grows_without_bound(table):
    peak = max(float(everything(one((x, 0.0, 0.05), 0.5, mass=0.01))[0].image[0].max()) for x in (3.0, 30.0, 3e3, 3e6, 3e9))
    table.row(
        "far off the axis, near the camera", tried="x / z from 60 to 6e10",
        happens="the footprint is held at 1.3 of the picture", measure="largest optical depth", worst=peak, bound=1e-6,
    )  # fmt: skip


def test_any_scale_of_the_scene(table):
    """Lengths times a number, masses times its square: the same picture. The near plane must follow small scenes."""
    gaussians = cloud(VIEW, 300)
    expected = everything(gaussians)[0].image
    worst = 0.0
    for scale in 10.0 ** np.arange(-9, 10, 3):
        image = everything(scaled(gaussians, scale))[0].image
        worst = max(worst, float(np.abs(image - expected).max() / expected.max()))
    table.row(
        "scale of the scene", tried="1e-9 to 1e9 of a scene of some metres", happens="the same picture",
        measure="difference / largest value", worst=worst, bound=1e-5,
    )  # fmt: skip


def test_a_world_far_away(table):
    gaussians = cloud(VIEW, 300)
    expected = everything(gaussians)[0].image
    worst = 0.0
    for far in (1e3, 1e6):
        matrix = np.eye(4)
        matrix[:3, 3] = (far, -far, far)
        image = everything(
            replace(gaussians, positions=gaussians.positions + matrix[:3, 3]), replace(VIEW, camera_to_world=matrix)
        )
        worst = max(worst, float(np.abs(image[0].image - expected).max() / expected.max()))
    table.row(
        "distance of the world's origin", tried="up to 1e6 m", happens="the same picture", measure="difference / largest value",
        worst=worst, bound=1e-4,
    )  # fmt: skip


# -- which camera ------------------------------------------------------------------------------------------------------


def test_any_size_of_image(table):
    sizes = [(1, 1), (1, 7), (5, 1), (15, 16), (17, 33), (1, 3000), (3000, 1), (640, 360)]
    if table.is_full:
        sizes += [(3840, 2160), (7680, 4320)]
    worst = 0.0
    for width, height in sizes:
        view = plain_view(width, height, 0.8 * max(width, height))
        sigma = 0.1 * min(width, height)
        drawn, _ = everything(one((0, 0, 2.0), sigma * 2.0 / view.fx), view)
        variance = sigma**2 + DILATION
        away = ((width % 2 == 0) + (height % 2 == 0)) * 0.25  # the middle is half a px off a centre along even sides
        expected = view.fx**2 / 4.0 / (2 * np.pi * variance) * np.exp(-0.5 * away / variance)
        worst = max(worst, abs(float(drawn.image[0, height // 2, width // 2]) / expected - 1))
    last = sizes[-1]
    table.row(
        "size of the image", tried=f"1 x 1 to {last[0]} x {last[1]}, odd sizes, lines", happens="drawn at any size",
        measure="relative error of the peak", worst=worst, bound=1e-4,
    )  # fmt: skip


def test_any_field_of_view(table):
    """Against the exact integral along every ray; the expansion at the centre of a splat errs by its angle's square."""
    worst = 0.0
    for degrees in (0.1, 1.0, 10.0, 60.0, 120.0, 170.0):
        view = plain_view(96, 64, 48 / math.tan(math.radians(degrees) / 2))
        for off in (0.0, 0.7):
            sigma = 2.5 / view.fx * 2.0  # 2.5 px
            place = (off * 48 / view.fx * 2.0, 0.0, 2.0)
            drawn, _ = everything(one(place, sigma, mass=sigma**2), view)
            if 5.0 * sigma > 2.0:
                continue  # as large as its distance: nothing to compare with but a bound
            exact = optical_depth(view, np.array(place), sigma**2 * np.eye(3), sigma**2)
            # What is thinner than a pixel's filter is widened by it on purpose.
            error = np.abs(drawn.image[0].sum() / exact.sum() - 1)
            worst = max(worst, float(error))
    table.row(
        "field of view", tried="0.1 to 170 degrees, in the middle and at 0.7 of the edge",
        happens="drawn by a first-order expansion", measure="relative error of the mass against exact rays", worst=worst,
        bound=0.08,
    )  # fmt: skip


# -- numbers that are none ---------------------------------------------------------------------------------------------


def test_a_number_that_is_none_is_refused_by_the_arrays_name(table):
    good = cloud(VIEW, 5)
    arrays = {key: getattr(good, key) for key in good.__slots__}
    drawn = splat.forward(good, VIEW, features=good.colors)
    let_through, tried = [], 0
    for bad in (np.nan, np.inf, -np.inf):
        for name in arrays:
            array = arrays[name].copy()
            array.reshape(-1)[3] = bad
            tried += 1
            if not refuses(lambda name=name, array=array: Gaussians(**arrays | {name: array}), name):
                let_through.append((name, bad))
        hole = np.zeros_like(drawn.image)
        hole[0, 5, 7] = bad
        matrix = np.eye(4)
        matrix[0, 3] = bad
        actions = [
            ("features", lambda bad=bad: splat.forward(good, VIEW, features=np.full((5, 1), bad))),
            ("features", lambda bad=bad: layers.forward(good, VIEW, np.full((5, 1), bad))),
            ("optical_masses", lambda bad=bad: splat.reweighted(drawn, np.full(5, bad))),
            ("grad_image", lambda hole=hole: splat.backward(drawn, hole)),
            ("image_grad", lambda hole=hole: splat.adjoint_mass(drawn, hole[0])),
            ("grad_features", lambda hole=hole: splat.composite_backward(drawn.image, hole[1:] + hole[:1], None)),
            ("grad_opacity", lambda hole=hole: splat.composite_backward(drawn.image, None, hole[0])),
            ("camera_to_world", lambda m=matrix: splat.forward(good, replace(VIEW, camera_to_world=m))),
            ("near", lambda bad=bad: splat.forward(good, VIEW, near=bad)),
        ]
        for key in ("fx", "fy", "cx", "cy"):
            actions.append(("camera", lambda key=key, bad=bad: splat.forward(good, replace(VIEW, **{key: bad}))))
        for name, action in actions:
            tried += 1
            if not refuses(action, name):
                let_through.append((name, bad))
    assert not let_through
    table.row(
        "NaN and infinity", tried=f"in every input, {tried} cases", happens="refused by the array's name",
        measure="cases let through", worst=len(let_through), bound=0,
    )  # fmt: skip


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
    drawn = splat.forward(good, VIEW)
    for action, words in (
        (lambda: splat.forward(good, VIEW, features=np.zeros((4, 1))), "features"),
        (lambda: splat.reweighted(drawn, np.full(5, -1.0)), "optical_masses"),
        (lambda: splat.backward(drawn, np.zeros((2, 64, 96), np.float32)), "grad_image"),
        (lambda: splat.forward(good, replace(VIEW, fx=0.0)), "no camera"),
        (lambda: splat.forward(good, VIEW, near=0.0), "no camera"),
    ):
        with pytest.raises(ValueError, match=words):
            action()


# -- digits ------------------------------------------------------------------------------------------------------------


def test_the_kernels_produce_no_denormals():
    gaussians = cloud(VIEW, 200)
    drawn = splat.forward(gaussians, VIEW, features=gaussians.colors)
    thin = splat.reweighted(drawn, gaussians.optical_masses * 1e-12)
    tiny = np.finfo(np.float32).tiny
    for image in (drawn.image, thin.image):
        assert not ((image > 0) & (image < tiny)).any()


def test_single_precision_against_the_twin_in_double(table):
    """The kernels draw in float32; the twin sums every splat over the whole image in float64."""
    worst = worst_gradient = 0.0
    for seed, (smallest, largest) in enumerate([(1e-6, 1e-3), (1e-3, 0.6), (0.1, 30.0)]):
        gaussians = cloud(VIEW, 80, seed=seed, smallest=smallest, largest=largest)
        weight = np.random.default_rng(seed).normal(size=(4, VIEW.height, VIEW.width)).astype(np.float32)
        drawn = splat.forward(gaussians, VIEW, features=gaussians.colors)
        found = splat.backward(drawn, weight)
        names = ("positions", "scales", "rotations", "optical_masses", "colors")
        leaves = [torch.tensor(np.asarray(getattr(gaussians, name), np.float64), requires_grad=True) for name in names]
        image = torch_twin.render(*leaves, VIEW)
        exact = torch.autograd.grad((image * torch.from_numpy(weight)).sum(), leaves)
        expected = image.detach().numpy()
        worst = max(worst, float(np.abs(drawn.image - expected).max() / expected.max()))
        for name, gradient in zip(("positions", "scales", "rotations", "optical_masses", "features"), exact, strict=True):
            error = np.abs(getattr(found, name) - gradient.numpy()).max() / np.abs(gradient.numpy()).max()
            worst_gradient = max(worst_gradient, float(error))
    table.row(
        "float32 against float64", tried="splats of 1e-5 to 1e3 px",
        happens="the sum in float32 agrees with the twin in float64", measure="error / largest value", worst=worst, bound=2e-5,
    )  # fmt: skip
    table.row(
        "float32 against float64, gradients", tried="the same, for every input", happens="they agree with autograd in float64",
        measure="error / largest of the input", worst=worst_gradient, bound=0.0002,
    )  # fmt: skip


wide = st.floats(-30.0, 30.0).map(math.exp)


@same_draws
@given(
    seed=st.integers(0, 2**31), size=wide, mass=wide, aspect=st.floats(-30.0, 0.0).map(math.exp), depth=wide,
    degrees=st.floats(0.1, 170.0), width=st.integers(1, 70), height=st.integers(1, 70),
)  # fmt: skip
def test_anything_at_all_is_finite_with_its_gradients(seed, size, mass, aspect, depth, degrees, width, height):
    random = np.random.default_rng(seed)
    view = plain_view(width, height, 0.5 * width / math.tan(math.radians(degrees) / 2))
    count = 5
    gaussians = Gaussians(
        positions=random.normal(size=(count, 3)) * depth + (0.0, 0.0, depth),
        scales=size * aspect ** random.uniform(0.0, 1.0, (count, 3)),
        rotations=random.normal(size=(count, 4)),
        optical_masses=mass * random.uniform(0.0, 1.0, count),
        colors=random.uniform(size=(count, 3)),
    )
    drawn, _ = everything(gaussians, view)
    color, opacity = splat.composite(drawn.image)
    assert (opacity <= 1).all() and np.isfinite(color).all()
    found = layers.forward(gaussians, view, gaussians.colors)
    assert np.isfinite(found.color).all() and (found.opacity >= 0).all() and (found.opacity <= 1).all()
