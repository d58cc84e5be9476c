"""What the network sees: optical depths of frames around one, and where a grid that stands before its camera is in them.

The grid's axes are level with the ground: x to the camera's right, y away from it, z up. Everything is scaled so that the
network knows neither metres nor seconds: lengths in voxels, times in strides of frames, optical depths in their own mean.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np

from backend.field.lookup import trilinear
from backend.geometry.camera import View
from backend.geometry.lattice import Lattice

SHAPE = (24, 24, 40)  # voxels of the grid
OFFSETS = (-15, -10, -6, -4, -2, -1, 0, 1, 2, 4, 6, 10, 15)  # strides
NUM_CONDITIONS = 3 * len(OFFSETS)


@dataclass(frozen=True, slots=True, kw_only=True)
class Window:
    """images [O, h, w] float32: optical depths / scale; matrices [O, 3, 4] float32: voxel indices to homogeneous pixels, the
    first pixel's centre at 0; strides [O]: between the frame and each image, in truth, for a clip ends somewhere;
    conditions [NUM_CONDITIONS]: strides, and how far the camera has turned (sine) and how steeply it looks (sine);
    source [3]: what the smoke rises from, in voxels from the first one's centre."""

    images: np.ndarray
    matrices: np.ndarray
    strides: np.ndarray
    conditions: np.ndarray
    source: np.ndarray
    scale: float  # optical depth


@dataclass(frozen=True, slots=True, kw_only=True)
class Stand:
    """The grid before a camera. from_world [4, 4]: world to the grid's own axes."""

    lattice: Lattice
    from_world: np.ndarray

    def seen(self, view: View) -> View:
        """A view in the grid's own axes."""
        return replace(view, camera_to_world=self.from_world @ view.camera_to_world)

    def voxels(self, points: np.ndarray) -> np.ndarray:
        """World points [..., 3] m -> [..., 3] voxels from the first one's centre."""
        size = self.lattice.voxel_size
        return points @ (self.from_world[:3, :3].T / size) + (self.from_world[:3, 3] - np.asarray(self.lattice.origin)) / size

    def points(self, voxels: np.ndarray) -> np.ndarray:
        """[..., 3] voxels from the first one's centre -> world points [..., 3] m."""
        local = np.asarray(self.lattice.origin) + self.lattice.voxel_size * voxels
        return (local - self.from_world[:3, 3]) @ self.from_world[:3, :3]

    def centres(self) -> np.ndarray:
        """[X, Y, Z, 3] m: the voxels' centres in the world."""
        return (self.lattice.centres() - self.from_world[:3, 3]) @ self.from_world[:3, :3]

    def at(self, values: np.ndarray, points: np.ndarray, *, outside: str) -> np.ndarray:
        """Values of the voxels, [X, Y, Z] or [X, Y, Z, C], at world points [N, 3] m, trilinear -> [N] or [N, C].

        outside: "grid-constant" for zero one voxel beyond the outermost and further, "nearest" for the nearest voxel's.
        """
        return trilinear(values, self.voxels(points), outside=outside)

    def matrix(self, view: View) -> np.ndarray:
        """[3, 4]: voxel indices to homogeneous pixels of a view, the first pixel's centre at 0."""
        own = self.seen(view)
        rotation = own.rotation_world_to_camera
        size = self.lattice.voxel_size
        offset = rotation @ (np.asarray(self.lattice.origin) - own.position)
        camera = np.array([[view.fx, 0.0, view.cx - 0.5], [0.0, view.fy, view.cy - 0.5], [0.0, 0.0, 1.0]])
        return camera @ np.concatenate([size * rotation, offset[:, None]], axis=1)


def away_of(view: View) -> np.ndarray:
    """[3] of length 1: level, away from a camera; of one that looks straight down or up, the way its pictures' tops point."""
    away = view.camera_to_world[:3, 2] * (1.0, 1.0, 0.0)
    if np.linalg.norm(away) < 1e-6:
        away = -view.camera_to_world[:3, 1] * (1.0, 1.0, 0.0)
    return away / np.linalg.norm(away)


def stand_before(view: View, centre: np.ndarray, *, voxel_size: float, shape: tuple[int, int, int]) -> Stand:
    """The grid with its middle at `centre` [3] m, turned towards a view."""
    away = away_of(view)
    up = np.array([0.0, 0.0, 1.0])
    from_world = np.eye(4)
    from_world[:3, :3] = np.stack([np.cross(away, up), away, up])
    from_world[:3, 3] = -from_world[:3, :3] @ centre
    origin = tuple(-0.5 * voxel_size * (size - 1) for size in shape)
    return Stand(lattice=Lattice(origin=origin, voxel_size=voxel_size, shape=shape), from_world=from_world)  # type: ignore[arg-type]


def look(
    depth_at: Callable[[int], np.ndarray],
    view_at: Callable[[int], View],
    stand: Stand,
    source: np.ndarray,
    frame: int,
    *,
    stride: int,
    num_frames: int,
) -> Window:
    """What is known about `frame`. depth_at: frame -> optical depth [h, w]; view_at: frame -> its view at that size.

    source [3] m: what the smoke rises from. Raises ValueError where an image holds what is no number.
    """
    frames = [min(max(frame + offset * stride, 0), num_frames - 1) for offset in OFFSETS]
    images = np.stack([depth_at(number) for number in frames]).astype(np.float32)
    if not np.isfinite(images).all():
        raise ValueError("optical depths hold NaN or infinity")
    total, squares = images.sum(dtype=np.float64), np.square(images, dtype=np.float64).sum()
    scale = float(squares / total) if total > 0 else 1.0
    views = [view_at(number) for number in frames]
    forward = np.stack([stand.seen(view).camera_to_world[:3, 2] for view in views])
    strides = (np.array(frames) - frame) / stride
    turned = forward[:, 0] / np.maximum(np.hypot(forward[:, 0], forward[:, 1]), 1e-6)
    return Window(
        images=images / np.float32(scale),
        matrices=np.stack([stand.matrix(view) for view in views]).astype(np.float32),
        strides=strides.astype(np.float32),
        conditions=np.concatenate([strides / OFFSETS[-1], turned, forward[:, 2]]).astype(np.float32),
        source=stand.voxels(np.asarray(source, np.float64)).astype(np.float32),
        scale=scale,
    )
