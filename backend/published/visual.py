"""The visual stage as published: Gaussians with axes of their own ride on the physical ones; their look is fitted.

FluidNexus (Gao et al. 2025) with WildSmoke's frequency loss (supplement 7.6.2). A frame's loss:

    0.8 L1 + 0.2 (1 - SSIM) + 0.001 w(iteration) frequency + 10 colour + 8 opacity + 0.1 rotation

over optical mass, scales, rotation and colour, by Adam; the last three hold particles to the frame before, mean squared
differences. Positions are where the fluid carries them, held in depth by the prior as the physical ones are. No axis is
longer than four times another. Smoke that nobody explains is born at the prior's depth, as in the project's own fit: the
papers grow particles, but one view tells no depth. Thick smoke of one colour looks the same with twice the mass, and these
losses see colours only: masses drift upwards.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass, replace

import numpy as np

from backend.contract.cameras import Cameras
from backend.contract.job import PublishedConfig, VisualConfig
from backend.fit import depth_prior, losses
from backend.fit.adam import Adam
from backend.fit.appearance import DEATH_SHARE, Appearance
from backend.fit.carry import carry, with_velocities
from backend.fit.population import is_near_image, take
from backend.fit.refine import as_gaussians
from backend.fit.scene import Scene, make_scene, optical_depth
from backend.fit.series import Series
from backend.fit.state import PhysicalRecord, VisualRecord
from backend.published.physical import CONTAINMENT
from backend.published.pictures import FREQUENCY_WEIGHT, coded_target, linear_picture_loss
from backend.render import layers as renderer
from backend.reporting import Report

COLOR_WEIGHT, OPACITY_WEIGHT, ROTATION_WEIGHT = 10.0, 8.0, 0.1
MAX_ASPECT = 4.0
MAX_OPACITY = 0.99  # of one particle's middle, as in Gaussian splatting (Kerbl 2023)
MASS_STEP, SCALE_STEP, ROTATION_STEP, COLOR_STEP = 0.2, 0.04, 0.04, 0.03  # log, log, quaternion, linear; an iteration
SCALE_RANGE = (0.3, 4.0)  # of the scale at birth


def run(
    layers: Series[np.ndarray],  # [H, W, 4] float32 premultiplied linear RGB and opacity
    cameras: Cameras,
    fluid: Series[PhysicalRecord],
    config: PublishedConfig,
    report: Report,
    *,
    has_frequency_loss: bool,
    seed: int,
    done: Series[VisualRecord],
) -> Iterator[VisualRecord]:
    """Yields the records of the frames behind those that are `done`."""
    scene = make_scene(layers, cameras)
    look = _Look(scene, layers, config, has_frequency_loss, seed)
    record = done[len(done) - 1] if len(done) else look.empty()
    for frame in range(len(done), len(layers)):
        report.progress(frame, len(layers), loss=look.loss)
        if frame > 0:
            record = carry(record, fluid[frame], seconds=scene.seconds_per_frame)
        record = with_velocities(look.fitted(record, frame), fluid[frame])
        yield record
    report.progress(len(layers), len(layers), loss=look.loss)


@dataclass(slots=True)
class _Variables:
    """What is fitted: logarithms of mass [N] and scales [N, 3], rotations [N, 4], colours [N, 3]."""

    log_masses: np.ndarray
    log_scales: np.ndarray
    rotations: np.ndarray
    colors: np.ndarray

    @classmethod
    def of(cls, record: VisualRecord) -> _Variables:
        assert record.rotations is not None  # _Look.empty makes them so
        return cls(
            log_masses=np.log(np.maximum(record.optical_masses.astype(np.float64), 1e-30)),
            log_scales=np.log(record.scales.astype(np.float64)),
            rotations=record.rotations.astype(np.float64),
            colors=record.colors.astype(np.float64),
        )

    def into(self, record: VisualRecord) -> VisualRecord:
        return replace(
            record,
            optical_masses=np.exp(self.log_masses).astype(np.float32),
            scales=np.exp(self.log_scales).astype(np.float32),
            rotations=self.rotations.astype(np.float32),
            colors=self.colors.astype(np.float32),
        )

    def opacities(self) -> np.ndarray:  # [N]
        """Of each particle's middle, seen along a mean axis: 1 - exp(-m / (2 pi s^2)), s the geometric mean of its scales."""
        return -np.expm1(-np.exp(self.log_masses - 2.0 * self.log_scales.mean(axis=1)) / (2.0 * math.pi))


