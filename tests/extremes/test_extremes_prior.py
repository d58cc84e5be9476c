"""The prior at its limits: nothing to see and far too much, clips of one frame, worlds of any size, pace and place."""

from __future__ import annotations

import math
from collections.abc import Callable

import numpy as np
import pytest

from backend.geometry.camera import View
from backend.prior.predict import Prior, Proposal
from backend.stages import volume
from tests.extremes.small_fit import around, fit, layer_of, puffs
from tests.reference.refusals import refuses

PART = "Prior"
WIDTH, HEIGHT = 24, 40


@pytest.fixture(scope="module")
def prior() -> Prior:
    """As it ships."""
    return Prior()


def view(*, scale: float = 1.0, away: float = 0.0, down: float = 0.0) -> View:
    """10 m before the smoke, `down` radians from level."""
    matrix = np.eye(4)
    c, s = math.cos(down), math.sin(down)
    matrix[:3, :3] = np.array([[1.0, 0.0, 0.0], [0.0, -s, -c], [0.0, c, -s]]).T
    matrix[:3, 3] = scale * 10.0 * np.array([0.0, -c, s]) + away
    return View(width=WIDTH, height=HEIGHT, fx=40.0, fy=40.0, cx=WIDTH / 2, cy=HEIGHT / 2, camera_to_world=matrix)


def rising(frame: int) -> np.ndarray:
    """A blob that rises, optical depth [h, w]."""
    y, x = np.mgrid[0:HEIGHT, 0:WIDTH] + 0.5
    return np.exp(-((x - 12) ** 2 + (y - 30 + frame) ** 2) / 30).astype(np.float32)


def ask(
    prior: Prior,
    *,
    depth_at: Callable[[int], np.ndarray] = rising,
    scale: float = 1.0,
    away: float = 0.0,
    down: float = 0.0,
    seconds: float = 1 / 24,
    num_frames: int = 8,
    stride: int = 1,
) -> Proposal:
    place = np.full(3, away)
    return prior.propose(
        depth_at, lambda _: view(scale=scale, away=away, down=down), place, place - (0.0, 0.0, 2.0 * scale),
        min(3, num_frames - 1), voxel_size=0.25 * scale, stride=stride, num_frames=num_frames, seconds_per_frame=seconds,
    )  # fmt: skip


def test_any_picture(table, prior: Prior):
    def pixel(_: int) -> np.ndarray:
        image = np.zeros((HEIGHT, WIDTH), np.float32)
        image[20, 12] = 4.0
        return image

    noise = np.random.default_rng(0).random((8, HEIGHT, WIDTH)).astype(np.float32)
    pictures = {
        "black": lambda _: np.zeros((HEIGHT, WIDTH), np.float32),
        "a pixel": pixel,
        "opaque throughout": lambda _: np.full((HEIGHT, WIDTH), 4.6, np.float32),
        "noise": lambda frame: noise[frame],
        "1e-20": lambda frame: 1e-20 * rising(frame),
        "1e6": lambda frame: 1e6 * rising(frame),
        "one frame of eight": lambda frame: rising(frame) * (frame == 3),
        "seven of eight": lambda frame: rising(frame) * (frame != 3),
    }
    broken = []
    for name, depth_at in pictures.items():
        found = ask(prior, depth_at=depth_at)
        is_good = np.isfinite(found.density).all() and np.isfinite(found.velocity).all() and (found.density >= 0).all()
        if not is_good or (name in ("black", "seven of eight") and found.density.any()):
            broken.append(name)
    assert not broken
    table.row(
        "pictures", tried=", ".join(pictures), happens="finite, nowhere negative, no smoke where a frame shows none",
        measure="cases that are not", worst=len(broken), bound=0,
    )  # fmt: skip


