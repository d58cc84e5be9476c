"""The most likely next frames: the last frame's smoke goes on as it went, and the source on emitting.

What is known of the future fades with the horizon. So a share of the smoke stays where it was seen last, a share that
grows; and what moves widens with the way that it has gone. Near frames move, far ones come to rest in a blur between.

Smoke that looks the same while it flows, or a prior that sees motion where there is none, would be moved wrongly: before a camera
that stands still the last frames that were seen are foretold from those before, and where they have changed by less than that,
less of the smoke moves. Before one that moves, what is wrong in depth looks like such a change as well.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Iterator
from dataclasses import dataclass, replace

import numpy as np

from backend.contract.cameras import Cameras
from backend.contract.job import ForecastConfig, PublishedConfig
from backend.fit.future import Trust, recent_guides, recent_velocity, trust_of
from backend.fit.guide import Guide
from backend.fit.population import PER_PARTICLE, is_near_image, take
from backend.fit.refine import as_gaussians
from backend.fit.replay import births_at_foot, born_again
from backend.fit.scene import LEAST_TURN, Scene, make_scene, turned_about
from backend.fit.series import First, Series
from backend.fit.state import PhysicalRecord, VisualRecord, VolumeRecord
from backend.geometry.camera import View
from backend.published import future as published_future
from backend.render import splat
from backend.reporting import Report

_CHECKED = 8  # frames, the last that were seen, by which the motion is checked
_BELIEVED = 0.8  # of the foretold change: motion that is borne out as far counts whole, as the bundled clip's is
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
    if method != "default":
        view, seconds = scene.views[-1], scene.seconds_per_frame
        yield from published_future.run(
            fluid, seen, published or PublishedConfig(), report, num_frames=config.num_frames, view=view, seconds=seconds
        )
        return
    of_all = volumes if volumes is not None and len(volumes) >= len(layers) else None
    known = Known(scene=scene, layers=layers, fluid=fluid, seen=seen, volumes=of_all)
    trust = trust_of(known.last, config)
    if turned_about(scene.views, scene.anchor) < LEAST_TURN:
        trust = replace(trust, confirmed=confirmed(known))
    for step, record in enumerate(foretold(known, trust, config.num_frames)):
        report.progress(step, config.num_frames)
        yield record
    report.progress(config.num_frames, config.num_frames)


@dataclass(frozen=True, slots=True, kw_only=True)
class Known:
    """What there is of the frames that were seen; scene: of these and maybe of later ones; volumes: of all of them, or none; the
    rest as in `run`."""

    scene: Scene
    layers: Series[np.ndarray]
    fluid: Series[PhysicalRecord]
    seen: Series[VisualRecord]
    volumes: Series[VolumeRecord] | None

    @property
    def last(self) -> VisualRecord:
        return self.seen[len(self.seen) - 1]

    def first(self, count: int) -> Known:
        """The same, of the first `count` frames alone."""
        volumes = First(self.volumes, count) if self.volumes is not None else None
        layers, fluid, seen = First(self.layers, count), First(self.fluid, min(count, len(self.fluid))), First(self.seen, count)
        return Known(scene=self.scene, layers=layers, fluid=fluid, seen=seen, volumes=volumes)

    def going_on(self, count: int) -> Iterator[VisualRecord]:
        """Yields `count` records behind the last one, if all smoke goes on as it went."""
        view, seconds = self.scene.views[len(self.seen) - 1], self.scene.seconds_per_frame
        guides = [] if self.volumes is None else recent_guides(self.volumes, self.layers, self.scene)
        moving = _going_on(replace(self.last, next_id=2 * self.last.next_id), self.fluid, guides)
        births = [_going_on(newborn, self.fluid, guides) for newborn in births_at_foot(self.seen)[-_REPLAYED:]]
        for step in range(count):
            moving = replace(moving, positions=moving.positions + seconds * moving.velocities)
            moving = born_again(moving, births, step)
            moving = take(moving, is_near_image(moving.positions, view))
            yield moving


def foretold(known: Known, trust: Trust, count: int) -> Iterator[VisualRecord]:
    """Yields `count` records behind the last one: the mean over what may become of the smoke, as far as its motion is to be
    trusted."""
    last = known.last
    still = replace(last, velocities=np.zeros_like(last.velocities), ids=last.ids + last.next_id)
    for step, moving in enumerate(known.going_on(count), start=1):
        yield _expected(moving, still, trust, known.scene.seconds_per_frame * step)


def confirmed(known: Known) -> float:
    """How much of the motion the last frames bear out, 0 to 1: what share of the change that it foretells from the frames before,
    against resting smoke, comes nearest to how they are (least squares over their opacities)."""
    count = min(_CHECKED, (len(known.seen) - 1) // 2)
    before = known.first(len(known.seen) - count)
    borne_out = change = 0.0
    for frame, moving in enumerate(before.going_on(count), start=len(before.seen)):
        resting, moved = (_opacity(record, known.scene.views[frame]) for record in (before.last, moving))
        borne_out += float(((moved - resting) * (known.layers[frame][..., 3] - resting)).sum())
        change += float(np.square(moved - resting).sum())
    return min(max(borne_out / (_BELIEVED * change), 0.0), 1.0) if change > 0.0 else 1.0


def _opacity(record: VisualRecord, view: View) -> np.ndarray:
    """[H, W] float64."""
    return -np.expm1(-splat.forward(as_gaussians(record), view).image[0].astype(np.float64))


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
