"""Visual particles: what the smoke looks like. Gaussians that ride on the physical particles, fitted frame by frame."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace

import numpy as np

from backend.contract.cameras import Cameras
from backend.contract.job import PublishedConfig, VisualConfig
from backend.fit.appearance import Appearance
from backend.fit.carry import carry, with_velocities
from backend.fit.depths import Depths
from backend.fit.scene import make_scene
from backend.fit.series import Series
from backend.fit.state import PhysicalRecord, VisualRecord, VolumeRecord
from backend.published import visual as published_visual
from backend.reporting import Report


def run(
    layers: Series[np.ndarray],  # [H, W, 4] float32 premultiplied linear RGB and opacity
    cameras: Cameras,
    fluid: Series[PhysicalRecord],
    config: VisualConfig,
    report: Report,
    *,
    seed: int,
    done: Series[VisualRecord],
    method: str = "default",
    published: PublishedConfig | None = None,  # the settings of the other methods
    volumes: Series[VolumeRecord] | None = None,  # what is proposed for each frame; none: the images alone tell
    as_wide: bool = False,  # smoke is as deep as it is wide, in the volumes and out of them
) -> Iterator[VisualRecord]:
    """Yields the records of the frames behind those that are `done`."""
    if method != "default":
        settings, has_frequency_loss = published or PublishedConfig(), method == "as_published"
        yield from published_visual.run(
            layers, cameras, fluid, settings, report, has_frequency_loss=has_frequency_loss, seed=seed, done=done
        )
        return
    scene = make_scene(layers, cameras)
    depths = Depths(scene, layers, volumes)
    appearance = Appearance(scene, layers, config, seed, depths, as_wide=as_wide)
    first = len(done)
    record = done[first - 1] if first else None
    loss = 0.0
    for frame in range(first, len(layers)):
        report.progress(frame, len(layers), loss=loss)
        if record is None:
            record = appearance.empty()
        else:
            record = _carried(record, frame, depths, fluid)
        record, loss = appearance.look(record, frame)
        record = _with_velocities(record, frame, depths, fluid)
        yield record
    report.progress(len(layers), len(layers), loss=loss)


def _carried(record: VisualRecord, frame: int, depths: Depths, fluid: Series[PhysicalRecord]) -> VisualRecord:
    """The Gaussians of the frame before, moved into this one: by the volumes, else by the physical particles."""
    seconds = depths.scene.seconds_per_frame
    before, after = depths.guide(frame - 1), depths.guide(frame)
    if before is None or after is None:
        return carry(record, fluid[frame], seconds=seconds)
    return replace(record, positions=before.carried(record.positions, after, seconds=seconds))


def _with_velocities(record: VisualRecord, frame: int, depths: Depths, fluid: Series[PhysicalRecord]) -> VisualRecord:
    guide = depths.guide(frame)
    if guide is None:
        return with_velocities(record, fluid[frame])
    return replace(record, velocities=guide.velocity_at(record.positions).astype(np.float32))
