"""Where in depth the smoke is and how it moves: for each frame what the prior proposes, on a grid before its camera."""

from __future__ import annotations

from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, replace

import numpy as np
import torch

from backend.contract.cameras import Cameras
from backend.fit.between import between
from backend.fit.pace import stride_of
from backend.fit.region import Region, find_region
from backend.fit.scene import make_scene
from backend.fit.series import Series
from backend.fit.sharpen import agreed, sharpened
from backend.fit.state import VolumeRecord
from backend.geometry.upright import turned, up_of, upright
from backend.prior.predict import SHAPE, Prior, Proposal, one_thread
from backend.prior.window import stand_before
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
    every: int = 1,  # frames, at most a stride: the prior is asked so often; what lies between comes from both sides
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
    last = len(layers) - 1
    if region is None or len(done) > last:
        return
    stride = stride or stride_of(region)
    every = min(every, stride)
    asking = _Asking(prior=prior, region=region, straight=straight, stride=stride, seconds=scene.seconds_per_frame)
    asked = [*range(len(done) // every * every, last, every), last]
    at_once = min(num_workers or torch.get_num_threads(), _MOST_AT_ONCE)
    frame, before = len(done), None
    with ThreadPoolExecutor(at_once) as pool:
        for first in range(0, len(asked), at_once):
            report.progress(frame, len(layers))
            part = asked[first : first + at_once]
            with one_thread():
                answers = list(pool.map(asking.proposed, part))
            for after in zip(part, answers, strict=True):
                while frame <= after[0]:
                    yield asking.recorded(asking.amid(before or after, after, frame), frame)
                    frame += 1
                before = after
    report.progress(len(layers), len(layers))


@dataclass(frozen=True, slots=True, kw_only=True)
class _Asking:
    """A clip in its upright world. straight [4, 4]: the clip's own to that; stride: frames; seconds: of a frame."""

    prior: Prior
    region: Region
    straight: np.ndarray
    stride: int
    seconds: float

    def proposed(self, frame: int) -> Proposal:
        region = self.region
        return self.prior.propose(
            lambda number: region.depths[number],
            lambda number: region.views[number],
            region.centre,
            region.source,
            frame,
            voxel_size=region.voxel_size,
            stride=self.stride,
            num_frames=len(region.depths),
            seconds_per_frame=self.seconds,
        )

    def amid(self, before: tuple[int, Proposal], after: tuple[int, Proposal], frame: int) -> Proposal:
        """Of a frame behind the one and not behind the other."""
        if frame == after[0]:
            return after[1]
        region, count = self.region, after[0] - before[0]
        stand = stand_before(region.views[frame], region.centre, voxel_size=region.voxel_size, shape=SHAPE)
        share = (frame - before[0]) / count
        return between(before[1], after[1], stand, share=share, seconds=count * self.seconds)

    def recorded(self, proposal: Proposal, frame: int) -> VolumeRecord:
        """In the clip's own world, as the frame shows it."""
        region = self.region
        density = agreed(sharpened(proposal.density), proposal.stand, region.depths[frame], region.views[frame])
        density, density_unit = _halved(density)
        velocity, velocity_unit = _halved(proposal.velocity @ self.straight[:3, :3].astype(np.float32))
        return VolumeRecord(
            density=density,
            velocity=velocity,
            from_world=proposal.stand.from_world @ self.straight,
            voxel_size=np.asarray(region.voxel_size),
            density_unit=density_unit,
            velocity_unit=velocity_unit,
        )


def _halved(values: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Values as float16 in units of the largest, and that unit [] float64: eleven bits, whatever the size."""
    unit = float(np.abs(values).max(initial=0.0)) or 1.0
    return (values / np.float32(unit)).astype(np.float16), np.asarray(unit)
