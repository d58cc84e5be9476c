"""A fit that takes a second: puffs drawn by hand, every stage from the layer to the forecast, nothing written."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from backend.contract.cameras import Cameras
from backend.contract.job import CamerasConfig, ExtractionConfig, ForecastConfig, PhysicalConfig, PublishedConfig, VisualConfig
from backend.fit.scene import make_scene
from backend.fit.state import PhysicalRecord, VisualRecord, VolumeRecord, particle_frame
from backend.prior.predict import Prior
from backend.render.picture import picture
from backend.reporting import SilentReport
from backend.stages import forecast, physical, smoke, visual, volume
from backend.stages.cameras import still_camera

SIZE = (48, 64)  # width, height
PHYSICAL = PhysicalConfig(num_particles=150, solver_iterations=2, correction_iterations=1)
VISUAL = VisualConfig(num_particles=400, iterations=2, mass_iterations=3)
FORECAST = ForecastConfig(num_frames=2)
PUBLISHED = PublishedConfig(num_physical=100, num_particles=200, physical_iterations=2, visual_iterations=2, first_frame_factor=2)


@dataclass(frozen=True, slots=True, kw_only=True)
class Fitted:
    """What a small fit left."""

    layers: list[np.ndarray]
    cameras: Cameras
    fluid: list[PhysicalRecord]
    seen: list[VisualRecord]
    ahead: list[VisualRecord]
    warnings: list[tuple[str, str]]

    def is_finite(self) -> bool:
        records = [*self.fluid, *self.seen, *self.ahead]
        values = [getattr(record, name) for record in records for name in record.__slots__]
        return all(np.isfinite(value).all() for value in values if value is not None)

    def opacities(self) -> list[np.ndarray]:
        """[H, W] of every fitted frame, as the particles show it."""
        views = make_scene(self.layers, self.cameras).views
        return [picture(particle_frame(record), view)[..., 3] for record, view in zip(self.seen, views, strict=True)]

    def worst_opacity(self) -> float:
        """Largest mean error of a frame's opacity, relative to its mean."""
        errors = [
            np.abs(found - layer[..., 3]).mean() / max(float(layer[..., 3].mean()), 1e-6)
            for found, layer in zip(self.opacities(), self.layers, strict=True)
        ]
        return float(max(errors))


def puffs(num_frames: int, *, gain: float = 1.0) -> list[np.ndarray]:
    """Optical depth [H, W] of puffs that rise from the lower middle."""
    width, height = SIZE
    y, x = np.mgrid[0:height, 0:width].astype(np.float32) + 0.5
    found = []
    for frame in range(num_frames):
        tau = np.zeros((height, width), np.float32)
        for puff in range(-8, frame + 1):
            age = frame - puff
            radius = 0.06 * width * (1 + 0.12 * age)
            cx = width * (0.5 + 0.05 * math.sin(1.7 * puff) + 0.008 * age)
            cy = height * 0.9 - 0.045 * height * age
            tau += 0.9 * np.exp(-((x - cx) ** 2 + (y - cy) ** 2) / (2 * radius**2)) / (1 + 0.08 * age)
        found.append(np.where(tau > 0.02, gain * tau, 0))
    return found


def layer_of(tau: np.ndarray, color: float = 0.7) -> np.ndarray:
    """[H, W, 4] float32 premultiplied."""
    opacity = -np.expm1(-tau)
    return np.dstack([color * opacity] * 3 + [opacity]).astype(np.float32)


def still(*, distance: float = 10.0, fov: float = 40.0, fps: float = 24.0) -> Cameras:
    return still_camera(SIZE, fps, CamerasConfig(distance_m=distance, field_of_view_deg=fov))


def around(
    num_frames: int, *, scale: float = 1.0, away: tuple[float, float, float] = (0.0, 0.0, 0.0), fps: float = 24.0
) -> Cameras:
    """A camera that goes 60 degrees around a place `away` from the world's origin."""
    width, height = SIZE
    matrices = []
    for angle in np.linspace(0.0, math.pi / 3, num_frames):
        right, forward = (math.cos(angle), math.sin(angle), 0.0), (-math.sin(angle), math.cos(angle), 0.0)
        position = [10.0 * scale * -axis + offset for axis, offset in zip(forward, away, strict=True)]
        rows = [(right[k], (0.0, 0.0, -1.0)[k], forward[k], position[k]) for k in range(3)]
        matrices.append((*rows, (0.0, 0.0, 0.0, 1.0)))
    focal = still().fx
    return Cameras(
        width=width, height=height, fx=focal, fy=focal, cx=width / 2, cy=height / 2, fps=fps, camera_to_world=tuple(matrices)
    )


def fit(
    layers: list[np.ndarray],
    cameras: Cameras | None = None,
    *,
    prior: Prior | None = None,
    ahead: ForecastConfig = FORECAST,
    method: str = "default",
) -> Fitted:
    """Every stage from the smoke layer on. prior: asked, where there is one."""
    cameras = cameras or still()
    report = SilentReport()
    volumes: list[VolumeRecord] | None = None
    if prior is not None:
        plan, volumes = volume.make_plan(layers, cameras), []
        if plan is not None:
            plan = volume.centred(plan, report, prior=prior, num_workers=1)
            proposals = list(volume.propose(plan, report, prior=prior, done=[], num_workers=1))
            volumes = list(volume.run(plan, report, proposals, levels=prior.levels, shares=prior.shares))
    shared = {"method": method, "published": PUBLISHED, "volumes": volumes}
    fluid = list(physical.run(layers, cameras, PHYSICAL, report, seed=0, done=[], **shared))
    seen = list(visual.run(layers, cameras, fluid, VISUAL, report, seed=0, done=[], **shared))
    future = list(forecast.run(layers, cameras, fluid, seen, ahead, report, **shared))
    return Fitted(layers=layers, cameras=cameras, fluid=fluid, seen=seen, ahead=future, warnings=report.warnings)


def extracted(frames: list[np.ndarray], *, mode: str = "auto") -> tuple[list[np.ndarray], SilentReport]:
    """The smoke layer of linear frames [H, W, 3], and what was said about them."""
    report = SilentReport()
    opaque = [np.dstack([frame, np.ones(frame.shape[:2])]).astype(np.float32) for frame in frames]
    layer = smoke.run(opaque, ExtractionConfig(mode=mode), report, has_alpha=False)
    return list(layer.frames), report
