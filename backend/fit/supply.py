"""Physical particles of a scene: how large they are, how their fluid behaves, who is born and who is spent."""

from __future__ import annotations

from dataclasses import dataclass, replace

import cv2
import numpy as np

from backend.fit import depth_prior, explain
from backend.fit.carry import as_fluid
from backend.fit.depths import Depths
from backend.fit.follow import points_on_rays
from backend.fit.population import frame_mass, is_near_image, join, pixel_mass, take
from backend.fit.scene import Scene, optical_depth
from backend.fit.series import Series
from backend.fit.state import PhysicalRecord
from backend.physics import fluid as fluids
from backend.physics.interpolate import interpolate_velocity
from backend.render import splat as renderer
from backend.render.gaussians import isotropic

SPLAT_SHARE = 0.5  # standard deviation of a physical particle's splat, share of the smoothing length
DEATH_SHARE = 0.15  # of a particle's own share of the smoke: below it a particle is spent
FADING = 0.7  # consistency of masses from frame to frame
REST_QUANTILE = 0.95  # of the density of evenly sampled particles


@dataclass(frozen=True, slots=True, kw_only=True)
class Supply:
    """What of a scene's physical particles does not change over time.

    unit_mass: m^2, of a newborn particle. parameters: of the fluid. sigma: m, of a particle's splat.
    """

    scene: Scene
    layers: Series[np.ndarray]
    depths: Depths
    seed: int
    unit_mass: float
    parameters: fluids.FluidParameters
    sigma: float

    def empty(self) -> PhysicalRecord:
        """No particles, nothing learned."""
        return PhysicalRecord(
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

    def prior(self, frame: int) -> depth_prior.DepthPrior:
        return self.depths.prior(frame)

    def splat(self, record: PhysicalRecord, frame: int) -> tuple[renderer.Splat, np.ndarray]:
        """The particles' optical depth, and the frame's own, blurred to what particles of this size can show."""
        view = self.scene.views[frame]
        gaussians = isotropic(record.positions, np.full(len(record.positions), self.sigma), record.masses)
        target = optical_depth(self.layers[frame])
        distance = max(float(view.to_camera(self.scene.anchor[None])[0, 2]), 1e-6)
        blur = self.sigma * view.fx / distance
        if blur > 0.3:
            target = cv2.GaussianBlur(target, (0, 0), min(blur, 0.25 * max(target.shape)))
        return renderer.forward(gaussians, view), target

    def weighed(self, record: PhysicalRecord, frame: int) -> PhysicalRecord:
        """Masses after the frame was seen; the spent and the departed are dropped."""
        splat, target = self.splat(record, frame)
        _, masses = explain.fit_masses(splat, record.masses, target, iterations=2, consistency=FADING)
        is_kept = (masses > DEATH_SHARE * self.unit_mass) & is_near_image(record.positions, self.scene.views[frame])
        return take(replace(record, masses=masses.astype(np.float64)), is_kept)

    def with_births(self, record: PhysicalRecord, frame: int) -> PhysicalRecord:
        """The record with particles for the smoke that nobody explains, each of one unit of mass."""
        view = self.scene.views[frame]
        splat, target = self.splat(record, frame)
        missing = explain.missing_depth(splat, target)
        missing[missing < 0.02 * max(float(target.max(initial=0.0)), 1e-6)] = 0.0
        prior = self.prior(frame)
        count = int((missing * pixel_mass(view, prior.center_depth)).sum() / self.unit_mass)
        weight = missing if len(record.positions) else prior.half_thickness * (prior.is_smoke & (missing > 0.0))
        seed = self.seed + 7919 * frame
        points, pixels = depth_prior.sample_points(weight, count, prior, view, seed=seed, is_even=True)
        if len(points) == 0:
            return record
        guide = self.depths.guide(frame)
        velocities = np.zeros_like(points)
        if guide is not None:
            points = points_on_rays(guide, view, pixels, points, seed=seed)
            velocities = guide.velocity_at(points).astype(np.float64)
        elif len(record.positions):
            state = as_fluid(record)
            velocities = interpolate_velocity(points, state, self.parameters.smoothing_length)[0]
        return join(
            record,
            positions=points,
            velocities=velocities,
            masses=np.full(len(points), self.unit_mass),
            born=np.full(len(points), frame),
        )


def make_supply(
    scene: Scene,
    layers: Series[np.ndarray],  # [H, W, 4] premultiplied linear RGB and opacity
    num_particles: int,  # in the frame that shows most smoke
    *,
    seed: int,
    drag: float = 0.0,  # 1/s
    solver_iterations: int = 3,
    max_substeps: int = 4,
    depths: Depths | None = None,
) -> Supply:
    """Everything from the spacing of particles that fill the prior's solid where most smoke is, nothing from constants."""
    masses = [frame_mass(scene, layers[frame], frame) for frame in range(len(layers))]
    fullest = int(np.argmax(masses))
    depths = depths or Depths(scene, layers)
    view, prior = scene.views[fullest], depths.prior(fullest)
    solid = prior.half_thickness * prior.is_smoke
    points, _ = depth_prior.sample_points(solid, num_particles, prior, view, seed=seed, is_even=True)
    parameters = fluids.derive_parameters(points, drag=drag, solver_iterations=solver_iterations, max_substeps=max_substeps)
    # Random points are denser here and sparser there; only what is denser than they were is pressed apart.
    densest = float(np.quantile(fluids.number_density(points, parameters.smoothing_length), REST_QUANTILE))
    return Supply(
        scene=scene,
        layers=layers,
        depths=depths,
        seed=seed,
        unit_mass=max(masses[fullest], 1e-30) / num_particles,
        parameters=replace(parameters, rest_density=max(parameters.rest_density, densest)),
        sigma=SPLAT_SHARE * parameters.smoothing_length,
    )
