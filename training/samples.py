"""One lesson: a moment of a plume, a camera that moves as someone might have moved it, and the truth before that camera."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import numpy as np
from scipy import ndimage

from backend.field.rays import optical_depth
from backend.fit.pace import longest_stride
from backend.fit.region import PIXELS_A_CELL
from backend.fit.scene import meeting_point
from backend.geometry.camera import View
from backend.geometry.lattice import Lattice
from backend.prior.predict import SHAPE
from backend.prior.window import Stand, Window, look, stand_before
from synthetic.sweep import Orbit, orbit_cameras
from training.library import FPS, NUM_FRAMES, VELOCITY_EVERY, VOXEL_SIZE, Plume

_CELLS = (0.32, 0.56)  # m, the least and the largest voxel
_LEAST, _MOST = (34, 64), (56, 96)  # px, width and height of pictures: smoke leaves those that are small
_SHORTEST = 15  # frames of a clip
_OFF, _OFTEN = (0.5, 1.5), (0.7, 0.3)  # m, by which a fit misses the middle of the smoke when it asks, and when it first asks
_MIDDLE_FRAMES = 5  # that the middle is taken of
_FOOT_FRAMES = 16  # that the source is looked for in
_MOST_DEPTH = 5.5  # what 8 bits of opacity tell


@dataclass(frozen=True, slots=True, kw_only=True)
class Lesson:
    """density [X, Y, Z] in scale/voxel, velocity [X, Y, Z, 3] in voxels a stride, along the grid's own axes.

    size [2]: width and height of the window's images, px, before zeros made all lessons' equally large.
    """

    window: Window
    size: np.ndarray
    density: np.ndarray
    velocity: np.ndarray


def draw_lesson(plume: Plume, draw: np.random.Generator) -> Lesson:
    """A random moment, camera and noise."""
    num_frames = int(draw.integers(_SHORTEST, NUM_FRAMES + 1))
    stride = min(int(draw.integers(2, 7)), longest_stride(num_frames))
    first = int(draw.integers(0, NUM_FRAMES - num_frames + 1))
    candidates = [t for t in range(first, first + num_frames) if t % VELOCITY_EVERY == 0]
    moment = int(draw.choice(candidates))
    kind = draw.choice(["orbit", "still", "wild"], p=[0.7, 0.15, 0.15])
    cell = draw.uniform(*_CELLS)
    reach = 0.5 * SHAPE[2] * cell
    height = reach + draw.uniform(-0.1, 0.25) * (20.0 - 2 * reach) + draw.normal(0.0, 0.5)
    centre = np.array([*(_middle(plume, first, num_frames) + draw.normal(0.0, draw.choice(_OFF, p=_OFTEN), 2)), height])
    size = draw.integers(_LEAST, _MOST, endpoint=True)
    views = _views(draw, kind, num_frames, height=centre[2], pixel=cell / PIXELS_A_CELL, size=size)
    stand = stand_before(views[moment - first], centre, voxel_size=cell, shape=SHAPE)
    lattice = lattice_of(plume)
    noise = draw.choice([0.002, 0.01])

    def clear_depth_at(index: int) -> np.ndarray:
        return optical_depth(plume.density_at(first + index), lattice, views[index], step=1.0)

    if kind == "still":  # nothing tells how far away it is
        source = np.mean([item.position for item in plume.scene.sources], axis=0) + draw.normal(0.0, 0.25, 3)
        source += draw.normal(0.0, 0.8) * views[0].camera_to_world[:3, 2]
    else:
        source = meeting_point(clear_depth_at, views, most_frames=_FOOT_FRAMES) + draw.normal(0.0, 0.15, 3)

    def depth_at(index: int) -> np.ndarray:
        depth = clear_depth_at(index)
        opacity = 1 - np.exp(-depth) + noise * draw.standard_normal(depth.shape).astype(np.float32)
        return -np.log1p(-np.clip(opacity, 0.0, 1 - math.exp(-_MOST_DEPTH)))

    window = look(depth_at, lambda index: views[index], stand, source, moment - first, stride=stride, num_frames=num_frames)
    density, velocity = truth(plume, moment, stand)
    return Lesson(
        window=replace(window, images=np.pad(window.images, ((0, 0), (0, _MOST[1] - size[1]), (0, _MOST[0] - size[0])))),
        size=size,
        density=density * (cell / window.scale),
        velocity=velocity * (stride / FPS / cell),
    )


def _middle(plume: Plume, first: int, num_frames: int) -> np.ndarray:
    """x and y m of the middle of a clip's smoke; the world's where there is none."""
    frames = np.linspace(first, first + num_frames - 1, _MIDDLE_FRAMES).round().astype(int)
    mass = np.sum([plume.density_at(frame).sum(axis=2, dtype=np.float64) for frame in frames], axis=0)
    if not mass.any():
        return np.zeros(2)
    return np.asarray(plume.origin[:2]) + VOXEL_SIZE * np.array(ndimage.center_of_mass(mass))


def lattice_of(plume: Plume) -> Lattice:
    """Where its voxels lie."""
    return Lattice(origin=plume.origin, voxel_size=VOXEL_SIZE, shape=plume.density.shape[1:])  # type: ignore[arg-type]


def truth(plume: Plume, moment: int, stand: Stand) -> tuple[np.ndarray, np.ndarray]:
    """Density [X, Y, Z] 1/m and velocity [X, Y, Z, 3] m/s of a plume on the grid, along its axes."""
    at = np.moveaxis((stand.centres() - plume.origin) / VOXEL_SIZE, -1, 0)
    density, velocity = plume.density_at(moment), plume.velocity_at(moment)
    found = [ndimage.map_coordinates(velocity[..., axis], at, order=1, mode="nearest") for axis in range(3)]
    return (
        ndimage.map_coordinates(density, at, order=1, mode="constant"),
        (np.stack(found, axis=-1) @ stand.from_world[:3, :3].T).astype(np.float32),
    )


def _views(draw: np.random.Generator, kind: str, num_frames: int, *, height: float, pixel: float, size: np.ndarray) -> list[View]:
    """A camera on a tripod, on an orbit or walking by, that looks at `height` m with `size` pixels of `pixel` m."""
    rate = 0.0 if kind == "still" else draw.choice([-1, 1]) * draw.uniform(0.15, 0.7)  # degrees a frame
    start, elevation = draw.uniform(-180, 180), draw.uniform(2, 20)
    distance = draw.uniform(22, 45)
    orbit = Orbit(
        target=(*draw.normal(0.0, 0.4, 2), height + draw.normal(0.0, 0.4)),
        distance=distance,
        half_height=0.5 * size[1] * pixel,
        elevation=elevation,
        azimuth_start=start,
        azimuth_stop=start + rate * num_frames,
    )
    width, height = int(size[0]), int(size[1])
    cameras = orbit_cameras(orbit, width=width, height=height, fps=FPS, num_frames=num_frames)
    climb = draw.normal(0.0, 4.0) if kind == "wild" else 0.0  # m over the clip
    views = []
    for frame in range(num_frames):
        matrix = np.array(cameras.at(frame), np.float64)
        matrix[2, 3] += climb * (frame / num_frames - 0.5)
        matrix[:3, 3] += matrix[:3, 2] * (climb * math.sin(3 * frame / num_frames))
        views.append(
            View(width=width, height=height, fx=cameras.fx, fy=cameras.fy, cx=cameras.cx, cy=cameras.cy, camera_to_world=matrix)
        )
    return views
