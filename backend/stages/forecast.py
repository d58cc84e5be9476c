"""The most likely next frames: the last frame's smoke goes on as it went, and the source on emitting.

What is known of the future fades with the horizon. So a share of the smoke stays where it was seen last, a share that
grows; and what moves widens with the way that it has gone. Near frames move, far ones come to rest in a blur between.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Iterator
from dataclasses import replace

import numpy as np

from backend.contract.cameras import Cameras
from backend.contract.job import ForecastConfig, PublishedConfig
from backend.fit.future import Trust, recent_guides, recent_velocity, trust_of
from backend.fit.guide import Guide
from backend.fit.population import PER_PARTICLE, is_near_image, take
from backend.fit.replay import births_at_foot, born_again
from backend.fit.scene import make_scene
from backend.fit.series import Series
from backend.fit.state import PhysicalRecord, VisualRecord, VolumeRecord
from backend.published import future as published_future
from backend.reporting import Report

_REPLAYED = 8  # frames whose births the source repeats: a source that is dying must not live up again


def run(
    layers: Series[np.ndarray],  # [H, W, 4] float32 premultiplied linear RGB and opacity
    cameras: Cameras,
    fluid: Series[PhysicalRecord],
    seen: Series[VisualRecord],
    config: ForecastConfig,
    report: Report,
    *,
    method: str = "default",
    published: PublishedConfig | None = None,  # the settings of the other methods
    volumes: Series[VolumeRecord] | None = None,  # what is proposed for each frame; none: the particles alone tell
) -> Iterator[VisualRecord]:
    """Yields config.num_frames records behind the last frame."""
    if config.num_frames == 0:
        return
    scene = make_scene(layers, cameras)
    view, seconds = scene.views[-1], scene.seconds_per_frame
    if method != "default":
        yield from published_future.run(
            fluid, seen, published or PublishedConfig(), report, num_frames=config.num_frames, view=view, seconds=seconds
        )
        return
    last = seen[len(seen) - 1]
    trust = trust_of(last, config)
    still = replace(last, velocities=np.zeros_like(last.velocities), ids=last.ids + last.next_id)
    guides = recent_guides(volumes, layers, scene) if volumes is not None and len(volumes) >= len(layers) else []
    moving = _going_on(replace(last, next_id=2 * last.next_id), fluid, guides)
    births = [_going_on(newborn, fluid, guides) for newborn in births_at_foot(seen)[-_REPLAYED:]]
    for step in range(config.num_frames):
        report.progress(step, config.num_frames)
        moving = replace(moving, positions=moving.positions + seconds * moving.velocities)
        moving = born_again(moving, births, step)
        moving = take(moving, is_near_image(moving.positions, view))
        yield _expected(moving, still, trust, seconds * (step + 1))
    report.progress(config.num_frames, config.num_frames)


def deviations(last: VisualRecord, config: ForecastConfig, *, seconds: float) -> list[float]:
    """How far parcels are from where they will be, root mean square, m, in each of config.num_frames frames of `seconds`."""
    trust = trust_of(last, config)
    return [trust.deviation(seconds * (step + 1)) for step in range(config.num_frames)]


def _going_on(record: VisualRecord, fluid: Series[PhysicalRecord], guides: list[Guide]) -> VisualRecord:
    return replace(record, velocities=recent_velocity(record.positions, fluid, guides).astype(np.float32))


def _expected(moving: VisualRecord, still: VisualRecord, trust: Trust, seconds: float) -> VisualRecord:
    """The mean over what may have become of the smoke, so many seconds behind the last frame."""
    share, growth = np.float32(trust.share_moved(seconds)), np.float32(trust.growth(seconds))
    wide = replace(moving, scales=np.hypot(moving.scales, growth), optical_masses=share * moving.optical_masses)
    if share == 1.0:
        return wide
    faint = replace(still, optical_masses=(np.float32(1.0) - share) * still.optical_masses)
    names = {item.name for item in dataclasses.fields(wide)} & PER_PARTICLE - {"rotations"}  # round ones, all of them
    return replace(wide, **{name: np.concatenate([getattr(wide, name), getattr(faint, name)]) for name in names})
