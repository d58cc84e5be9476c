"""The parts of matting one by one: opacity, filters, plate, sky, motion of the picture."""

from __future__ import annotations

import cv2
import numpy as np
import pytest

from backend.contract.job import ExtractionConfig
from backend.fit import clean_plate, matting, sky, stabilise
from backend.reporting import SilentReport
from backend.stages import smoke


def test_opacity_by_hand() -> None:
    """J 0.1, S 0.6 grey, a 0.4: I = 0.1 * 0.6 + 0.6 * 0.4 = 0.3; with a known colour a = (J - I) / (J - S) = 0.4."""
    color = matting.SmokeColor(direction=np.ones(3, np.float32), brightness=0.6, spread=1e-3)
    image, background = np.full((1, 1, 3), 0.3, np.float32), np.full((1, 1, 3), 0.1, np.float32)
    found = matting.solve_opacity(image, background, color, 0.5 / 255)
    assert found.value[0, 0] == pytest.approx(0.4, abs=0.01)
    assert found.explained[0, 0] > 0.99


@pytest.mark.parametrize("brightness", [0.3, 0.5, 0.8])
def test_brightness_of_smoke_is_free_before_a_coloured_background(brightness) -> None:
    """Before blue sky the blue that is left tells the opacity, whether the smoke is lit or shaded."""
    background = np.full((1, 1, 3), [0.1, 0.3, 0.8], np.float32)
    image = 0.5 * background + 0.5 * brightness
    color = matting.SmokeColor(direction=np.ones(3, np.float32), brightness=0.5, spread=0.3)
    assert matting.solve_opacity(image, background, color, 0.5 / 255).value[0, 0] == pytest.approx(0.5, abs=0.03)


@pytest.mark.parametrize("value", [0.0, 1e-12, 0.5, 1.0, 1e6])
def test_opacity_stays_finite(value) -> None:
    """Also where image, background and smoke are alike, black or far too bright."""
    color = matting.SmokeColor(direction=np.ones(3, np.float32), brightness=0.5, spread=0.1)
    for background in (0.0, 0.5, value):
        images = [np.full((2, 2, 3), v, np.float32) for v in (value, background)]
        found = matting.solve_opacity(*images, color, 0.5 / 255)
        for array in (found.value, found.deviation, found.explained):
            assert np.isfinite(array).all() and (array >= 0).all()
        if value == background:
            assert found.value.max() < 0.05


def test_guided_filter_against_windows_one_by_one() -> None:
    rng = np.random.default_rng(0)
    value, guide, r, epsilon = rng.random((9, 11)), rng.random((9, 11)), 2, 1e-2
    slopes, offsets = np.zeros((9, 11)), np.zeros((9, 11))
    padded = [np.pad(x, 2 * r, mode="symmetric") for x in (value, guide)]

    def window(image, row, column):
        return image[row + r : row + 3 * r + 1, column + r : column + 3 * r + 1]

    for row in range(9):
        for column in range(11):
            p, i = (window(x, row, column) for x in padded)
            slopes[row, column] = ((i * p).mean() - i.mean() * p.mean()) / (i.var() + epsilon)
            offsets[row, column] = p.mean() - slopes[row, column] * i.mean()
    expected = np.zeros((9, 11))
    a, b = (np.pad(x, 2 * r, mode="symmetric") for x in (slopes, offsets))
    for row in range(9):
        for column in range(11):
            expected[row, column] = window(a, row, column).mean() * guide[row, column] + window(b, row, column).mean()
    result = matting.guided_filter(value, guide, radius=r, epsilon=epsilon)
    assert np.abs(result - np.clip(expected, 0, 1)).max() < 1e-6
    assert np.abs(matting.guided_filter(np.full((9, 11), 0.3), guide, radius=r, epsilon=epsilon) - 0.3).max() < 1e-6


def test_hysteresis_keeps_faint_edges_of_strong_smoke_only() -> None:
    opacity = np.zeros((40, 40), np.float32)
    opacity[5:15, 5:15], opacity[8:12, 8:12] = 0.1, 0.5
    opacity[25:35, 25:35] = 0.1  # as faint, but nothing strong inside
    opacity[30, 5] = 0.9  # a speck
    keep = matting.hysteresis(opacity, low=0.03, high=0.2)
    assert (keep[5:15, 5:15] == 1.0).all() and keep.sum() == 100
    assert matting.hysteresis(np.zeros((4, 4), np.float32), low=0.03, high=0.2).max() == 0.0


def test_plate_takes_what_repeats() -> None:
    """Brightening and darkening smoke covers 60 % of the frames; the background that repeats wins."""
    rng = np.random.default_rng(0)
    samples = []
    for k in range(40):
        image = np.full((12, 36, 3), 0.2) + rng.normal(0, 0.001, (12, 36, 3))
        if k % 5 < 3:
            image[:6, :12] = rng.uniform(0.3, 0.9, (6, 12, 1))  # brighter
            image[6:, :12] = rng.uniform(0.0, 0.15, (6, 12, 1))  # darker
        samples.append(np.clip(image, 0, 1).astype(np.float32))
    plate = clean_plate.temporal_plate(samples)
    assert plate.is_seen.mean() > 0.95
    assert np.abs(plate.color - 0.2).max() < 0.005
    assert np.abs(plate.activity[:, :12] - 0.6).max() < 0.05 and plate.activity[:, 12:].max() < 0.05


