"""Volumes and velocities against the true ones."""

from __future__ import annotations

from typing import Any, Protocol

import numpy as np

from backend.contract.truth import INPUT_VIEW
from backend.geometry.camera import View
from backend.reporting import Report
from backend.score import measures
from backend.score.tally import mean, rounded
from backend.score.truth_set import Truth, Volume

LEAST_PEAK = 0.05  # 1/m; a moment with less shows no smoke


class Volumes(Protocol):
    """Volumes that are scored, by video frame."""

    def volume(self, like: Volume, frame: int) -> tuple[np.ndarray, np.ndarray]:
        """Density [X, Y, Z] 1/m and velocity [X, Y, Z, 3] m/s on the voxels of `like`."""
        ...


def volume_scores(prediction: Volumes, truth: Truth, *, report: Report) -> dict[str, Any]:
    """Means over the seen moments that hold smoke; empty without any. mass_ratio: our optical mass over the true one, of
    all moments."""
    rows: list[dict[str, float]] = []
    velocities: list[dict[str, float]] = []
    masses = np.zeros(2)
    frames = [frame for frame in truth.volume_frames() if frame < truth.num_seen]
    for step, frame in enumerate(frames):
        report.progress(step, len(frames))
        real = truth.volume(frame)
        if real.density.max() < LEAST_PEAK:
            continue
        density, velocity = prediction.volume(real, frame)
        rows.append(
            {
                "correlation": measures.correlation(density, real.density),
                "relative_l2": measures.relative_l2(density, real.density),
            }
        )
        masses += density.sum(dtype=np.float64), real.density.sum(dtype=np.float64)
        if real.velocity is not None and frame > 0:
            axes = camera_axes(truth.view(INPUT_VIEW, frame))
            velocities.append(measures.velocity_scores(velocity, real.velocity, real.density, axes))
    if not frames:
        return {}
    report.progress(len(frames), len(frames))
    found: dict[str, Any] = {name: mean([row[name] for row in rows]) for name in rows[0]} if rows else {}
    found["mass_ratio"] = rounded(float(masses[0] / masses[1])) if masses[1] > 0 else None
    if velocities:
        found["velocity"] = {name: mean([row[name] for row in velocities]) for name in velocities[0]}
    return found


def camera_axes(view: View) -> np.ndarray:
    """[3, 3] rows: sideways in the image, up in the world (z), away from the camera; the first and last level."""
    away = view.camera_to_world[:3, 2] * (1.0, 1.0, 0.0)
    away = away / np.linalg.norm(away)
    up = np.array([0.0, 0.0, 1.0])
    return np.stack([np.cross(away, up), up, away])
