"""The report: one picture in which a person sees at once what a job made of a clip."""

from __future__ import annotations

import math
from pathlib import Path

import cv2
import numpy as np

from backend.contract.cameras import read_cameras
from backend.contract.result import read_result
from backend.fit.scene import make_scene
from backend.geometry.camera import View
from backend.io import images
from backend.io.atomic import whole_file
from backend.io.frame_stack import FrameStack
from backend.io.job_folder import JobFolder
from backend.io.particles import read_particles
from backend.io.records import open_stage_file
from backend.render.picture import picture_of

TILE_HEIGHT = 300  # px
COLUMNS = ("video", "smoke layer", "reconstruction", "from the side")


def draw_report(job: Path, path: Path) -> None:
    """First, middle and last fitted frame: the video, its smoke layer, the reconstruction, the same from 90 degrees."""
    folder = JobFolder(job)
    result = read_result(job)
    cameras = read_cameras(folder.cameras)
    rows = []
    with (
        open_stage_file(folder.frames) as frames_file,
        open_stage_file(folder.smoke) as smoke_file,
        read_particles(folder.particles) as particles,
    ):
        frames, layers = FrameStack(frames_file, "frames"), FrameStack(smoke_file, "smoke")
        scene = make_scene(layers, cameras)
        for index in sorted({0, result.num_frames // 2, result.num_frames - 1}):
            view, particle_frame = scene.views[index], particles.frame(index)
            pivot = _middle(particle_frame.positions, particle_frame.optical_masses, scene.anchor)
            video = frames[index]
            tiles = [
                video[..., :3] * video[..., 3:],
                layers[index][..., :3],
                picture_of(particles, particle_frame, index, view)[..., :3],
                picture_of(particles, particle_frame, index, orbit(view, pivot, 90.0))[..., :3],
            ]
            rows.append(np.hstack([_tile(tile) for tile in tiles]))
    sheet = images.encode_srgb(np.vstack(rows))
    for column, title in enumerate(COLUMNS):
        place = (column * sheet.shape[1] // len(COLUMNS) + 8, 20)
        cv2.putText(sheet, title, place, cv2.FONT_HERSHEY_SIMPLEX, 0.5, (220, 220, 220), 1, cv2.LINE_AA)
    with whole_file(path) as part:
        images.write_png(part, images.decode_srgb(sheet))


def orbit(view: View, pivot: np.ndarray, degrees: float) -> View:
    """The view from another side: turned about the upright axis through a point [3] m, its distance kept."""
    angle = math.radians(degrees)
    turn = np.array([[math.cos(angle), -math.sin(angle), 0.0], [math.sin(angle), math.cos(angle), 0.0], [0.0, 0.0, 1.0]])
    turned = np.eye(4)
    turned[:3, :3] = turn @ view.camera_to_world[:3, :3]
    turned[:3, 3] = turn @ (view.position - pivot) + pivot
    return View(
        width=view.width,
        height=view.height,
        fx=view.fx,
        fy=view.fy,
        cx=view.cx,
        cy=view.cy,
        camera_to_world=turned,
    )


def _middle(positions: np.ndarray, masses: np.ndarray, otherwise: np.ndarray) -> np.ndarray:
    """Centre of optical mass [3] m."""
    return np.average(positions, axis=0, weights=masses) if masses.sum() > 0 else otherwise


def _tile(image: np.ndarray) -> np.ndarray:
    width = max(1, round(image.shape[1] * TILE_HEIGHT / image.shape[0]))
    return cv2.resize(np.clip(image, 0.0, 1.0), (width, TILE_HEIGHT), interpolation=cv2.INTER_AREA).astype(np.float32)
