"""Presets: how large, how long, how fine. The geometry is the same in all of the benchmark's."""

from __future__ import annotations

from dataclasses import dataclass

from synthetic.layers import Quality
from synthetic.sweep import Orbit


@dataclass(frozen=True, slots=True, kw_only=True)
class Preset:
    """width, height in px; num_frames of which the last num_future are unseen by a method; voxel_size of the solver, m;
    volumes_every: every so many frames the true density and velocity are kept; smoke_every: every so many frames the
    smoke alone is rendered, in all views; views: the input and the test views that are rendered."""

    width: int
    height: int
    num_frames: int
    num_future: int
    fps: float
    voxel_size: float
    steps_per_frame: int
    volumes_every: int
    orbit: Orbit
    quality: Quality
    smoke_every: int = 1
    views: tuple[str, ...] = ("input", "nvs", "side", "back")


_SWEEP = Orbit()  # shows all of the solver's box

PRESETS = {
    # Supplement 7.1: 1080x1920, T' = 270 of which 240 are seen, at most 200 samples. With 256 denoised ones the error
    # would be a quarter smaller than with 64, for 3.7 times the time (docs/results.md).
    "paper": Preset(
        width=1080,
        height=1920,
        num_frames=270,
        num_future=30,
        fps=30.0,
        voxel_size=1 / 15,
        steps_per_frame=2,
        volumes_every=10,
        orbit=_SWEEP,
        quality=Quality(samples=64),
    ),
    # The same nine seconds and the same sweep, every second frame at a sixth of the size.
    "bench": Preset(
        width=180,
        height=320,
        num_frames=135,
        num_future=15,
        fps=15.0,
        voxel_size=1 / 8,
        steps_per_frame=2,
        volumes_every=5,
        orbit=_SWEEP,
        quality=Quality(samples=8, opacity_samples=8),
    ),
    # A look at a scene before it is made: bench with coarse smoke and few samples.
    "draft": Preset(
        width=180,
        height=320,
        num_frames=135,
        num_future=15,
        fps=15.0,
        voxel_size=1 / 3,
        steps_per_frame=2,
        volumes_every=15,
        orbit=_SWEEP,
        quality=Quality(samples=8, opacity_samples=8),
        smoke_every=15,
    ),
    # For tests: the same sweep in a few coarse frames.
    "tiny": Preset(
        width=46,
        height=80,
        num_frames=9,
        num_future=1,
        fps=4.0,
        voxel_size=0.5,
        steps_per_frame=6,
        volumes_every=4,
        orbit=_SWEEP,
        quality=Quality(samples=4, opacity_samples=4),
    ),
    # The bundled clip: a tripod at the sweep's first place.
    "demo": Preset(
        width=320,
        height=480,
        num_frames=72,
        num_future=0,
        fps=24.0,
        voxel_size=0.1,
        steps_per_frame=2,
        volumes_every=12,
        orbit=Orbit(target=(0.6, 0.2, 6.4), distance=26.0, half_height=7.4, azimuth_stop=-105.0),
        quality=Quality(samples=8, opacity_samples=8),
        smoke_every=12,
        views=("input", "side"),
    ),
}
