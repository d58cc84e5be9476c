"""One lesson: a moment of a plume, a camera that moves as someone might have moved it, and the truth before that camera."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import numpy as np
from scipy import ndimage

from backend.field.rays import optical_depth
from backend.fit.pace import STEP, longest_stride
from backend.fit.region import CELLS_HIGH, CELLS_WIDE, PIXELS_A_CELL
from backend.fit.source import source_point
from backend.geometry.camera import View
from backend.geometry.lattice import Lattice
from backend.prior.window import SHAPE, Stand, Window, away_of, look, stand_before
from synthetic.sweep import Orbit, orbit_cameras
from training.library import FPS, NUM_FRAMES, VELOCITY_EVERY, Plume

_WHOLE = 0.65  # of the lessons: their pictures show all of the smoke, and the grid holds it
LEAST, MOST = (34, 64), (56, 96)  # px, width and height of pictures: smoke leaves those that are small
LEAST_WHOLE = (46, 76)  # px, of pictures that show all of it
_STEP = 1.5 * STEP  # voxels that smoke moves in a stride, where a fit sees STEP in the pictures: rays mix what goes many ways
_STEP_SPREAD = 0.25  # of its logarithm
_SHORTEST = 15, 90  # frames of a clip, of one lesson in two
_OFF, _OFTEN = (1.5, 4.5), (0.5, 0.5)  # voxels, by which grids stand beside the smoke: taught that they stand right, the prior
# would leave those where they are that do not
_UNTOLD = 3.0  # voxels, by which a grid stands before or behind where smoke is taken to rise, of a camera that stands still
_KINDS = {"orbit": 0.65, "still": 0.2, "wild": 0.15}  # of cameras, and how often
_LEAST_CELL = 0.2  # m; the plumes know nothing finer
_FRAMES = 5  # that tell where a clip's smoke is and how fast
_EDGE = 0.03  # of the largest optical depth: where smoke ends
FOOT_FRAMES = 16  # that the source is looked for in
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
    num_frames = int(draw.integers(draw.choice(_SHORTEST), NUM_FRAMES + 1))
    first = int(draw.integers(0, NUM_FRAMES - num_frames + 1))
    candidates = [t for t in range(first, first + num_frames) if t % VELOCITY_EVERY == 0]
    moment = int(draw.choice(candidates))
    kind = draw.choice(list(_KINDS), p=list(_KINDS.values()))
    smoke = smoke_of(plume, first, num_frames)
    is_whole = draw.random() < _WHOLE
    cell = cell_for(smoke, draw, is_whole=is_whole)
    cut = max(smoke.top - smoke.bottom - CELLS_HIGH * cell, 0.0)  # what does not fit into the grid, mostly above
    height = 0.5 * (smoke.bottom + smoke.top) - draw.uniform(0.0, 0.6) * cut + draw.normal(0.0, cell)
    centre = np.array([*(smoke.middle + draw.normal(0.0, cell * draw.choice(_OFF, p=_OFTEN), 2)), height])
    size = draw.integers(LEAST_WHOLE if is_whole else LEAST, MOST, endpoint=True)
    stride = stride_for(smoke, draw, cell=cell, num_frames=num_frames)
    views = camera_way(draw, kind, num_frames, height=centre[2], pixel=cell / PIXELS_A_CELL, size=size)
    lattice = lattice_of(plume)
    noise = draw.choice([0.002, 0.01])

    def clear_depth_at(index: int) -> np.ndarray:
        return optical_depth(plume.density_at(first + index), lattice, views[index], step=1.0)

    if kind == "still":  # nothing tells how far away it is, nor may where the grid stands
        source = np.mean([item.position for item in plume.scene.sources], axis=0) + draw.normal(0.0, 0.25, 3)
        source += draw.normal(0.0, 0.8) * views[0].camera_to_world[:3, 2]
        away = away_of(views[0])
        centre += away * (away @ (source - centre) + draw.normal(0.0, _UNTOLD * cell))
    else:
        source = source_point(clear_depth_at, views, most_frames=FOOT_FRAMES) + draw.normal(0.0, 0.15, 3)

    stand = stand_before(views[moment - first], centre, voxel_size=cell, shape=SHAPE)

    def depth_at(index: int) -> np.ndarray:
        return filmed(clear_depth_at(index), noise, draw)

    window = look(depth_at, lambda index: views[index], stand, source, moment - first, stride=stride, num_frames=num_frames)
    density, velocity = truth(plume, moment, stand)
    return Lesson(
        window=replace(window, images=np.pad(window.images, ((0, 0), (0, MOST[1] - size[1]), (0, MOST[0] - size[0])))),
        size=size,
        density=density * (cell / window.scale),
        velocity=velocity * (stride / FPS / cell),
    )


def filmed(depth: np.ndarray, noise: float, draw: np.random.Generator) -> np.ndarray:
    """Optical depths as eight noisy bits of opacity tell them; noise: its standard deviation."""
    opacity = 1 - np.exp(-depth) + noise * draw.standard_normal(depth.shape).astype(np.float32)
    return -np.log1p(-np.clip(opacity, 0.0, 1 - math.exp(-_MOST_DEPTH)))


@dataclass(frozen=True, slots=True, kw_only=True)
class Smoke:
    """Of a clip. middle [2] m: x and y; bottom, top: m; cell: m, the voxel of a grid that it fills; speed: m/s across a view."""

    middle: np.ndarray
    bottom: float
    top: float
    cell: float
    speed: float


def smoke_of(plume: Plume, first: int, num_frames: int) -> Smoke:
    """Where a clip's smoke is and how fast; the whole world's where there is none."""
    frames = np.linspace(first, first + num_frames - 1, _FRAMES).round().astype(int) // VELOCITY_EVERY * VELOCITY_EVERY
    mass, levels, widths, speeds, weights = np.zeros(plume.density.shape[1:3]), [], [], [], []
    for frame in frames:
        density = plume.density_at(frame)
        mass += density.sum(axis=2, dtype=np.float64)
        for axis in (0, 1):
            depth = density.sum(axis=axis)
            is_smoke = depth > _EDGE * max(float(depth.max()), 1e-3)
            levels.append(np.flatnonzero(is_smoke.any(axis=0)))
            widths.append(int(is_smoke.any(axis=1).sum()))
        x, y, z = np.moveaxis(plume.velocity_at(frame), -1, 0)
        speeds.append(np.sqrt(0.5 * (x * x + y * y) + z * z)[density > 0])
        weights.append(density[density > 0])
    if not mass.any():
        top = plume.voxel_size * plume.density.shape[3]
        return Smoke(middle=np.zeros(2), bottom=0.0, top=top, cell=top / CELLS_HIGH, speed=0.0)
    level, speed, weight = (np.concatenate(parts) for parts in (levels, speeds, weights))
    bottom, top = (plume.origin[2] + plume.voxel_size * edge for edge in (level.min() - 0.5, level.max() + 0.5))
    wide = plume.voxel_size * float(np.quantile(widths, 0.9))
    return Smoke(
        middle=np.asarray(plume.origin[:2]) + plume.voxel_size * np.array(ndimage.center_of_mass(mass)),
        bottom=float(bottom),
        top=float(top),
        cell=float(max((top - bottom) / CELLS_HIGH, wide / CELLS_WIDE)),
        speed=float(np.quantile(speed, 0.5, weights=weight.astype(np.float64), method="inverted_cdf")),
    )


def cell_for(smoke: Smoke, draw: np.random.Generator, *, is_whole: bool) -> float:
    """m: the voxel of a grid that holds all of the smoke, give or take, or only part of it."""
    return max(smoke.cell, _LEAST_CELL) * (draw.uniform(0.95, 1.1) if is_whole else draw.uniform(0.6, 0.95))


def stride_for(smoke: Smoke, draw: np.random.Generator, *, cell: float, num_frames: int) -> int:
    """Frames in which smoke goes about as far as a fit sees to, of a clip of `num_frames`."""
    step = _STEP * cell * draw.lognormal(0.0, _STEP_SPREAD)
    return int(np.clip(round(step * FPS / max(smoke.speed, 1e-3)), 1, longest_stride(num_frames)))


def lattice_of(plume: Plume) -> Lattice:
    """Where its voxels lie."""
    return Lattice(origin=plume.origin, voxel_size=plume.voxel_size, shape=plume.density.shape[1:])  # type: ignore[arg-type]


def truth(plume: Plume, moment: int, stand: Stand) -> tuple[np.ndarray, np.ndarray]:
    """Density [X, Y, Z] 1/m and velocity [X, Y, Z, 3] m/s of a plume on the grid, along its axes."""
    at = np.moveaxis((stand.centres() - plume.origin) / plume.voxel_size, -1, 0)
    density, velocity = plume.density_at(moment), plume.velocity_at(moment)
    found = [ndimage.map_coordinates(velocity[..., axis], at, order=1, mode="nearest") for axis in range(3)]
    return (
        ndimage.map_coordinates(density, at, order=1, mode="constant"),
        (np.stack(found, axis=-1) @ stand.from_world[:3, :3].T).astype(np.float32),
    )


def camera_way(
    draw: np.random.Generator, kind: str, num_frames: int, *, height: float, pixel: float, size: np.ndarray
) -> list[View]:
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
