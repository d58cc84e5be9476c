"""Physical particles: where the smoke moves. A filter over time: the fluid predicts a frame, the frame corrects it.

From one frame to the next: position-based fluid step with the buoyancy learned so far; the observed image motion
takes its share of the sideways displacement; gradient steps move what still projects to the wrong place; masses
follow the frame, smoke that nobody explains is born at the depth of the prior, smoke that is gone dies. What the
frames changed about the velocities is, in the mean, the force that the fluid lacked: buoyancy is solved from it.
Where volumes are proposed, they lead instead: their velocity carries, their density draws near, and both together tell
buoyancy from wind.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace

import numpy as np

from backend.contract.cameras import Cameras
from backend.contract.job import PhysicalConfig, PublishedConfig
from backend.fit import depth_prior, image_motion
from backend.fit.carry import as_fluid
from backend.fit.depths import Depths
from backend.fit.follow import drawn_near
from backend.fit.guide import Guide
from backend.fit.lift import gain_with_density, shared_out
from backend.fit.limits import warn_of_substeps
from backend.fit.population import is_in_image
from backend.fit.scene import Scene, make_scene
from backend.fit.series import Series
from backend.fit.state import PhysicalRecord, VolumeRecord
from backend.fit.supply import make_supply
from backend.geometry.camera import View
from backend.physics import fluid as fluids
from backend.physics.buoyancy import solve_buoyancy
from backend.physics.interpolate import smooth
from backend.published import physical as published_physical
from backend.render import splat as renderer
from backend.reporting import Report

CONTAINMENT = 0.3  # share of what stands out of the prior's solid that is taken back a frame
BUOYANCY_RIDGE = 20.0  # observations at which the learned buoyancy has half its say


def run(
    layers: Series[np.ndarray],  # [H, W, 4] float32 premultiplied linear RGB and opacity
    cameras: Cameras,
    config: PhysicalConfig,
    report: Report,
    *,
    seed: int,
    done: Series[PhysicalRecord],
    method: str = "default",
    published: PublishedConfig | None = None,  # the settings of the other methods
    volumes: Series[VolumeRecord] | None = None,  # what is proposed for each frame; none: the images alone tell
) -> Iterator[PhysicalRecord]:
    """Yields the records of the frames behind those that are `done`."""
    if method != "default":
        settings, learns = published or PublishedConfig(), method == "as_published"
        yield from published_physical.run(layers, cameras, settings, report, learns_buoyancy=learns, seed=seed, done=done)
        return
    scene = make_scene(layers, cameras)
    fit = _Fit(scene, layers, config, seed, Depths(scene, layers, volumes), report)
    first = len(done)
    record = done[first - 1] if first else None
    for frame in range(first, len(layers)):
        report.progress(frame, len(layers))
        record = fit.start() if record is None else fit.advance(record, frame)
        yield record
    report.progress(len(layers), len(layers))


class _Fit:
    """The parts of the filter that do not change over time."""

    def __init__(
        self, scene: Scene, layers: Series[np.ndarray], config: PhysicalConfig, seed: int, depths: Depths, report: Report
    ) -> None:
        self.scene = scene
        self.report = report
        self.layers = layers
        self.config = config
        self.supply = make_supply(
            scene, layers, config.num_particles, seed=seed,
            drag=config.drag, solver_iterations=config.solver_iterations, max_substeps=config.max_substeps, depths=depths,
        )  # fmt: skip
        self.depths = depths
        self.parameters = self.supply.parameters

    def start(self) -> PhysicalRecord:
        """Frame 0: the prior's points with the volume's or the image's motion."""
        born = self.supply.with_births(self.supply.empty(), 0)
        guide = self.depths.guide(0)
        if guide is not None:
            return replace(born, velocities=guide.velocity_at(born.positions).astype(np.float64))
        if len(self.layers) < 2 or len(born.positions) == 0:
            return born
        wanted, confidence = self._observed(born.positions, 0)
        velocities = self._smooth(wanted / self.scene.seconds_per_frame, born, weight=confidence)
        return replace(born, velocities=velocities)

    def advance(self, record: PhysicalRecord, frame: int) -> PhysicalRecord:
        """The record of `frame` from that of the frame before."""
        if len(record.positions) == 0:
            return self.supply.with_births(record, frame)
        before, after = self.depths.guide(frame - 1), self.depths.guide(frame)
        if before is not None and after is not None:
            current = self._led(record, before, after, self.scene.views[frame])
        else:
            current = self._filtered(record, frame)
        return self.supply.with_births(self.supply.weighed(current, frame), frame)

    def _led(self, record: PhysicalRecord, before: Guide, after: Guide, view: View) -> PhysicalRecord:
        """Moved as the volumes say, and where the picture shows them a share of the way to their density."""
        positions = before.carried(record.positions, after, seconds=self.scene.seconds_per_frame)
        positions = drawn_near(after, positions, record.masses, is_in_image(positions, view))
        velocities = after.velocity_at(positions).astype(np.float64)
        gain = gain_with_density(after.density, after.velocity)
        learned = self._learn_buoyancy(record, velocities, np.ones(len(positions)), substeps=1, gain=gain)
        return replace(learned, positions=positions, velocities=velocities)

    def _filtered(self, record: PhysicalRecord, frame: int) -> PhysicalRecord:
        """Moved as the fluid predicts, corrected by what the images show."""
        dt = self.scene.seconds_per_frame
        parameters = replace(self.parameters, buoyancy=tuple(record.buoyancy))
        state, taken = fluids.step(as_fluid(record), parameters, dt)
        warn_of_substeps(self.report, taken, len(record.positions), allowed=parameters.max_substeps)
        predicted = state.positions
        wanted, confidence = self._observed(record.positions, frame - 1)
        gain = self.config.flow_gain * confidence[:, None]
        lack = _sideways(record.positions + wanted - predicted, self.scene.views[frame])
        positions = predicted + self._smooth(gain * lack, record)
        moved = self._corrected(replace(record, positions=positions), frame)
        moved = depth_prior.contain(moved, self.supply.prior(frame), self.scene.views[frame], share=CONTAINMENT)
        velocities = (moved - record.positions) / dt
        learned = self._learn_buoyancy(record, velocities, confidence, taken.substeps)
        return replace(learned, positions=moved, velocities=velocities)

    # -- parts of a step ------------------------------------------------------------------------------------------

    def _observed(self, positions: np.ndarray, frame: int) -> tuple[np.ndarray, np.ndarray]:
        """Displacement [N, 3] m that the images ask for from `frame` to the next, and its confidence [N]."""
        before, after = self.layers[frame], self.layers[frame + 1]
        flow = image_motion.dense_flow(before, after)
        views = (self.scene.views[frame], self.scene.views[frame + 1])
        return image_motion.lift_flow(flow, before[..., 3], positions, views)

    def _corrected(self, record: PhysicalRecord, frame: int) -> np.ndarray:
        """Positions [N, 3] m after gradient steps on the squared error of the optical depth; each must lower it."""
        positions, reach = record.positions, 0.15 * self.parameters.smoothing_length
        splat, target = self.supply.splat(record, frame)
        loss = float(np.square(splat.image[0] - target, dtype=np.float64).sum())
        for _ in range(self.config.correction_iterations):
            gradient = renderer.backward(splat, (splat.image - target[None]).astype(np.float32)).positions
            direction = -self._smooth(np.asarray(gradient, np.float64), record)
            largest = float(np.sqrt(np.square(direction).sum(axis=1)).max(initial=0.0))
            if not largest > 0.0:
                break
            tried = positions + direction * (reach / largest)
            splat_tried, _ = self.supply.splat(replace(record, positions=tried), frame)
            loss_tried = float(np.square(splat_tried.image[0] - target, dtype=np.float64).sum())
            if loss_tried < loss:
                positions, splat, loss = tried, splat_tried, loss_tried
                record = replace(record, positions=positions)
            else:
                reach *= 0.4
        return positions

    def _learn_buoyancy(
        self,
        record: PhysicalRecord,
        velocities: np.ndarray,
        confidence: np.ndarray,
        substeps: int,
        gain: np.ndarray | None = None,
    ) -> PhysicalRecord:
        """The mean force that the velocities of the optimised positions ask for, all frames so far together; of it the part
        along the gain, where volumes tell that."""
        if not self.config.learn_buoyancy or confidence.sum() <= 0.0:
            return record
        observed = solve_buoyancy(
            record.velocities,
            velocities,
            confidence,
            self.scene.seconds_per_frame,
            drag=self.config.drag,
            substeps=substeps,
        ).vector
        weight = record.buoyancy_weight + 1.0
        moment = record.buoyancy_moment + observed
        if gain is not None:
            record = replace(record, gain=record.gain + gain, gain_square=record.gain_square + gain * gain)
        buoyancy, drift = shared_out(moment / (weight + BUOYANCY_RIDGE), record.gain)
        return replace(
            record,
            buoyancy=buoyancy,
            drift=drift,
            buoyancy_weight=np.asarray(weight),
            buoyancy_moment=moment,
            buoyancy_square=record.buoyancy_square + observed * observed,
        )

    def _smooth(self, field: np.ndarray, record: PhysicalRecord, *, weight: np.ndarray | None = None) -> np.ndarray:
        """A field [N, 3] averaged over neighbours, so that neighbours move together."""
        state = as_fluid(record)
        if weight is None:
            return smooth(field, state, self.parameters.smoothing_length)
        known = smooth(field * weight[:, None], state, self.parameters.smoothing_length)
        share = smooth(np.repeat(weight[:, None], 3, axis=1), state, self.parameters.smoothing_length)
        return known / np.maximum(share, 1e-3)


def _sideways(vectors: np.ndarray, view: View) -> np.ndarray:
    """Vectors [N, 3] without their part along the optical axis, of which the image says nothing."""
    forward = view.camera_to_world[:3, 2]
    return vectors - (vectors @ forward)[:, None] * forward