def consistency(now: _Variables, before: _Variables) -> tuple[float, _Variables]:
    """10 colour + 8 opacity + 0.1 rotation over the particles that were there before, and the gradient by `now`.

    `before` may hold fewer rows: those behind are newborn and free.
    """
    num = len(before.log_masses)
    gradient = _Variables(*(np.zeros_like(a) for a in (now.log_masses, now.log_scales, now.rotations, now.colors)))
    if num == 0:
        return 0.0, gradient
    color = now.colors[:num] - before.colors
    turn = now.rotations[:num] - before.rotations
    opacities = now.opacities()[:num]
    change = opacities - before.opacities()
    loss = COLOR_WEIGHT * float((color * color).mean()) + ROTATION_WEIGHT * float((turn * turn).mean())
    loss += OPACITY_WEIGHT * float((change * change).mean())
    gradient.colors[:num] = 2.0 * COLOR_WEIGHT / color.size * color
    gradient.rotations[:num] = 2.0 * ROTATION_WEIGHT / turn.size * turn
    # d opacity / d log m = (1 - opacity) t, t = -log(1 - opacity)
    by_opacity = 2.0 * OPACITY_WEIGHT / num * change * (1.0 - opacities) * -np.log1p(-np.minimum(opacities, 1.0 - 1e-12))
    gradient.log_masses[:num] = by_opacity
    gradient.log_scales[:num] = -2.0 / 3.0 * by_opacity[:, None]
    return loss, gradient


class _Look:
    """What does not change over time, and the last loss."""

    def __init__(
        self, scene: Scene, layers: Series[np.ndarray], config: PublishedConfig, has_frequency_loss: bool, seed: int
    ) -> None:
        self.scene = scene
        self.layers = layers
        self.config = config
        self.has_frequency_loss = has_frequency_loss
        self.appearance = Appearance(scene, layers, VisualConfig(num_particles=config.num_particles), seed)
        self.loss = 0.0

    def empty(self) -> VisualRecord:
        rotations = np.zeros((0, 4), np.float32)
        return replace(self.appearance.empty(), scales=np.zeros((0, 3), np.float32), rotations=rotations)

    def fitted(self, record: VisualRecord, frame: int) -> VisualRecord:
        """The carried record with newborn particles, brought to the frame's picture; without the spent and departed."""
        depth, view = optical_depth(self.layers[frame]), self.scene.views[frame]
        prior = depth_prior.inflate(depth, view, self.scene.anchor)
        record = replace(record, positions=depth_prior.contain(record.positions, prior, view, share=CONTAINMENT))
        record = self.appearance.with_births(record, frame, depth)
        if len(record.positions) == 0:
            return record
        iterations = self.config.visual_iterations * (self.config.first_frame_factor if frame == 0 else 1)
        done = self.config.visual_iterations * (frame + self.config.first_frame_factor - 1) if frame else 0
        now = _Variables.of(record)
        before = _Variables.of(take(record, record.born < frame))  # without those that made room for newborn ones
        adam = (
            Adam.like(now.log_masses, MASS_STEP, floor=1.0), Adam.like(now.log_scales, SCALE_STEP, floor=1.0),
            Adam.like(now.rotations, ROTATION_STEP, floor=1.0), Adam.like(now.colors, COLOR_STEP, floor=1.0),
        )  # fmt: skip
        target = coded_target(self.layers[frame])
        for iteration in range(iterations):
            self.loss, slope = self._loss(now, before, record, frame, target, done + iteration)
            now = self._stepped(now, adam, slope)
        record = now.into(record)
        is_kept = record.optical_masses > DEATH_SHARE * self.appearance.unit_mass
        return take(record, is_kept & is_near_image(record.positions, view))

    def _loss(
        self, now: _Variables, before: _Variables, record: VisualRecord, frame: int, target: np.ndarray, iteration: int
    ) -> tuple[float, _Variables]:
        """The frame's loss and its gradient. iteration: of the whole stage, for the warm-up."""
        shown = now.into(record)
        layers = renderer.forward(as_gaussians(shown), self.scene.views[frame], shown.colors)
        frequency = FREQUENCY_WEIGHT * losses.warm_up(iteration, self.config.warm_up) if self.has_frequency_loss else 0.0
        loss, slope = linear_picture_loss(layers.color, target, frequency=frequency)
        found = renderer.backward(layers, slope.astype(np.float32), np.zeros_like(layers.opacity))
        kept, gradient = consistency(now, before)
        gradient.log_masses += np.asarray(found.optical_masses, np.float64) * np.exp(now.log_masses)
        gradient.log_scales += np.asarray(found.scales, np.float64) * np.exp(now.log_scales)
        gradient.rotations += np.asarray(found.rotations, np.float64)
        gradient.colors += np.asarray(found.features, np.float64)
        return loss + kept, gradient

    def _stepped(self, now: _Variables, adam: tuple[Adam, Adam, Adam, Adam], slope: _Variables) -> _Variables:
        """After one step of Adam, within what scales, aspect and colours may be; rotations of unit length."""
        smallest, largest = (math.log(share * self.appearance.scale) for share in SCALE_RANGE)
        log_scales = np.clip(now.log_scales + adam[1].change(slope.log_scales), smallest, largest)
        longest = log_scales.max(axis=1, keepdims=True)
        rotations = now.rotations + adam[2].change(slope.rotations)
        log_scales = np.maximum(log_scales, longest - math.log(MAX_ASPECT))
        heaviest = 2.0 * log_scales.mean(axis=1) + math.log(-2.0 * math.pi * math.log1p(-MAX_OPACITY))
        return _Variables(
            log_masses=np.minimum(now.log_masses + adam[0].change(slope.log_masses), heaviest),
            log_scales=log_scales,
            rotations=rotations / np.linalg.norm(rotations, axis=1, keepdims=True),
            colors=np.maximum(now.colors + adam[3].change(slope.colors), 0.0),
        )
