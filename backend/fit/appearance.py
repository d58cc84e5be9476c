"""The look of the smoke, frame by frame: Gaussians brought to explain what a view shows.

Masses by expectation-maximisation on the optical depth, held to what was carried along; unexplained smoke is born at
the prior's depth; then gradient steps on colour and opacity. Where a volume is proposed, the particles first go a share
of the way to its density.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from backend.contract.job import VisualConfig
from backend.fit import depth_prior, explain
from backend.fit.colors import hue_of
from backend.fit.depths import Depths
from backend.fit.follow import drawn_level, drawn_near, points_on_rays
from backend.fit.population import frame_mass, is_in_image, is_near_image, join, not_grown_beside, pixel_mass, take
from backend.fit.refine import as_gaussians, refine
from backend.fit.scene import Scene, optical_depth
from backend.fit.series import Series
from backend.fit.state import VisualRecord
from backend.geometry.camera import View
from backend.render import splat as renderer

SCALE_SHARE = 0.6  # standard deviation of a particle at birth, share of the mean spacing
DEATH_SHARE = 0.02  # of a particle's own share of the smoke: below it a particle is spent
BIRTH_SHARE = 0.35  # newborns are finer than their share of the smoke: they fill detail
RETIRED_SHARE = 0.05  # of the particles that may make room for newborn ones in a frame
FAINT_SHARE = 0.7  # of a particle's own share of the smoke: only fainter ones make room
CALM_MASS = 0.15  # share of the way to the common mass (in the logarithm) that each goes back, a frame
CALM_DEPTH = 0.3  # share of what stands out of the solid in depth that is taken back, where no volume says otherwise
CALM_COLOR = 0.25  # share of the way to the colour of its pixel, or to the frame's where no pixel shows smoke
FADES = 0.3  # of the picture's longer side: a particle that has gone so far beside it has half its mass (docs/prior.md)
WIDENS = 0.3  # of its way beside the picture: by so much a particle widens there


class Appearance:
    """Fits Gaussians to frames of one scene."""

    def __init__(
        self,
        scene: Scene,
        layers: Series[np.ndarray],
        config: VisualConfig,
        seed: int,
        depths: Depths | None = None,
        *,
        as_wide: bool = False,  # no smoke is far out of what `depths` says, where these are volumes either
    ) -> None:
        self.scene = scene
        self.as_wide = as_wide
        self.depths = depths or Depths(scene, layers)
        self.layers = layers
        self.config = config
        self.seed = seed
        masses = [frame_mass(scene, layers[frame], frame) for frame in range(len(layers))]
        fullest = int(np.argmax(masses))
        self.hue = hue_of(layers[frame] for frame in range(len(layers))) if config.color == "one_hue" else None
        self.unit_mass = max(masses[fullest], 1e-30) / config.num_particles
        self.scale = SCALE_SHARE * self._spacing(fullest)

    def _spacing(self, frame: int) -> float:
        """Mean distance m of the particles in a frame's solid of medial balls."""
        tau = optical_depth(self.layers[frame])
        prior = self.depths.prior(frame)
        is_smoke = tau > depth_prior.MASK_SHARE * max(float(np.percentile(tau, 99.5)), 1e-6)
        area = pixel_mass(self.scene.views[frame], prior.center_depth)
        volume = float((2.0 * prior.half_thickness * area)[is_smoke].sum(dtype=np.float64))
        pixel = float(np.sqrt(area.mean()))
        return max((volume / self.config.num_particles) ** (1.0 / 3.0), pixel)

    def empty(self) -> VisualRecord:
        return VisualRecord(
            positions=np.zeros((0, 3)),
            velocities=np.zeros((0, 3), np.float32),
            scales=np.zeros(0, np.float32),
            optical_masses=np.zeros(0, np.float32),
            colors=np.zeros((0, 3), np.float32),
            ids=np.zeros(0, np.int64),
            born=np.zeros(0, np.int32),
            next_id=np.asarray(0, np.int64),
        )

    def look(self, record: VisualRecord, frame: int) -> tuple[VisualRecord, float]:
        """The carried record, brought to explain the frame; and the loss."""
        config, view, layer = self.config, self.scene.views[frame], self.layers[frame]
        target = optical_depth(layer)
        guide = self.depths.guide(frame)
        is_seen = is_in_image(record.positions, view)
        if guide is not None:
            record = replace(record, positions=drawn_near(guide, record.positions, record.optical_masses, is_seen))
        record = self._calmed(self._doubted(record, ~is_seen, view), layer, view, is_seen)
        if guide is not None:
            masses = drawn_level(guide, record.positions, record.optical_masses, is_seen)
            record = replace(record, optical_masses=masses)
        if guide is None or self.as_wide:
            held = depth_prior.contain(record.positions, self.depths.prior(frame), view, share=CALM_DEPTH)
            is_held = is_seen | (guide is None)
            record = replace(record, positions=np.where(is_held[:, None], held, record.positions))
        record = self._weighed(record, frame, target, consistency=config.consistency)
        record = self.with_births(record, frame, target)
        record = self._weighed(record, frame, target, consistency=0.0)
        if config.iterations == 0:
            return record, 0.0
        return refine(record, layer, view, iterations=config.iterations, reference_scale=self.scale, hue=self.hue)

    def _doubted(self, record: VisualRecord, is_beside: np.ndarray, view: View) -> VisualRecord:
        """Wider and fainter by the way of the last frame where no picture showed it: the further, the less is known of it."""
        ways = np.where(is_beside, self.scene.seconds_per_frame * np.linalg.norm(record.velocities, axis=1), 0.0)
        _, away = view.project(record.positions)
        sides = ways * view.fx / np.maximum(np.abs(away), 1e-12) / max(view.width, view.height)
        scales = record.scales + (WIDENS * ways).astype(np.float32)
        return replace(record, scales=scales, optical_masses=record.optical_masses * 0.5 ** (sides / FADES).astype(np.float32))

    def _calmed(self, record: VisualRecord, layer: np.ndarray, view: View, is_seen: np.ndarray) -> VisualRecord:
        """What one view cannot tell shrinks back: masses to their common size where it shows them, colours to what it shows.

        Behind the surface of thick smoke nothing holds single particles, and noise would gather in them from frame to
        frame. The fit that follows restores what the view does tell.
        """
        if len(record.positions) == 0:
            return record
        masses = record.optical_masses.astype(np.float64)
        common = float(np.exp(np.mean(np.log(np.maximum(masses, 1e-3 * self.unit_mass)))))
        calmed = np.where(is_seen, masses ** (1.0 - CALM_MASS) * common**CALM_MASS, masses)
        pixels, _ = view.project(record.positions)
        columns = np.clip(pixels[:, 0].astype(np.int64), 0, view.width - 1)
        rows = np.clip(pixels[:, 1].astype(np.int64), 0, view.height - 1)
        seen, opacity = layer[rows, columns, :3], layer[rows, columns, 3:]
        usual = layer[..., :3].sum(axis=(0, 1)) / max(float(layer[..., 3].sum()), 1e-6)
        shown = np.where(is_seen[:, None] & (opacity > 0.05), seen / np.maximum(opacity, 0.02), usual)
        colors = (1.0 - CALM_COLOR) * record.colors + CALM_COLOR * shown
        return replace(record, optical_masses=calmed.astype(np.float32), colors=colors.astype(np.float32))

    def _weighed(self, record: VisualRecord, frame: int, target: np.ndarray, *, consistency: float) -> VisualRecord:
        """Masses after the frame was seen, without the spent and the departed."""
        view = self.scene.views[frame]
        splat = renderer.forward(as_gaussians(record), view)
        _, masses = explain.fit_masses(
            splat,
            record.optical_masses,
            target,
            iterations=self.config.mass_iterations,
            consistency=consistency,
        )
        masses = not_grown_beside(masses, record.optical_masses, record.positions, view)
        is_kept = (masses > DEATH_SHARE * self.unit_mass) & is_near_image(record.positions, view)
        return take(replace(record, optical_masses=masses), is_kept)

    def _with_room(self, record: VisualRecord, view: View, wanted: int) -> tuple[VisualRecord, int]:
        """Without the faintest that are shown, if the limit leaves no room for those wanted: a source must go on emitting; and
        for how many of them there is room, none at all where more came back into the picture than the limit allows."""
        shown = np.flatnonzero(is_in_image(record.positions, view))
        lacking = wanted - (self.config.num_particles - len(shown))
        if lacking <= 0:
            return record, wanted
        masses = record.optical_masses[shown]
        order = np.argsort(masses, kind="stable")[: min(lacking, int(RETIRED_SHARE * len(shown)))]
        retired = shown[order[masses[order] < FAINT_SHARE * self.unit_mass]]
        is_kept = np.ones(len(record.positions), bool)
        is_kept[retired] = False
        return take(record, is_kept), max(0, wanted - lacking + len(retired))

    def with_births(self, record: VisualRecord, frame: int, target: np.ndarray) -> VisualRecord:
        """Gaussians for the smoke that nobody explains, until the picture shows as many as the limit allows."""
        view, layer = self.scene.views[frame], self.layers[frame]
        splat = renderer.forward(as_gaussians(record), view)
        missing = explain.missing_depth(splat, target)
        missing[missing < 0.02 * max(float(target.max(initial=0.0)), 1e-6)] = 0.0
        prior = self.depths.prior(frame)
        mass = missing * pixel_mass(view, prior.center_depth)
        unit = self.unit_mass if len(record.positions) == 0 else BIRTH_SHARE * self.unit_mass
        total = float(mass.sum(dtype=np.float64))
        wanted = int(total / unit)
        record, count = self._with_room(record, view, wanted)
        seed = self.seed + 104729 * frame + 1
        points, pixels = depth_prior.sample_points(missing, count, prior, view, seed=seed)
        guide, count = self.depths.guide(frame), len(points)
        if count == 0:
            return record
        if guide is not None:
            points = points_on_rays(guide, view, pixels, points, seed=seed)
        rows, columns = pixels[:, 1].astype(int), pixels[:, 0].astype(int)
        seen = layer[rows, columns]
        newborn = {
            "positions": points,
            "velocities": np.zeros((count, 3)),
            "scales": np.full((count, *record.scales.shape[1:]), self.scale),
            "optical_masses": np.full(count, total / count),
            "colors": seen[:, :3] / np.maximum(seen[:, 3:], 0.02),
            "born": np.full(count, frame),
        }
        if record.rotations is not None:
            newborn["rotations"] = np.tile([1.0, 0.0, 0.0, 0.0], (count, 1))
        return join(record, **newborn)