def test_fill_is_smooth_exact_outside_and_bounded() -> None:
    rng = np.random.default_rng(0)
    image = rng.random((33, 47, 3)).astype(np.float32)
    known = np.ones((33, 47), bool)
    known[10:20, 10:30] = False
    filled = clean_plate.fill_smoothly(image, known)
    assert (filled[known] == image[known]).all()
    assert filled.min() >= image[known].min() - 1e-5 and filled.max() <= image[known].max() + 1e-5
    assert np.abs(clean_plate.fill_smoothly(np.full_like(image, 0.4), known) - 0.4).max() < 1e-5
    assert (clean_plate.fill_smoothly(image, np.zeros_like(known)) == image).all()


def sky_opacity() -> np.ndarray:
    """[h, w] 0..0.9: smoke that stands on the horizon."""
    rows, columns = np.mgrid[0:90, 0:160]
    return 0.9 * np.exp(-(((columns - 80) / 14) ** 2) - ((rows - 42) / 14) ** 2)


def make_sky(phase: float = 0.0) -> np.ndarray:
    """[h, w, 3] linear: blue above, hazy below, a hill with texture, and grey smoke whose billows move with phase."""
    rng = np.random.default_rng(0)
    y = np.linspace(0, 1, 90)[:, None, None]
    sky_color = np.array([0.05, 0.16, 0.45]) * (1 - y) + np.array([0.35, 0.4, 0.5]) * y
    image = np.repeat(sky_color, 160, axis=1)
    rows, columns = np.mgrid[0:90, 0:160]
    light = 0.6 * (1 + 0.2 * np.sin(columns / 3.0 + phase) * np.cos(rows / 4.0 + 0.6 * phase))
    image = image * (1 - sky_opacity()[..., None]) + (light * sky_opacity())[..., None]
    ground = rows > 60 - 6 * np.sin(columns / 30)
    texture = np.array([0.25, 0.17, 0.09]) * (0.6 + 0.8 * rng.random((90, 160, 1)))
    return np.where(ground[..., None], texture, image).astype(np.float32)


def test_lasting_smoke_before_the_sky_of_a_still_camera() -> None:
    """Nothing behind the smoke is ever seen, and its outline never moves: the sky beside it tells what is behind."""
    clip = [np.concatenate([make_sky(0.4 * k), np.ones((90, 160, 1))], axis=2).astype(np.float32) for k in range(24)]
    layer = smoke.run(clip, ExtractionConfig(), SilentReport(), has_alpha=False)
    opacity = sky_opacity() * (np.mgrid[0:90, 0:160][0] < 50)
    for image in layer.frames:
        error = np.abs(image[..., 3] - opacity)[:50]
        assert error[opacity[:50] > 0.05].mean() < 0.12
        assert image[70:, :, 3].max() == 0.0


def test_sky_is_found_behind_the_smoke() -> None:
    image = make_sky()
    found = sky.fit_sky(image)
    assert found is not None
    y = np.linspace(0, 1, 90)[:, None]
    truth = sky.linear_to_srgb(np.array([0.05, 0.16, 0.45]) * (1 - y) + np.array([0.35, 0.4, 0.5]) * y)
    assert np.abs(found.coded[20:50, 70:90] - truth[20:50, None]).max() < 0.02
    line = 60 - 6 * np.sin(np.arange(160) / 30)
    assert np.percentile(np.abs(found.skyline - line), 90) < 3.0
    assert not found.is_clear[42, 80]


def test_no_sky_indoors() -> None:
    rng = np.random.default_rng(0)
    assert sky.fit_sky(rng.random((90, 160, 3)).astype(np.float32)) is None


@pytest.mark.parametrize("shift", [(0.0, 0.0), (14.0, 3.0)])
def test_motion_of_the_picture(shift) -> None:
    """Moved by hand-made homographies: found within a fifth of a pixel, and still is still."""
    rng = np.random.default_rng(0)
    big = cv2.GaussianBlur(rng.random((200, 300, 3)).astype(np.float32), (0, 0), 2.0)
    big = (big - big.min()) / (big.max() - big.min())
    clip = []
    for k in range(8):
        move = np.float32([[1, 0, 30 + shift[0] * k / 7], [0, 1, 30 + shift[1] * k / 7]])
        clip.append(cv2.warpAffine(big, move, (200, 140), flags=cv2.INTER_LINEAR | cv2.WARP_INVERSE_MAP))
    motion = stabilise.measure_motion(clip, range(8))
    assert motion.is_known and not motion.has_parallax
    assert motion.is_still == (shift == (0.0, 0.0))
    centre = motion.to_first[-1] @ [100.0, 70.0, 1.0]
    assert np.abs(centre[:2] / centre[2] - np.array([100.0, 70.0]) - shift).max() < 0.2
    back = stabilise.warp(clip[-1], motion.to_first[-1])
    inner = np.s_[20:120, 20:180]
    assert np.nanmean(np.abs(back[inner] - clip[0][inner])) < 0.01
    blank = stabilise.measure_motion([np.zeros((40, 40, 3), np.float32)] * 4, range(4))
    assert not blank.is_known and blank.is_still
