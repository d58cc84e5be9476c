"""Where in depth the smoke is and how it moves: for each frame what the prior proposes, on a grid before its camera.

First the grids are brought to where the smoke is, by what the prior says of a few frames (`centred`); then it is asked about
more frames (`propose`), which takes most of the time; then what it said is carried to those between, and brought to agree with
what lasts around a frame and with what the frame shows (`run`).
"""

from __future__ import annotations

from bisect import bisect_left
from collections.abc import Callable, Iterator, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, replace
from functools import partial

import numpy as np
import torch

from backend.contract.cameras import Cameras
from backend.fit.as_wide import as_deep_as_wide, larger, too_near
from backend.fit.between import between
from backend.fit.closer import closer
from backend.fit.guide import Guide
from backend.fit.lasting import Lasting
from backend.fit.levelled import Levels
from backend.fit.pace import gap_of, stride_of
from backend.fit.region import FINER, ROUNDS, Pictures, Region, find_region, num_probes
from backend.fit.scene import make_scene
from backend.fit.series import Series
from backend.fit.sharpen import agreed, sharpened
from backend.fit.state import VolumeRecord
from backend.fit.weighed import Weighing
from backend.geometry.upright import turned, up_of, upright
from backend.prior.levels import LevelNet
from backend.prior.predict import Prior, Proposal, one_thread
from backend.prior.shares import ShareNet
from backend.prior.window import SHAPE, Stand, stand_before
from backend.reporting import Report

_MOST_AT_ONCE = 8  # frames; each takes some 70 MB while it is computed
_LONGER = 8  # a proposal takes as long as so many records
_NEAR_ENOUGH = 0.5  # voxels that the middle moves at most in a last round


@dataclass(frozen=True, slots=True, kw_only=True)
class Plan:
    """A clip in its upright world. straight [4, 4]: the clip's own to that; stride: frames; seconds: of a frame; asked: the
    frames that the prior is asked about, the first and the last among them; as_wide: smoke is as deep as it is wide; larger:
    times as large and as far away as the prior says, so that it rises from where it is taken to."""

    region: Region
    straight: np.ndarray
    stride: int
    seconds: float
    asked: tuple[int, ...]
    as_wide: bool = False
    larger: float = 1.0

    @property
    def work(self) -> int:
        """Steps of its progress."""
        return _LONGER * (self.probes + len(self.asked)) + self.region.num_frames

    @property
    def probes(self) -> int:
        """Frames that the prior is asked about at most before the grids stand where they stay."""
        return ROUNDS * num_probes(len(self.asked))

    def proposed(self, prior: Prior, frame: int) -> Proposal:
        """The prior's own word on a frame."""
        region = self.region
        return self._said(prior, frame, region.pictures, region.centre, fineness=1.0)

    def refined(self, prior: Prior, frame: int) -> Proposal:
        """The same, where wanted on finer voxels with what the prior sees when it looks closer."""
        proposal, region = self.proposed(prior, frame), self.region
        if region.fineness == 1.0:
            return proposal
        return closer(proposal, self._stand(frame), partial(self._said, prior, frame, region.finer, fineness=region.fineness))

    def _said(self, prior: Prior, frame: int, shown: Pictures, centre: np.ndarray, *, fineness: float) -> Proposal:
        return prior.propose(
            lambda number: shown.depths[number],
            lambda number: shown.views[number],
            centre,
            self.region.source,
            frame,
            voxel_size=self.region.voxel_size / fineness,
            stride=max(1, round(self.stride / fineness)),
            num_frames=len(shown.depths),
            seconds_per_frame=self.seconds,
        )

    def _stand(self, frame: int) -> Stand:
        """The voxels before the camera of a frame on which its record stands."""
        region = self.region
        view = region.pictures.views[frame]
        return stand_before(view, region.centre, voxel_size=region.finer_size, shape=region.finely(SHAPE))

    def amid(self, near: Mapping[int, Proposal], later: int, frame: int) -> Proposal:
        """Of a frame not behind that of `later` among those asked, and behind the one before it. near: proposals of both."""
        last = self.asked[later]
        if frame == last:
            return near[later]
        first = self.asked[later - 1]
        share, seconds = (frame - first) / (last - first), (last - first) * self.seconds
        return between(near[later - 1], near[later], self._stand(frame), share=share, seconds=seconds)

    def agreed(self, density: np.ndarray, stand: Stand, frame: int) -> np.ndarray:
        """Density [X, Y, Z] 1/m on the voxels of a stand, as the frame shows it."""
        picture, view = self.region.finer.of(frame)
        if self.as_wide:
            density = as_deep_as_wide(density, stand, picture, view, self.region.source, finer=self.region.fineness)
        return agreed(density, stand, picture, view)

    def record(self, proposal: Proposal, frame: int) -> VolumeRecord:
        """In the clip's own world."""
        if self.larger != 1.0:
            proposal = larger(proposal, self.region.pictures.views[frame].position, self.larger)
        velocity = proposal.velocity @ self.straight[:3, :3].astype(np.float32)
        return _packed(replace(proposal, velocity=velocity), proposal.stand.from_world @ self.straight)


