"""The fit at its limits: clips with nothing, too little or too much in them, and scenes of any size, pace and place."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
import pytest

from backend.contract.cameras import Cameras
from backend.contract.job import CamerasConfig
from backend.fit.scene import optical_depth
from backend.io.video import MIN_FRAMES, open_clip
from backend.reporting import SilentReport
from backend.stages import cameras as cameras_stage
from tests.extremes.small_fit import SIZE, Fitted, around, extracted, fit, layer_of, puffs, still
from tests.reference.refusals import told

PART = "Fit"
WIDE = (64, 48, 3)


@pytest.fixture(scope="module")
def usual() -> Fitted:
    return fit([layer_of(tau) for tau in puffs(5)])


def difference(one: Fitted, other: Fitted, *, scale: float = 1.0) -> tuple[float, float]:
    """Largest differences of opacities in the input view, and of the total optical mass, relative; lengths times scale."""
    pictures = max(float(np.abs(a - b).max()) for a, b in zip(one.opacities(), other.opacities(), strict=True))
    masses = [[float(r.optical_masses.sum(dtype=np.float64)) for r in [*fitted.seen, *fitted.ahead]] for fitted in (one, other)]
    return pictures, max(abs(b / scale**2 / a - 1) for a, b in zip(*masses, strict=True))


# -- what a clip may show ----------------------------------------------------------------------------------------------


def test_clips_without_smoke(table):
    """Black, grey and white throughout, whatever the clip is said to be; 16-bit noise."""
    random = np.random.default_rng(0)
    clips = {str(level): [np.full(WIDE, level, np.float32)] * 6 for level in (0.0, 1e-4, 0.2, 1.0)}
    noise = [(random.integers(0, 65536, WIDE) / 65535).astype(np.float32) for _ in range(6)]
    let_through = []
    for mode in ("auto", "on_black", "matte"):
        for name, frames in clips.items():
            error = told(lambda frames=frames, mode=mode: extracted(frames, mode=mode))
            if error is None or error.code != "no_smoke":
                let_through.append((name, mode))
            elif float(name) > 0.5:
                assert "black throughout" not in error.message
    table.row(
        "black, grey and white clips", tried="four levels, three modes", happens="refused: no smoke",
        measure="cases let through", worst=len(let_through), bound=0,
    )  # fmt: skip
    passed = [mode for mode in ("auto", "on_black") if told(lambda mode=mode: extracted(noise, mode=mode)) is None]
    table.row(
        "a clip of 16-bit noise", tried="as it comes, and said to be on black", happens="refused: no background, no smoke",
        measure="cases let through", worst=len(passed), bound=0,
    )  # fmt: skip


def test_clips_that_are_too_short(table, tmp_path: Path):
    frames = [layer_of(tau)[..., :3] for tau in puffs(4)]
    let_through = []
    for count in (1, 2):
        folder = tmp_path / str(count)
        folder.mkdir()
        for number, frame in enumerate(frames[:count]):
            cv2.imwrite(str(folder / f"{number:04d}.png"), (255 * frame).astype(np.uint8))
        error = told(lambda folder=folder: open_clip(folder))
        if error is None or error.code != "clip_too_short":
            let_through.append(count)
    table.row(
        "one frame, two frames", tried="1, 2", happens="refused: too short to see the smoke move", measure="cases let through",
        worst=len(let_through), bound=0,
    )  # fmt: skip
    shortest = fit([layer_of(tau) for tau in puffs(MIN_FRAMES)])
    assert shortest.is_finite()
    table.row(
        "the shortest clip", tried=f"{MIN_FRAMES} frames", happens="fitted and forecast", measure="error of opacity / its mean",
        worst=shortest.worst_opacity(), bound=0.1,
    )  # fmt: skip


def test_a_single_bright_pixel(table):
    frame = np.zeros(WIDE, np.float32)
    frame[30, 20] = 1.0
    layers, _ = extracted([frame] * 5)
    found = fit(layers)
    assert found.is_finite()
    # Of the optical depth: a particle is wider than a pixel, and what is spread out hides more.
    shown = [float(-np.log1p(-opacity.astype(np.float64)).sum()) for opacity in found.opacities()]
    seen = [float(optical_depth(layer).sum(dtype=np.float64)) for layer in layers]
    worst = max(abs(a / b - 1) for a, b in zip(shown, seen, strict=True))
    table.row(
        "a single bright pixel", tried="white on black", happens="fitted as a speck",
        measure="relative error of its optical depth", worst=worst, bound=0.3,
    )  # fmt: skip


def test_any_density_of_the_smoke(table):
    worst = 0.0
    for gain in (1e-2, 0.1, 1.0, 10.0, 1e3):
        found = fit([layer_of(tau) for tau in puffs(4, gain=gain)])
        assert found.is_finite()
        worst = max(worst, found.worst_opacity())
    table.row(
        "density of the smoke", tried="peaks of optical depth from 0.02 to 2000",
        happens="fitted; beyond opacity 0.99 depth is a guess", measure="error of opacity / its mean", worst=worst, bound=0.35,
    )  # fmt: skip


def test_smoke_that_comes_and_goes(table):
    """Frames without smoke before, between and after."""
    taus = puffs(6)
    worst = 0.0
    for shown in ({0, 1, 2}, {3, 4, 5}, {0, 1, 4, 5}, {2}, {0}, {5}):
        layers = [layer_of(tau if frame in shown else 0 * tau) for frame, tau in enumerate(taus)]
        found = fit(layers)
        assert found.is_finite()
        for frame, opacity in enumerate(found.opacities()):
            if frame not in shown:
                worst = max(worst, float(opacity.max()))
    table.row(
        "frames without smoke", tried="before, between, after, all but one", happens="empty there, fitted elsewhere",
        measure="largest opacity in a frame without", worst=worst, bound=1e-3,
    )  # fmt: skip


def test_exposure_steps(table):
    """A stop or more between frames is told; what smoke does by itself is not."""
    frames = [layer_of(tau)[..., :3] for tau in puffs(6)]
    silent = []
    for factor in (0.02, 0.2, 0.45, 2.2, 5.0):
        stepped = [
            np.clip(frame * (factor if index % 2 else 1.0) * min(1.0, 1 / factor), 0, 1) for index, frame in enumerate(frames)
        ]
        layers, report = extracted(stepped)
        if "exposure_steps" not in [code for code, _ in report.warnings]:
            silent.append(factor)
        if factor in (0.02, 5.0):
            assert fit(layers).is_finite()
    _, report = extracted(frames)
    told_of_none = sum(code == "exposure_steps" for code, _ in report.warnings)
    table.row(
        "exposure steps", tried="0.02 to 5 times as bright, every other frame", happens="a warning; the density steps with it",
        measure="steps not told, and told without one", worst=len(silent) + told_of_none, bound=0,
    )  # fmt: skip


# -- how large, how fast, where ----------------------------------------------------------------------------------------


def test_any_scale_of_the_scene(table, usual: Fitted):
    """The distance of the camera is the scene's only metre: everything scales with it."""
    worst, worst_mass = 0.0, 0.0
    for scale in (1e-4, 1e-3, 1e-2, 1e2, 1e4):
        found = fit(usual.layers, still(distance=10.0 * scale))
        assert found.is_finite()
        pictures, masses = difference(usual, found, scale=scale)
        worst, worst_mass = max(worst, pictures), max(worst_mass, masses)
    table.row(
        "scale of the scene", tried="1e-4 to 1e4 of 10 m", happens="results scale with it", measure="difference of opacities",
        worst=worst, bound=0.005,
    )  # fmt: skip
    table.row(
        "optical mass, the same", tried="1e-4 to 1e4 of 10 m", happens="scales with its square", measure="relative difference",
        worst=worst_mass, bound=0.001,
    )  # fmt: skip


