"""Cameras of the benchmark: the training sweep and the test views around it, as contract cameras.

Azimuth turns about +z from +x: a camera at -90 degrees stands at -y and looks along +y. Elevation is above the horizon.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

from backend.contract.cameras import Cameras, Matrix

Vector = tuple[float, float, float]


@dataclass(frozen=True, slots=True, kw_only=True)
class Orbit:
    """A camera that looks at `target` (m) from `distance` (m); angles in degrees, half_height: m seen above the target.

    Azimuth runs from azimuth_start at frame 0 linearly to azimuth_stop at frame num_frames (supplement 7.1:
    phi(t) = -105 + 60 t / T').
    """

    target: Vector = (0.0, 0.0, 8.2)
    distance: float = 32.0
    half_height: float = 10.8
    elevation: float = 10.0
    azimuth_start: float = -105.0
    azimuth_stop: float = -45.0


def orbit_cameras(orbit: Orbit, *, width: int, height: int, fps: float, num_frames: int) -> Cameras:
    """The moving camera over num_frames; a single one where the orbit does not move."""
    turn = orbit.azimuth_stop - orbit.azimuth_start
    count = num_frames if turn else 1
    angles = [orbit.azimuth_start + turn * frame / num_frames for frame in range(count)]
    focal = 0.5 * height * orbit.distance / orbit.half_height
    return Cameras(
        width=width,
        height=height,
        fx=focal,
        fy=focal,
        cx=0.5 * width,
        cy=0.5 * height,
        fps=fps,
        camera_to_world=tuple(_orbit_matrix(orbit, azimuth) for azimuth in angles),
    )


def still_cameras(orbit: Orbit, *, turned: float, width: int, height: int, fps: float) -> Cameras:
    """A camera that stands still at the first frame's place, turned about the vertical axis by `turned` degrees."""
    azimuth = orbit.azimuth_start + turned
    still = replace(orbit, azimuth_start=azimuth, azimuth_stop=azimuth)
    return orbit_cameras(still, width=width, height=height, fps=fps, num_frames=1)


def look_at(position: Vector, target: Vector) -> Matrix:
    """camera_to_world [4, 4]: axes x right, y down, z forward. Raises ValueError when looking straight up or down."""
    forward = _unit(tuple(t - p for t, p in zip(target, position, strict=True)))
    right = _cross(forward, (0.0, 0.0, 1.0))
    if math.hypot(*right) < 1e-6:
        raise ValueError("a camera that looks straight up or down has no upright image")
    right = _unit(right)
    down = _cross(forward, right)
    rows = [(right[i], down[i], forward[i], position[i]) for i in range(3)]
    return (*rows, (0.0, 0.0, 0.0, 1.0))


def _orbit_matrix(orbit: Orbit, azimuth: float) -> Matrix:
    a, e = math.radians(azimuth), math.radians(orbit.elevation)
    direction = (math.cos(e) * math.cos(a), math.cos(e) * math.sin(a), math.sin(e))
    x, y, z = (t + orbit.distance * d for t, d in zip(orbit.target, direction, strict=True))
    return look_at((x, y, z), orbit.target)


def _cross(a: Vector, b: Vector) -> Vector:
    return a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]


def _unit(vector: tuple[float, ...]) -> Vector:
    length = math.hypot(*vector)
    x, y, z = (value / length for value in vector)
    return x, y, z
