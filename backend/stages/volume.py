"""Where in depth the smoke is and how it moves: for each frame what the prior proposes, on a grid before its camera."""

from __future__ import annotations

from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace

import numpy as np
import torch

from backend.contract.cameras import Cameras
from backend.fit.pace import stride_of
from backend.fit.region import find_region
from backend.fit.scene import make_scene
from backend.fit.series import Series
from backend.fit.sharpen import agreed, sharpened
from backend.fit.state import VolumeRecord
from backend.geometry.upright import turned, up_of, upright
from backend.prior.predict import Prior, Proposal, one_thread
from backend.reporting import Report

_MOST_AT_ONCE = 8  # frames; each takes some 70 MB while it is computed


def run(
    layers: Series[np.ndarray],  # [H, W, 4] float32 premultiplied linear RGB and opacity
    cameras: Cameras,
    report: Report,
    *,
    prior: Prior,
    done: Series[VolumeRecord],
    stride: int = 0,  # frames between the images that are compared; 0: found from the motion
    num_workers: int = 0,  # frames at once, each in a thread; 0: as many as torch has threads. The bytes are the same
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
    stride = stride or stride_of(region)

    def proposed(frame: int) -> Proposal:
        return prior.propose(
            lambda number: region.depths[number],
            lambda number: region.views[number],
            region.centre,
            region.source,
            frame,
            voxel_size=region.voxel_size,
            stride=stride,
            num_frames=len(layers),
            seconds_per_frame=scene.seconds_per_frame,
        )

    def recorded(proposal: Proposal, frame: int) -> VolumeRecord:
        density = agreed(sharpened(proposal.density), proposal.stand, region.depths[frame], region.views[frame])
        density, density_unit = _halved(density)
        velocity, velocity_unit = _halved(proposal.velocity @ straight[:3, :3].astype(np.float32))
        return VolumeRecord(
            density=density,
            velocity=velocity,
            from_world=proposal.stand.from_world @ straight,
            voxel_size=np.asarray(region.voxel_size),
            density_unit=density_unit,
            velocity_unit=velocity_unit,
        )

    at_once = min(num_workers or torch.get_num_threads(), _MOST_AT_ONCE)
    with ThreadPoolExecutor(at_once) as pool:
        for first in range(len(done), len(layers), at_once):
            report.progress(first, len(layers))
            with one_thread():
                proposals = list(pool.map(proposed, range(first, min(first + at_once, len(layers)))))
            for frame, proposal in enumerate(proposals, start=first):
                yield recorded(proposal, frame)
    report.progress(len(layers), len(layers))


def _halved(values: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Values as float16 in units of the largest, and that unit [] float64: eleven bits, whatever the size."""
    unit = float(np.abs(values).max(initial=0.0)) or 1.0
    return (values / np.float32(unit)).astype(np.float16), np.asarray(unit)