def test_any_scale_and_place_of_a_moving_camera(table):
    layers = [layer_of(tau) for tau in puffs(5)]
    here = fit(layers, around(5))
    worst = 0.0
    for scale in (1e-4, 1e4):
        worst = max(worst, difference(here, fit(layers, around(5, scale=scale)), scale=scale)[0])
    table.row(
        "scale, with a camera that goes around", tried="1e-4 and 1e4 of 10 m", happens="results scale with it",
        measure="difference of opacities", worst=worst, bound=0.01,
    )  # fmt: skip
    beside, far = (fit(layers, around(5, away=(place, -place, place))) for place in (1e4, 1e6))  # neither tells of a distance
    assert far.is_finite()
    table.row(
        "distance of the world's origin", tried="1.7e4 and 1.7e6 m, a camera that goes around", happens="the same smoke, there",
        measure="difference of opacities", worst=difference(beside, far)[0], bound=0.005,
    )  # fmt: skip


def test_a_still_camera_far_from_the_origin_says_so(table):
    """One still view tells no depth: smoke stands at the origin. Where the camera does not look there, that is a guess."""

    def warned(cameras: Cameras) -> bool:
        report = SilentReport()
        cameras_stage.run(
            num_frames=3,
            size=SIZE,
            fps=24.0,
            config=CamerasConfig(),
            given=cameras,
            motion=lambda: pytest.fail("asked"),
            report=report,
        )
        return "camera_misses_origin" in [code for code, _ in report.warnings]

    here = around(1)
    wrong = sum(warned(cameras) for cameras in (here, still(), still(distance=1e6), around(1, scale=1e-4)))
    for away in ((1e6, 0.0, 0.0), (1e6, -1e6, 1e6), (0.0, 1e6, 0.0), (0.0, 0.0, 30.0)):
        wrong += not warned(around(1, away=away))
    table.row(
        "a still camera that misses the world's origin", tried="30 m to 1.7e6 m off, and four that look there",
        happens="a warning: how large the smoke is, is a guess", measure="wrong answers", worst=wrong, bound=0,
    )  # fmt: skip