def test_any_density_scale_pace_and_place(table, prior: Prior):
    """The network knows neither metres nor seconds nor how dense smoke is: its answer scales with them."""
    usual = ask(prior)
    largest, fastest = usual.density.max(), np.abs(usual.velocity).max()

    def off(found: Proposal, density: float, velocity: float) -> float:
        a = np.abs(found.density / density - usual.density).max() / largest
        return float(max(a, np.abs(found.velocity / velocity - usual.velocity).max() / fastest))

    scales = {scale: off(ask(prior, scale=scale), 1 / scale, scale) for scale in (1e-6, 1e-4, 1e-2, 1e2, 1e4, 1e6)}
    table.row(
        "scale of the scene", tried="1e-6 to 1e6 of 10 m", happens="the answer scales with it", measure="difference / largest",
        worst=max(scales.values()), bound=1e-3,
    )  # fmt: skip
    gains = [off(ask(prior, depth_at=lambda f, g=gain: g * rising(f)), gain, 1.0) for gain in (1e-6, 1e-3, 1e3, 1e6)]
    table.row(
        "optical depth", tried="1e-6 to 1e6 times", happens="density scales with it, the motion stays",
        measure="difference / largest", worst=max(gains), bound=1e-3,
    )  # fmt: skip
    paces = [off(ask(prior, seconds=seconds), 1.0, 1 / 24 / seconds) for seconds in (1e-3, 1.0, 100.0)]
    table.row(
        "seconds a frame", tried="1e-3 to 100", happens="velocity scales with their inverse", measure="difference / largest",
        worst=max(paces), bound=1e-5,
    )  # fmt: skip
    table.row(
        "distance of the world's origin", tried="1e6 m along each axis", happens="the same answer",
        measure="difference / largest", worst=off(ask(prior, away=1e6 + 1 / 3), 1.0, 1.0), bound=1e-3,
    )  # fmt: skip


def test_any_clip_and_camera(table, prior: Prior):
    broken, tried = 0, 0
    for num_frames in (1, 2, 3):
        for stride in (1, 60):
            found = ask(prior, num_frames=num_frames, stride=stride)
            broken += not (np.isfinite(found.density).all() and np.isfinite(found.velocity).all())
            tried += 1
    for scale, down in ((1.0, math.pi / 2), (1.0, -math.pi / 2), (1.0, 1.3), (1e-4, math.pi / 2)):
        found = ask(prior, scale=scale, down=down)
        broken += not (np.isfinite(found.density).all() and np.isfinite(found.velocity).all())
        tried += 1
    table.row(
        "clips and cameras", tried=f"{tried} cases: 1 to 3 frames, strides 1 and 60, cameras that look straight down and up",
        happens="finite", measure="cases that are not", worst=broken, bound=0,
    )  # fmt: skip


def test_a_number_that_is_none_is_refused(table, prior: Prior):
    let_through = [
        bad for bad in (np.nan, np.inf, -np.inf) if not refuses(lambda b=bad: ask(prior, depth_at=lambda f: b * rising(f)), "NaN")
    ]
    assert not let_through
    table.row(
        "NaN and infinity in a picture", tried="3 cases", happens="refused", measure="cases let through",
        worst=len(let_through), bound=0,
    )  # fmt: skip


def test_the_stage_and_what_follows_it(table, prior: Prior):
    """A camera that goes around: no smoke, a speck, a gap; at two scales and far from the origin."""
    assert volume.make_plan([layer_of(0 * tau) for tau in puffs(3)], around(3)) is None
    speck = np.zeros((64, 48), np.float32)
    speck[30, 20] = 4.0
    gone = puffs(3)
    gone[1] = 0 * gone[1]
    broken, tried = 0, 0
    for taus in ([speck] * 3, gone):
        for cameras in (around(3, scale=1e-4), around(3, scale=1e4, away=(1e6, 0.0, -1e6))):
            tried += 1
            broken += not fit([layer_of(tau) for tau in taus], cameras, prior=prior).is_finite()
    layers = [layer_of(tau) for tau in puffs(4)]
    here = fit(layers, around(4), prior=prior)

    def off(scale: float) -> float:
        there = fit(layers, around(4, scale=scale), prior=prior).opacities()
        return float(max(np.abs(a - b).mean() for a, b in zip(here.opacities(), there, strict=True)))

    table.row(
        "a fit that is led by the prior", tried=f"{tried} cases: a speck, a gap, 1e-3 m and 1e5 m, far from the origin",
        happens="finite", measure="cases that are not", worst=broken, bound=0,
    )  # fmt: skip
    table.row(
        "scale of such a fit, by powers of two", tried="2^-13 and 2^13 of 10 m: numbers are rounded alike",
        happens="the same pictures", measure="mean difference of opacities", worst=max(off(2.0**-13), off(2.0**13)), bound=1e-3,
    )  # fmt: skip
    table.row(
        "scale of such a fit", tried="1e-4 to 1e4 of 10 m",
        happens="the same pictures, but for rounding that grows with the frames", measure="mean difference of opacities",
        worst=max(off(scale) for scale in (1e-4, 1e-2, 10.0, 1e4)), bound=0.01,
    )  # fmt: skip
