"""Visual particles: what the smoke looks like. Gaussians that ride on the physical particles, fitted frame by frame."""

from __future__ import annotations

from collections.abc import Iterator

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
) -> Iterator[VisualRecord]:
    """Yields the records of the frames behind those that are `done`."""
    if method != "default":
        settings, has_frequency_loss = published or PublishedConfig(), method == "as_published"
        yield from published_visual.run(
            layers, cameras, fluid, settings, report, has_frequency_loss=has_frequency_loss, seed=seed, done=done
        )
        return
    scene = make_scene(layers, cameras)
    appearance = Appearance(scene, layers, config, seed, Depths(scene, layers, volumes))
    first = len(done)
    record = done[first - 1] if first else None
    loss = 0.0
    for frame in range(first, len(layers)):
        report.progress(frame, len(layers), loss=loss)
        if record is None:
            record = appearance.empty()
        else:
            record = carry(record, fluid[frame], seconds=scene.seconds_per_frame)
        record, loss = appearance.look(record, frame)
        record = with_velocities(record, fluid[frame])
        yield record
    report.progress(len(layers), len(layers), loss=loss)