def test_any_frame_rate(table, usual: Fitted):
    worst = 0.0
    for fps in (0.01, 1.0, 1000.0):
        found = fit(usual.layers, still(fps=fps))
        assert found.is_finite()
        worst = max(worst, found.worst_opacity())
    table.row(
        "frame rate", tried="0.01 to 1000 frames a second", happens="fitted; speeds are by the second",
        measure="error of opacity / its mean", worst=worst, bound=0.1,
    )  # fmt: skip


def test_any_field_of_view(table, usual: Fitted):
    worst = 0.0
    for degrees in (0.1, 1.0, 90.0, 170.0):
        found = fit(usual.layers, still(fov=degrees))
        assert found.is_finite()
        worst = max(worst, found.worst_opacity())
    table.row(
        "field of view", tried="0.1 to 170 degrees", happens="fitted", measure="error of opacity / its mean", worst=worst,
        bound=0.4,
    )  # fmt: skip


def test_every_method_at_the_extremes(table):
    """The published methods are baselines; they must not fall over either."""
    broken, tried = [], 0
    speck = [np.zeros((64, 48), np.float32) for _ in range(3)]
    for tau in speck:
        tau[30, 20] = 4.0
    gone = puffs(3)
    gone[1] = 0 * gone[1]
    for method in ("default", "as_published", "fluidnexus"):
        for taus in (speck, gone, puffs(3, gain=1e3)):
            for cameras in (still(distance=1e-3), still(distance=1e4)):
                tried += 1
                if not fit([layer_of(tau) for tau in taus], cameras, method=method).is_finite():
                    broken.append((method, cameras))
    table.row(
        "every method", tried=f"{tried} cases: a speck, a gap, opaque smoke, 1e-3 and 1e4 m", happens="finite results",
        measure="cases that are not", worst=len(broken), bound=0,
    )  # fmt: skip


def test_gradients_of_a_frame_at_the_extremes():
    """A camera inside the smoke, with its near plane among the particles."""
    layers = [layer_of(tau) for tau in puffs(3)]
    inside = around(3, scale=0.02)
    assert isinstance(inside, Cameras)
    assert fit(layers, inside).is_finite()
