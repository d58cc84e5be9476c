"""The most likely next frames: the last frame's smoke carried on by its own, slowly fading motion.

What is known of the future fades with the horizon, so each step also pulls the smoke back a little to what the last
frame shows, as seen from its camera: near frames move, far ones come to rest at the frozen frame.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import replace

import numpy as np

from backend.contract.cameras import Cameras
from backend.contract.job import ForecastConfig, PublishedConfig, VisualConfig
from backend.fit.appearance import Appearance
from backend.fit.carry import carry, with_velocities
from backend.fit.scene import make_scene
from backend.fit.series import Series
from backend.fit.state import PhysicalRecord, VisualRecord
from backend.published import future as published_future
from backend.reporting import Report


def run(
    layers: Series[np.ndarray],  # [H, W, 4] float32 premultiplied linear RGB and opacity
    cameras: Cameras,
    fluid: Series[PhysicalRecord],
    seen: Series[VisualRecord],
    configs: tuple[ForecastConfig, VisualConfig],
    report: Report,
    *,
    seed: int,
    method: str = "default",
    published: PublishedConfig | None = None,  # the settings of the other methods
) -> Iterator[VisualRecord]:
    """Yields config.num_frames records behind the last frame."""
    config, visual = configs
    scene = make_scene(layers, cameras)
    last_fluid, last_seen = fluid[len(fluid) - 1], seen[len(seen) - 1]
    if method != "default":
        yield from published_future.run(
            fluid, seen, published or PublishedConfig(), report,
            num_frames=config.num_frames, view=scene.views[-1], seconds=scene.seconds_per_frame,
        )  # fmt: skip
        return
    appearance = Appearance(scene, layers, replace(visual, iterations=0), seed + 1)
    record, last = last_seen, len(layers) - 1
    for step in range(config.num_frames):
        report.progress(step, config.num_frames)
        fading = math.exp(-config.damping * (step + 0.5) * scene.seconds_per_frame)
        faded = replace(last_fluid, velocities=fading * last_fluid.velocities)
        record = carry(record, faded, seconds=scene.seconds_per_frame)
        record, _ = appearance.look(record, last, consistency=config.persistence)
        record = with_velocities(record, faded)
        yield record
    report.progress(config.num_frames, config.num_frames)
