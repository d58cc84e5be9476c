"""Particles to pictures: smoke on black, premultiplied, with its opacity."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from backend.contract.cameras import Cameras
from backend.geometry.camera import View, view_at
from backend.io import images
from backend.io.atomic import whole_file
from backend.io.particles import ParticleFrame, Particles
from backend.render import splat as renderer
from backend.render.composite import composite
from backend.render.evening import evened
from backend.render.gaussians import Gaussians, isotropic
from backend.render.scattering import seen_from
from backend.reporting import Report


def picture(frame: ParticleFrame, view: View) -> np.ndarray:
    """[H, W, 4] float32: linear premultiplied RGB and opacity of a frame's particles in a view."""
    gaussians = (
        isotropic(frame.positions, frame.scales, frame.optical_masses, frame.colors)
        if frame.rotations is None
        else Gaussians(
            positions=frame.positions,
            scales=frame.scales,
            rotations=frame.rotations,
            optical_masses=frame.optical_masses,
            colors=frame.colors,
        )
    )
    splat = renderer.forward(gaussians, view, features=frame.colors)
    color, opacity = composite(splat.image)
    return np.ascontiguousarray(np.concatenate([np.moveaxis(color, 0, -1), opacity[..., None]], axis=2))


def picture_of(particles: Particles, frame: ParticleFrame, index: int, view: View) -> np.ndarray:
    """picture of frame `index` of an asset, as bright as the view sees it and as even as it knows it; nobody filmed a forecast
    one: its colours are the last camera's."""
    filmed = view_at(particles.info.cameras, min(index, particles.num_frames - 1))
    lit = seen_from(frame, view, filmed=filmed, light=particles.info.light)
    return picture(evened(lit, view, filmed=filmed), view)


def render_frames(
    particles: Particles,
    cameras: Cameras,
    wanted: list[tuple[int, int]],  # video frame, index of its camera
    folder: Path,
    report: Report,
    *,
    frame_start: int,
) -> None:
    """Write %04d.png, named by video frame number from 0."""
    for step, (frame, camera) in enumerate(wanted):
        report.progress(step, len(wanted))
        index = frame - frame_start
        image = picture_of(particles, particles.frame(index), index, view_at(cameras, camera))
        with whole_file(folder / f"{frame:04d}.png") as part:
            images.write_png(part, image)
    report.progress(len(wanted), len(wanted))
