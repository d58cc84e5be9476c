"""Where in depth the smoke is and how it moves: for each frame what the prior proposes, on a grid before its camera."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace

import numpy as np

from backend.contract.cameras import Cameras
from backend.fit.pace import stride_of
from backend.fit.region import find_region
from backend.fit.scene import make_scene
from backend.fit.series import Series
from backend.fit.state import VolumeRecord
from backend.geometry.upright import turned, up_of, upright
from backend.prior.predict import Prior
from backend.reporting import Report


def run(
    layers: Series[np.ndarray],  # [H, W, 4] float32 premultiplied linear RGB and opacity
    cameras: Cameras,
    report: Report,
    *,
    prior: Prior,
    done: Series[VolumeRecord],
    stride: int = 0,  # frames between the images that are compared; 0: found from the motion
) -> Iterator[VolumeRecord]:
    """Yields the records of the frames behind those that are `done`; none of a clip without smoke.

    The prior knows upright worlds only: the scene is turned upright before it is asked, and its answer back.
    """
    scene = make_scene(layers, cameras)
    straight = upright(up_of(scene.views))
    anchor = straight[:3, :3] @ scene.anchor
    scene = replace(scene, views=tuple(turned(view, straight) for view in scene.views), anchor=anchor)
    region = find_region(layers, scene)
    if region is None:
        return
    for frame in range(len(done), len(layers)):
        report.progress(frame, len(layers))
        proposal = prior.propose(
            lambda number: region.depths[number],
            lambda number: region.views[number],
            region.centre,
            region.source,
            frame,
            voxel_size=region.voxel_size,
            stride=stride or stride_of(region),
            num_frames=len(layers),
            seconds_per_frame=scene.seconds_per_frame,
        )
        yield VolumeRecord(
            density=proposal.density,
            velocity=proposal.velocity @ straight[:3, :3].astype(np.float32),
            from_world=proposal.stand.from_world @ straight,
            voxel_size=np.asarray(region.voxel_size),
        )
    report.progress(len(layers), len(layers))
