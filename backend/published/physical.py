"""The physical stage as published: the fluid predicts a frame, and gradient steps on positions bring it to the picture.

FluidNexus (Gao et al. 2025) with WildSmoke's learnable buoyancy (supplement 7.6.1). A frame's loss:

    0.8 L1 + 0.2 (1 - SSIM) + 0.1 spacing + 0.1 anchor + 1 density + 0.1 density one step ahead

over positions x, by gradient steps that each must lower it, with x - predicted in the anchor;
velocity = (x - before) / dt, as in position-based dynamics.
Physical particles have one colour, so the picture is that of opacity, as sharp as particles of their size can show it:
against the colours, shading would be taken for density.
The papers do not say who is born or spent, nor what one view says of depth; there the project's own parts serve
(backend/fit/supply.py), so that these formulas are held back by nothing but themselves.

Buoyancy as published is a number on a known axis, here up. A density term cannot see it (see ahead_loss); it is learned
through the prediction in the anchor, a quadratic in it, whose minimum each frame tells; the mean over frames is kept.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace

import numpy as np

from backend.contract.cameras import Cameras
from backend.contract.job import PublishedConfig
from backend.fit.carry import as_fluid
from backend.fit.depth_prior import contain
from backend.fit.scene import make_scene
from backend.fit.series import Series
from backend.fit.state import PhysicalRecord
from backend.fit.supply import Supply, make_supply
from backend.geometry.camera import View
from backend.physics.fluid import FluidParameters, FluidState
from backend.physics.fluid_gradient import Rollout, rollout
from backend.physics.interpolate import smooth
from backend.published import particle_losses as terms
from backend.published.pictures import picture_loss
from backend.render import splat as renderer
from backend.render.composite import composite_backward
from backend.reporting import Report

UP = np.array([0.0, 0.0, 1.0])
FIRST_REACH = 0.15  # smoothing lengths that the particle with the largest gradient moves in the first iteration
SHORTER = 0.4  # after a step that did not lower the loss
CONTAINMENT = 0.3  # share of what stands out of the prior's solid in depth that is taken back a frame, for want of views
BUOYANCY_RIDGE = 20.0  # frames at which what was learned has half its say
MAX_SUBSTEPS = 4


def run(
    layers: Series[np.ndarray],  # [H, W, 4] float32 premultiplied linear RGB and opacity
    cameras: Cameras,
    config: PublishedConfig,
    report: Report,
    *,
    learns_buoyancy: bool,
    seed: int,
    done: Series[PhysicalRecord],
) -> Iterator[PhysicalRecord]:
    """Yields the records of the frames behind those that are `done`."""
    scene = make_scene(layers, cameras)
    supply = make_supply(
        scene, layers, config.num_physical, seed=seed, solver_iterations=config.solver_iterations, max_substeps=MAX_SUBSTEPS
    )
    fit = _Fit(supply, config, learns_buoyancy)
    record = done[len(done) - 1] if len(done) else None
    for frame in range(len(done), len(layers)):
        report.progress(frame, len(layers), loss=fit.loss)
        record = fit.start() if record is None else fit.advance(record, frame)
        yield record
    report.progress(len(layers), len(layers), loss=fit.loss)


def fluid_of(record: PhysicalRecord, config: PublishedConfig) -> FluidParameters:
    """The fluid that a record was fitted with: drag where smoke borders on air, buoyancy as known by then."""
    x, y, z = (float(value) for value in record.buoyancy)
    return FluidParameters(
        smoothing_length=float(record.smoothing_length),
        rest_density=float(record.rest_density),
        buoyancy=(x, y, z),
        surface_drag=config.surface_drag,
        viscosity=config.viscosity,
        solver_iterations=config.solver_iterations,
        max_substeps=MAX_SUBSTEPS,
    )


class _Fit:
    """What does not change over time, and the last loss."""

    def __init__(self, supply: Supply, config: PublishedConfig, learns_buoyancy: bool) -> None:
        self.supply = supply
        self.config = config
        self.learns_buoyancy = learns_buoyancy
        self.seconds = supply.scene.seconds_per_frame
        self.loss = 0.0

    def start(self) -> PhysicalRecord:
        """Frame 0: particles that fill the prior's solid, moved until they look like it; at rest."""
        record = self.supply.with_births(self.supply.empty(), 0)
        record = replace(record, buoyancy=self.config.buoyancy * UP)
        iterations = self.config.physical_iterations * self.config.first_frame_factor
        return replace(record, positions=self._fitted(record, record.positions, None, 0, iterations))

    def advance(self, record: PhysicalRecord, frame: int) -> PhysicalRecord:
        """The record of `frame` from that of the frame before."""
        if len(record.positions) == 0:
            return self.supply.with_births(record, frame)
        before = as_fluid(record)
        moved = rollout(before, fluid_of(record, self.config), self.seconds)
        predicted = moved.states[1].positions
        positions = self._fitted(record, predicted, before, frame, self.config.physical_iterations)
        if self.learns_buoyancy:
            record = self._learned(record, positions, moved, before)
        velocities = (positions - before.positions) / self.seconds
        current = replace(record, positions=positions, velocities=velocities)
        return self.supply.with_births(self.supply.weighed(current, frame), frame)

    def _fitted(
        self,
        record: PhysicalRecord,
        predicted: np.ndarray,  # [N, 3] m
        before: FluidState | None,  # one step earlier; None in the first frame
        frame: int,
        iterations: int,
    ) -> np.ndarray:  # [N, 3] m
        """Positions after gradient steps that each lower the frame's loss."""
        if len(predicted) == 0:
            return predicted
        parameters = fluid_of(record, self.config)
        reach = FIRST_REACH * parameters.smoothing_length
        positions = predicted
        self.loss, slope = self._loss(record, positions, predicted, before, frame)
        for _ in range(iterations):
            # Averaged over neighbours: the same minima, and a way there on which neighbours move together.
            state = replace(as_fluid(record), positions=positions)
            direction = -smooth(slope, state, parameters.smoothing_length)
            largest = float(np.sqrt(np.square(direction).sum(axis=1)).max())
            if not largest > 0.0:
                break
            tried = positions + direction * (reach / largest)
            loss, tried_slope = self._loss(record, tried, predicted, before, frame)
            if loss < self.loss:
                positions, self.loss, slope = tried, loss, tried_slope
            else:
                reach *= SHORTER
        return contain(positions, self.supply.prior(frame), self.supply.scene.views[frame], share=CONTAINMENT)

    def _loss(
        self,
        record: PhysicalRecord,
        positions: np.ndarray,  # [N, 3] m
        predicted: np.ndarray,  # [N, 3] m
        before: FluidState | None,
        frame: int,
    ) -> tuple[float, np.ndarray]:
        """The frame's loss and its gradient [N, 3] by the positions."""
        loss, slope = self._picture(replace(record, positions=positions), frame)
        more, more_slope, _ = particle_terms(positions, predicted, before, fluid_of(record, self.config), self.seconds)
        return loss + more, slope + more_slope

    def _picture(self, record: PhysicalRecord, frame: int) -> tuple[float, np.ndarray]:
        """Loss of the particles' opacity, and its gradient [N, 3] by their positions."""
        splat, depth = self.supply.splat(record, frame)
        opacity, target = -np.expm1(-splat.image), -np.expm1(-depth[None].astype(np.float64))
        loss, slope = picture_loss(opacity, target)
        bars = composite_backward(splat.image, None, slope[0].astype(np.float32))
        gradient = np.asarray(renderer.backward(splat, bars).positions, np.float64)
        return loss, _sideways(gradient, self.supply.scene.views[frame])

    def _learned(self, record: PhysicalRecord, positions: np.ndarray, moved: Rollout, before: FluidState) -> PhysicalRecord:
        """The buoyancy after this frame: the minimum of what depends on it, averaged with the frames before."""
        parameters, num = fluid_of(record, self.config), len(positions)
        length, predicted = parameters.smoothing_length, moved.states[1].positions
        _, slope = terms.anchor_loss(positions, predicted, length)
        by_anchor = float(moved.backward([None, -terms.ANCHOR_WEIGHT * slope]).buoyancy @ UP)
        by_ahead = terms.AHEAD_WEIGHT * float(terms.ahead_loss(positions, before, parameters, self.seconds)[2] @ UP)
        lift = float(moved.backward([None, np.broadcast_to(UP / num, (num, 3))]).buoyancy @ UP)  # m per m/s^2
        curvature = 2.0 * terms.ANCHOR_WEIGHT * (lift / length) ** 2
        if not curvature > 0.0:
            return record
        observed = (float(record.buoyancy @ UP) - (by_anchor + by_ahead) / curvature) * UP
        weight, moment = record.buoyancy_weight + 1.0, record.buoyancy_moment + observed
        start = self.config.buoyancy * UP
        return replace(
            record,
            buoyancy=(moment + BUOYANCY_RIDGE * start) / (weight + BUOYANCY_RIDGE),
            buoyancy_weight=np.asarray(weight),
            buoyancy_moment=moment,
            buoyancy_square=record.buoyancy_square + observed * observed,
        )