def make_plan(
    layers: Series[np.ndarray],
    cameras: Cameras,
    *,
    stride: int = 0,
    every: int = 1,
    finer: bool = True,
    as_wide: bool = False,
) -> Plan | None:
    """None of a clip without smoke. layers: [H, W, 4] float32 premultiplied linear RGB and opacity.

    stride: frames between the images that are compared; 0: found from the motion. every: frames, at most two strides: the prior
    is asked so often. finer: on finer voxels than the prior's, looked at closer. as_wide: smoke is as deep as it is wide. The
    prior knows upright worlds only: the scene is turned upright before it is asked, its answer back.
    """
    scene = make_scene(layers, cameras)
    straight = upright(up_of(scene.views))
    anchor = straight[:3, :3] @ scene.anchor
    scene = replace(scene, views=tuple(turned(view, straight) for view in scene.views), anchor=anchor)
    region = find_region(layers, scene, fineness=FINER if finer else 1.0)
    if region is None:
        return None
    stride, last = stride or stride_of(region), len(layers) - 1
    asked = (*range(0, last, gap_of(every, stride=stride)), last)
    return Plan(region=region, straight=straight, stride=stride, seconds=scene.seconds_per_frame, asked=asked, as_wide=as_wide)


def centred(plan: Plan, report: Report, *, prior: Prior, num_done: int = 0, num_workers: int = 0) -> Plan:
    """The plan with its grids around the middle of the smoke, as the prior sees it in a few frames.

    From the pictures alone smoke that drifts sideways is not told from smoke further away or nearer: grids that stand by that
    can miss much of it. What the prior says of a grid that holds part of it points to the rest. num_done: asked frames that were
    answered before; num_workers: as for `propose`.
    """
    last, count = plan.region.num_frames - 1, num_probes(len(plan.asked))
    frames = [round(last * (index + 1) / (count + 1)) for index in range(count)]
    for number in range(ROUNDS):
        moment, mass = np.zeros(3), 0.0
        region, done = plan.region, _LONGER * (num_done + count * number)
        ask = partial(plan.proposed, prior)
        for frame, answer in zip(frames, _answers(plan, report, frames, ask, num_workers, done=done), strict=True):
            density = agreed(answer.density, answer.stand, *region.pictures.of(frame)).astype(np.float64)
            moment += density.ravel() @ answer.stand.centres().reshape(-1, 3)
            mass += float(density.sum())
        if not mass > 0.0:
            break
        centre = np.array([*(moment[:2] / mass), region.centre[2]])
        plan = replace(plan, region=replace(region, centre=centre))
        if np.linalg.norm(centre - region.centre) <= _NEAR_ENOUGH * region.voxel_size:
            break
    return plan


def propose(
    plan: Plan,
    report: Report,
    *,
    prior: Prior,
    done: Series[VolumeRecord],
    num_workers: int = 0,  # frames at once, each in a thread; 0: as many as torch has threads. The bytes are the same
) -> Iterator[VolumeRecord]:
    """Yields what the prior says of the asked frames behind those that are `done`, in the upright world: each one's own word."""
    num_done = len(done)
    ask, done_work = partial(plan.refined, prior), _LONGER * (plan.probes + num_done)
    for answer in _answers(plan, report, plan.asked[num_done:], ask, num_workers, done=done_work):
        yield _packed(answer, answer.stand.from_world)


