"""Particles as something that can be scored."""

from __future__ import annotations

from typing import Any

import numpy as np

from backend.geometry.camera import View
from backend.io.particles import ParticleFrame, Particles
from backend.physics.divergence import both_divergences
from backend.render.motion import smoke_and_motion
from backend.render.picture import picture_of
from backend.reporting import Report, SilentReport
from backend.score.truth_set import Volume


class ParticlePrediction:
    """An open particles.h5, fitted frames and forecast."""

    def __init__(self, particles: Particles) -> None:
        self._particles = particles
        self._start = particles.info.frame_start
        self._kept: tuple[int, ParticleFrame] | None = None
        self.num_frames = self._start + particles.num_frames + particles.num_forecast

    def picture(self, view: View, frame: int) -> np.ndarray:
        return picture_of(self._particles, self._at(frame), frame - self._start, view)

    def volume(self, like: Volume, frame: int) -> tuple[np.ndarray, np.ndarray]:
        """Density, and velocity wherever it is asked; beyond the smoke that of the smoke next to it."""
        return smoke_and_motion(self._at(frame), like.lattice)

    def _at(self, frame: int) -> ParticleFrame:
        """The particles of a frame; those that were asked for last are kept, for a frozen one is asked for again and again."""
        if self._kept is None or self._kept[0] != frame:
            self._kept = frame, self._particles.frame(frame - self._start)
        return self._kept[1]


def mean_divergence(particles: Particles, *, report: Report | None = None) -> dict[str, float]:
    """Mean |div v| over the Gaussians within one smoothing length, 1/s, as published and corrected, and the share of them
    that the corrected one counts; means over the fitted frames. A figure that no frame gives is left out."""
    report = report or SilentReport()
    rows: dict[str, list[float]] = {"as_published": [], "corrected": [], "coverage": []}
    radius = particles.info.fluid["smoothing_length_m"]
    for index in range(particles.num_frames):
        report.progress(index, particles.num_frames)
        frame = particles.frame(index)
        if frame.count:
            published, corrected = both_divergences(frame.positions, frame.velocities, radius)
            rows["as_published"].append(published.mean_absolute)
            rows["corrected"].append(corrected.mean_absolute)
            rows["coverage"].append(corrected.coverage)
    report.progress(particles.num_frames, particles.num_frames)
    return {name: round(float(np.nanmean(values)), 4) for name, values in rows.items() if np.isfinite(values).any()}


def learned_buoyancy(particles: Particles) -> dict[str, float]:
    """Its strength, m/s^2, and how far its direction is from the world's up, degrees; no direction without strength."""
    vector = np.asarray(particles.info.buoyancy, np.float64)
    strength = float(np.linalg.norm(vector))
    found = {"strength": round(strength, 4)}
    if strength > 0.0:
        found["degrees_from_up"] = round(float(np.degrees(np.arccos(np.clip(vector[2] / strength, -1.0, 1.0)))), 2)
    return found


def learned_light(particles: Particles) -> dict[str, Any]:
    """Where the sun stands, by what the smoke shows, and how sure that is; nothing where it shows none."""
    light = particles.info.light
    if light is None:
        return {}
    return {
        "direction": [round(part, 4) for part in light.direction],
        "explained": round(light.explained, 4),
        "doubt_degrees": round(light.doubt_degrees, 2),
    }