def _sideways(vectors: np.ndarray, view: View) -> np.ndarray:
    """Vectors [N, 3] without their part along the optical axis: a picture would trade depth for size."""
    forward = view.camera_to_world[:3, 2]
    return vectors - (vectors @ forward)[:, None] * forward


def particle_terms(
    positions: np.ndarray,  # [N, 3] m
    predicted: np.ndarray,  # [N, 3] m
    before: FluidState | None,
    parameters: FluidParameters,
    seconds: float,
) -> tuple[float, np.ndarray, np.ndarray]:  # loss, [N, 3] by the positions, [3] by the buoyancy, the anchor aside
    """All weighted terms but the picture's. Without `before` there is no step ahead."""
    length = parameters.smoothing_length
    parts = (
        (terms.ANCHOR_WEIGHT, terms.anchor_loss(positions, predicted, length)),
        (terms.SPACING_WEIGHT, terms.spacing_loss(positions, length)),
        (terms.DENSITY_WEIGHT, terms.density_loss(positions, parameters)),
    )
    loss = sum(weight * value for weight, (value, _) in parts)
    gradient = sum((weight * slope for weight, (_, slope) in parts), np.zeros_like(positions))
    if before is None:
        return loss, gradient, np.zeros(3)
    ahead, slope, by_buoyancy = terms.ahead_loss(positions, before, parameters, seconds)
    return loss + terms.AHEAD_WEIGHT * ahead, gradient + terms.AHEAD_WEIGHT * slope, terms.AHEAD_WEIGHT * by_buoyancy
