"""The losses at their limits: equal pictures, empty ones, a single pixel, odd sizes, black, white and far beyond white."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from backend.fit import losses
from tests.extremes.draws import same_draws
from tests.reference.refusals import refuses

PART = "Losses"
ALL = {
    "l1": losses.l1,
    "ssim": losses.structural_similarity,
    "reconstruction": losses.reconstruction,
    "published": losses.frequency_as_published,
    "frequency": lambda a, b: losses.frequency(a, b, band=(0.0, 1.0)),
}
SIZES = [(1, 1, 1), (3, 1, 1), (1, 1, 17), (2, 13, 1), (3, 7, 5), (1, 2, 3), (3, 31, 17), (4, 64, 48)]


def pictures(shape, seed=0):
    random = np.random.default_rng(seed)
    return random.random(shape), random.random(shape)


def test_equal_pictures(table):
    """No loss, and no gradient that would move them."""
    worst = 0.0
    for shape in SIZES:
        for level in (0.0, 1e-30, 1.0, None):
            picture = pictures(shape)[0] if level is None else np.full(shape, level)
            for name, loss in ALL.items():
                value, gradient = loss(picture, picture.copy())
                off = abs(value - 1.0) if name == "ssim" else abs(value)
                worst = max(worst, off, float(np.abs(gradient).max()))
    table.row(
        "equal pictures", tried=f"{len(ALL)} losses, {len(SIZES)} sizes, black to white and noise",
        happens="no loss and no gradient", measure="largest loss or gradient", worst=worst, bound=1e-12,
    )  # fmt: skip


def test_empty_pictures(table):
    tried, worst = 0, 0.0
    for shape in ((0, 5, 5), (3, 0, 5), (3, 5, 0)):
        for name, loss in ALL.items():
            value, gradient = loss(np.zeros(shape), np.zeros(shape))
            assert gradient.shape == shape
            worst = max(worst, abs(value - (name == "ssim")))
            tried += 1
    table.row(
        "empty pictures", tried=f"no channel, no row, no column: {tried} cases", happens="no loss", measure="largest loss",
        worst=worst, bound=0,
    )  # fmt: skip


def test_gradients_at_odd_sizes_are_the_finite_differences(table):
    worst = 0.0
    for shape in SIZES[:-1]:
        picture, target = pictures(shape, 3)
        way = np.random.default_rng(4).normal(size=shape)
        for name, loss in ALL.items():
            slope = float((loss(picture, target)[1] * way).sum())
            step = 1e-6
            found = (loss(picture + step * way, target)[0] - loss(picture - step * way, target)[0]) / (2 * step)
            if name == "published" and shape[1] * shape[2] == 1:
                continue  # a single pixel has a phase of 0, with a jump beside it
            worst = max(worst, abs(found - slope) / max(abs(slope), 1e-3))
    table.row(
        "gradients at odd sizes", tried="1 x 1 to 31 x 17", happens="exact",
        measure="relative error against finite differences", worst=worst, bound=1e-5,
    )  # fmt: skip


def test_any_brightness(table):
    """Light may be far beyond white; similarity stays within -1 and 1."""
    worst = 0.0
    for level in (0.0, 1e-30, 1e-6, 1.0, 1e2, 1e4, 1e6):
        for name, loss in ALL.items():
            for shape in SIZES:
                picture, target = pictures(shape, 5)
                value, gradient = loss(level * picture, level * target)
                assert np.isfinite(value), name
                assert np.isfinite(gradient).all(), name
                if name == "ssim":
                    worst = max(worst, abs(value))
    table.row(
        "brightness", tried="0 and 1e-30 to 1e6", happens="values and gradients are finite", measure="largest |SSIM|",
        worst=worst, bound=1,
    )  # fmt: skip


def test_flat_pictures_beyond_white_are_alike(table):
    """Variances of flat pictures cancel: what is left must not be taken for structure."""
    worst = {}
    for level in (1.0, 1e2, 1e4, 1e6):
        flat = np.full((1, 24, 24), level)
        value, gradient = losses.structural_similarity(flat, flat * (1 + 1e-9))
        worst[level] = abs(value - 1.0)
        assert np.isfinite(gradient).all()
    table.row(
        "flat pictures beyond white", tried="1 to 1e4 times white", happens="alike", measure="|SSIM - 1|",
        worst=max(worst[level] for level in (1.0, 1e2, 1e4)), bound=1e-4,
    )  # fmt: skip
    table.row(
        "flat pictures far beyond white", tried="1e6 times white", happens="digits of float64 begin to lack",
        measure="|SSIM - 1|", worst=worst[1e6], bound=0.1,
    )  # fmt: skip


def test_a_number_that_is_none_is_refused(table):
    let_through, tried = [], 0
    for bad in (np.nan, np.inf, -np.inf):
        for which in (0, 1):
            pair = list(pictures((3, 8, 9)))
            pair[which][1, 2, 3] = bad
            for name, loss in ALL.items():
                tried += 1
                if not refuses(lambda loss=loss, pair=pair: loss(*pair), "NaN or infinity"):
                    let_through.append(name)
    for shapes in (((3, 4, 5), (3, 5, 4)), ((4, 5), (4, 5))):
        for name, loss in ALL.items():
            tried += 1
            if not refuses(lambda loss=loss, shapes=shapes: loss(np.zeros(shapes[0]), np.zeros(shapes[1])), "cannot be compared"):
                let_through.append(name)
    assert not let_through
    table.row(
        "NaN, infinity, shapes that do not fit", tried=f"{tried} cases", happens="refused", measure="cases let through",
        worst=len(let_through), bound=0,
    )  # fmt: skip


def test_a_band_without_a_frequency_is_refused():
    with pytest.raises(ValueError, match="no frequency"):
        losses.frequency(*pictures((1, 1, 1)))


@same_draws
@given(
    seed=st.integers(0, 2**31), channels=st.integers(1, 4), height=st.integers(1, 20), width=st.integers(1, 20),
    bright=st.floats(-30, 12), dark=st.floats(-30, 12), share=st.floats(0, 1),
)  # fmt: skip
def test_anything_at_all_is_finite(seed, channels, height, width, bright, dark, share):
    random = np.random.default_rng(seed)
    shape = (channels, height, width)
    picture = np.where(random.random(shape) < share, 0.0, np.exp(bright) * random.random(shape))
    target = np.where(random.random(shape) < share, 0.0, np.exp(dark) * random.random(shape))
    for name, loss in ALL.items():
        value, gradient = loss(picture, target)
        assert np.isfinite(value) and np.isfinite(gradient).all(), name
        assert gradient.shape == shape