def run(
    plan: Plan, report: Report, proposals: Series[VolumeRecord], *, levels: LevelNet | None, shares: ShareNet | None
) -> Iterator[VolumeRecord]:
    """Yields the records of all frames. proposals: what `propose` made of all asked frames; levels, shares: the prior's small
    networks, None where it has none. That of shares was taught on finer voxels, and needs the other's word; where smoke is as
    deep as it is wide it is not asked."""
    levelling, weighing = levels_of(plan, proposals, levels), None
    if levelling is not None and shares is not None and plan.region.fineness > 1.0 and not plan.as_wide:
        weighing = Weighing(region=plan.region, levels=levelling, net=shares)
    if plan.as_wide:
        said = ((_unpacked(proposals[index]), frame) for index, frame in enumerate(plan.asked))
        feet = (each if levelling is None else levelling.levelled(each, frame) for each, frame in said)
        plan = replace(plan, larger=too_near(feet, plan.region))
    for word in words(plan, proposals, levelling, range(plan.region.num_frames)):
        density = word.sharp
        if weighing is not None:
            density = plan.agreed(weighing.weighed(word.said, word.sharp, word.lasts, word.frame), word.said.stand, word.frame)
        yield plan.record(replace(word.levelled, density=density), word.frame)
        report.progress(plan.work - plan.region.num_frames + word.frame + 1, plan.work)


def levels_of(plan: Plan, proposals: Series[VolumeRecord], net: LevelNet | None) -> Levels | None:
    """None where the prior has no network of them."""
    if net is None:
        return None
    levels = Levels(plan.region, net, stride=plan.stride)
    levels.weigh((_unpacked(proposals[index]), frame) for index, frame in enumerate(plan.asked))
    return levels


@dataclass(frozen=True, slots=True, kw_only=True)
class Word:
    """Of a frame, on the voxels of its record: what the prior's large network says of it, the same with its levels where the
    whole clip has them, what lasts around it, and what fixed powers make of these [X, Y, Z] 1/m."""

    frame: int
    said: Proposal
    levelled: Proposal
    lasts: np.ndarray
    sharp: np.ndarray


def words(plan: Plan, proposals: Series[VolumeRecord], levels: Levels | None, frames: Sequence[int]) -> Iterator[Word]:
    """Of some frames, in order."""

    def levelled(said: Proposal, frame: int) -> Proposal:
        return said if levels is None else levels.levelled(said, frame)

    lasting = Lasting(
        plan.region, lambda index: levelled(_unpacked(proposals[index]), plan.asked[index]), plan.asked, stride=plan.stride
    )
    near: dict[int, Proposal] = {}
    for frame in frames:
        later = bisect_left(plan.asked, frame)
        near = {index: near[index] if index in near else _unpacked(proposals[index]) for index in {max(later - 1, 0), later}}
        said = plan.amid(near, later, frame)
        own = levelled(said, frame)
        lasts = lasting.at(own.stand, frame)
        sharp = plan.agreed(sharpened(own.density, lasts), own.stand, frame)
        yield Word(frame=frame, said=said, levelled=own, lasts=lasts, sharp=sharp)


def _answers(
    plan: Plan, report: Report, frames: Sequence[int], ask: Callable[[int], Proposal], num_workers: int, *, done: int
) -> Iterator[Proposal]:
    """What the prior says of some frames, in order. done: steps of the stage's progress before them."""
    at_once = min(num_workers or torch.get_num_threads(), _MOST_AT_ONCE)
    with ThreadPoolExecutor(at_once) as pool:
        for first in range(0, len(frames), at_once):
            report.progress(done + _LONGER * first, plan.work)
            with one_thread():
                answers = list(pool.map(ask, frames[first : first + at_once]))
            yield from answers


def _packed(proposal: Proposal, from_world: np.ndarray) -> VolumeRecord:
    density, density_unit = _halved(proposal.density)
    velocity, velocity_unit = _halved(proposal.velocity)
    return VolumeRecord(
        density=density,
        velocity=velocity,
        from_world=from_world,
        voxel_size=np.asarray(proposal.stand.lattice.voxel_size),
        density_unit=density_unit,
        velocity_unit=velocity_unit,
    )


def _unpacked(record: VolumeRecord) -> Proposal:
    guide = Guide(record)
    return Proposal(stand=guide.stand, density=guide.density, velocity=guide.velocity)


def _halved(values: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Values as float16 in units of the largest, and that unit [] float64: eleven bits, whatever the size."""
    unit = float(np.abs(values).max(initial=0.0)) or 1.0
    return (values / np.float32(unit)).astype(np.float16), np.asarray(unit)
