"""Physical particles: where the smoke moves. A filter over time: the fluid predicts a frame, the frame corrects it.

From one frame to the next: position-based fluid step with the buoyancy learned so far; the observed image motion
takes its share of the sideways displacement; gradient steps move what still projects to the wrong place; masses
follow the frame, smoke that nobody explains is born at the depth of the prior, smoke that is gone dies. What the
frames changed about the velocities is, in the mean, the force that the fluid lacked: buoyancy is solved from it.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace

import cv2
import numpy as np

from backend.contract.cameras import Cameras
from backend.contract.job import PhysicalConfig
from backend.fit import depth_prior, explain, image_motion
from backend.fit.carry import as_fluid
from backend.fit.population import frame_mass, is_near_image, join, pixel_mass, take
from backend.fit.scene import Scene, make_scene, optical_depth
from backend.fit.series import Series
from backend.fit.state import PhysicalRecord
from backend.geometry.camera import View
from backend.physics import fluid as fluids
from backend.physics.buoyancy import solve_buoyancy
from backend.physics.interpolate import interpolate_velocity, smooth
from backend.render import splat as renderer
from backend.render.gaussians import isotropic
from backend.reporting import Report

SPLAT_SHARE = 0.5  # standard deviation of a physical particle's splat, share of the smoothing length
DEATH_SHARE = 0.15  # of a particle's own share of the smoke: below it a particle is spent
FADING = 0.7  # consistency of masses from frame to frame
REST_QUANTILE = 0.95  # of the density of evenly sampled particles
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
) -> Iterator[PhysicalRecord]:
    """Yields the records of the frames behind those that are `done`."""
    fit = _Fit(make_scene(layers, cameras), layers, config, seed)
    first = len(done)
    record = done[first - 1] if first else None
    for frame in range(first, len(layers)):
        report.progress(frame, len(layers))
        record = fit.start() if record is None else fit.advance(record, frame)
        yield record
    report.progress(len(layers), len(layers))


class _Fit:
    """The parts of the filter that do not change over time."""

    def __init__(self, scene: Scene, layers: Series[np.ndarray], config: PhysicalConfig, seed: int) -> None:
        self.scene = scene
        self.layers = layers
        self.config = config
        self.seed = seed
        masses = [frame_mass(scene, layers[frame], frame) for frame in range(len(layers))]
        self.fullest = int(np.argmax(masses))
        self.unit_mass = max(masses[self.fullest], 1e-30) / config.num_particles
        view, tau = scene.views[self.fullest], optical_depth(layers[self.fullest])
        prior = depth_prior.inflate(tau, view, scene.anchor)
        solid = prior.half_thickness * prior.is_smoke
        points, _ = depth_prior.sample_points(solid, config.num_particles, prior, view, seed=seed, is_even=True)
        parameters = fluids.derive_parameters(
            points, drag=config.drag, solver_iterations=config.solver_iterations, max_substeps=config.max_substeps
        )
        # Random points are denser here and sparser there; only what is denser than they were is pressed apart.
        densest = float(np.quantile(fluids.number_density(points, parameters.smoothing_length), REST_QUANTILE))
        self.parameters = replace(parameters, rest_density=max(parameters.rest_density, densest))
        self.sigma = SPLAT_SHARE * self.parameters.smoothing_length

    def start(self) -> PhysicalRecord:
        """Frame 0: the prior's points with the image's motion."""
        empty = PhysicalRecord(
            positions=np.zeros((0, 3)),
            velocities=np.zeros((0, 3)),
            masses=np.zeros(0),
            ids=np.zeros(0, np.int64),
            born=np.zeros(0, np.int32),
            next_id=np.asarray(0, np.int64),
            smoothing_length=np.asarray(self.parameters.smoothing_length),
            rest_density=np.asarray(self.parameters.rest_density),
            buoyancy=np.zeros(3),
            buoyancy_weight=np.asarray(0.0),
            buoyancy_moment=np.zeros(3),
            buoyancy_square=np.zeros(3),
        )
        born = self._births(empty, 0)
        if len(self.layers) < 2 or len(born.positions) == 0:
            return born
        wanted, confidence = self._observed(born.positions, 0)
        velocities = self._smooth(wanted / self.scene.seconds_per_frame, born, weight=confidence)
        return replace(born, velocities=velocities)

    def advance(self, record: PhysicalRecord, frame: int) -> PhysicalRecord:
        """The record of `frame` from that of the frame before."""
        if len(record.positions) == 0:
            return self._births(record, frame)
        dt = self.scene.seconds_per_frame
        parameters = replace(self.parameters, buoyancy=tuple(record.buoyancy))
        state, taken = fluids.step(as_fluid(record), parameters, dt)
        predicted = state.positions
        wanted, confidence = self._observed(record.positions, frame - 1)
        gain = self.config.flow_gain * confidence[:, None]
        lack = _sideways(record.positions + wanted - predicted, self.scene.views[frame])
        positions = predicted + self._smooth(gain * lack, record)
        moved = self._corrected(replace(record, positions=positions), frame)
        moved = depth_prior.contain(moved, self._prior(frame), self.scene.views[frame], share=CONTAINMENT)
        velocities = (moved - record.positions) / dt
        learned = self._learn_buoyancy(record, velocities, confidence, taken.substeps)
        current = replace(learned, positions=moved, velocities=velocities)
        return self._births(self._weighed(current, frame), frame)

    # -- parts of a step ------------------------------------------------------------------------------------------

    def _prior(self, frame: int) -> depth_prior.DepthPrior:
        return depth_prior.inflate(optical_depth(self.layers[frame]), self.scene.views[frame], self.scene.anchor)

    def _observed(self, positions: np.ndarray, frame: int) -> tuple[np.ndarray, np.ndarray]:
        """Displacement [N, 3] m that the image asks for from `frame` to the next, and its confidence [N]."""
        before, after = self.layers[frame], self.layers[frame + 1]
        flow = image_motion.dense_flow(before, after)
        views = (self.scene.views[frame], self.scene.views[frame + 1])
        return image_motion.lift_flow(flow, before[..., 3], positions, views)

    def _splat(self, record: PhysicalRecord, frame: int) -> tuple[renderer.Splat, np.ndarray]:
        """The particles' optical depth, and the frame's own, blurred to what particles of this size can show."""
        view = self.scene.views[frame]
        gaussians = isotropic(record.positions, np.full(len(record.positions), self.sigma), record.masses)
        target = optical_depth(self.layers[frame])
        distance = max(float(view.to_camera(self.scene.anchor[None])[0, 2]), 1e-6)
        blur = self.sigma * view.fx / distance
        if blur > 0.3:
            target = cv2.GaussianBlur(target, (0, 0), min(blur, 0.25 * max(target.shape)))
        return renderer.forward(gaussians, view), target

    def _corrected(self, record: PhysicalRecord, frame: int) -> np.ndarray:
        """Positions [N, 3] m after gradient steps on the squared error of the optical depth; each must lower it."""
        positions, reach = record.positions, 0.15 * self.parameters.smoothing_length
        splat, target = self._splat(record, frame)
        loss = float(np.square(splat.image[0] - target, dtype=np.float64).sum())
        for _ in range(self.config.correction_iterations):
            gradient = renderer.backward(splat, (splat.image - target[None]).astype(np.float32)).positions
            direction = -self._smooth(np.asarray(gradient, np.float64), record)
            largest = float(np.sqrt(np.square(direction).sum(axis=1)).max(initial=0.0))
            if not largest > 0.0:
                break
            tried = positions + direction * (reach / largest)
            splat_tried, _ = self._splat(replace(record, positions=tried), frame)
            loss_tried = float(np.square(splat_tried.image[0] - target, dtype=np.float64).sum())
            if loss_tried < loss:
                positions, splat, loss = tried, splat_tried, loss_tried
                record = replace(record, positions=positions)
            else:
                reach *= 0.4
        return positions

    def _weighed(self, record: PhysicalRecord, frame: int) -> PhysicalRecord:
        """Masses after the frame was seen; the spent and the departed are dropped."""
        splat, target = self._splat(record, frame)
        _, masses = explain.fit_masses(splat, record.masses, target, iterations=2, consistency=FADING)
        is_kept = (masses > DEATH_SHARE * self.unit_mass) & is_near_image(record.positions, self.scene.views[frame])
        return take(replace(record, masses=masses.astype(np.float64)), is_kept)

    def _births(self, record: PhysicalRecord, frame: int) -> PhysicalRecord:
        """Particles for the smoke that nobody explains, each of one unit of mass."""
        view = self.scene.views[frame]
        splat, target = self._splat(record, frame)
        missing = explain.missing_depth(splat, target)
        missing[missing < 0.02 * max(float(target.max(initial=0.0)), 1e-6)] = 0.0
        prior = self._prior(frame)
        count = int((missing * pixel_mass(view, prior.center_depth)).sum() / self.unit_mass)
        weight = missing if len(record.positions) else prior.half_thickness * (prior.is_smoke & (missing > 0.0))
        points, _ = depth_prior.sample_points(weight, count, prior, view, seed=self.seed + 7919 * frame, is_even=True)
        if len(points) == 0:
            return record
        velocities = np.zeros_like(points)
        if len(record.positions):
            state = as_fluid(record)
            velocities = interpolate_velocity(points, state, self.parameters.smoothing_length)[0]
        return join(
            record,
            positions=points,
            velocities=velocities,
            masses=np.full(len(points), self.unit_mass),
            born=np.full(len(points), frame),
        )

    def _learn_buoyancy(
        self, record: PhysicalRecord, velocities: np.ndarray, confidence: np.ndarray, substeps: int
    ) -> PhysicalRecord:
        """The mean force that the velocities of the optimised positions ask for, all frames so far together."""
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
        return replace(
            record,
            buoyancy=moment / (weight + BUOYANCY_RIDGE),
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
