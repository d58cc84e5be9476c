"""Cameras as arrays: projection of points to pixels, rays, and views of another size.

Camera axes x right, y down, z forward (OpenCV); world right-handed, z up; pixel centres at +0.5.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from backend.contract.cameras import Cameras


@dataclass(frozen=True, slots=True, kw_only=True)
class View:
    """One camera at one moment. Intrinsics in px."""

    width: int
    height: int
    fx: float
    fy: float
    cx: float
    cy: float
    camera_to_world: np.ndarray  # [4, 4] float64

    @property
    def rotation_world_to_camera(self) -> np.ndarray:  # [3, 3]
        return self.camera_to_world[:3, :3].T

    @property
    def position(self) -> np.ndarray:  # [3] m
        return self.camera_to_world[:3, 3]

    def to_camera(self, points: np.ndarray) -> np.ndarray:
        """World points [N, 3] m in camera axes [N, 3] m. Subtracts the camera first, so far-away origins keep their digits."""
        return (points - self.position) @ self.camera_to_world[:3, :3]

    def to_world(self, points: np.ndarray) -> np.ndarray:
        """Camera-axes points [N, 3] m in the world [N, 3] m."""
        return points @ self.camera_to_world[:3, :3].T + self.position

    def project(self, points: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """World points [N, 3] m -> pixels [N, 2], depth along the optical axis [N] m (not positive: behind the camera)."""
        p = self.to_camera(points)
        depth = p[:, 2]
        safe = np.where(np.abs(depth) > 1e-12, depth, 1e-12)
        return np.stack([self.fx * p[:, 0] / safe + self.cx, self.fy * p[:, 1] / safe + self.cy], axis=1), depth

    def unproject(self, pixels: np.ndarray, depth: np.ndarray) -> np.ndarray:
        """Pixels [N, 2] at depth [N] m along the optical axis -> world points [N, 3] m."""
        x = (pixels[:, 0] - self.cx) / self.fx * depth
        y = (pixels[:, 1] - self.cy) / self.fy * depth
        return self.to_world(np.stack([x, y, depth], axis=1))


def view_at(cameras: Cameras, frame: int, *, size: tuple[int, int] | None = None) -> View:
    """The camera of a frame, with its intrinsics scaled to an image of `size` (width, height)."""
    view = View(
        width=cameras.width,
        height=cameras.height,
        fx=cameras.fx,
        fy=cameras.fy,
        cx=cameras.cx,
        cy=cameras.cy,
        camera_to_world=np.array(cameras.at(frame), np.float64),
    )
    return view if size is None else resized(view, size)


def resized(view: View, size: tuple[int, int]) -> View:
    """The same view in an image of another size (width, height)."""
    width, height = size
    sx, sy = width / view.width, height / view.height
    return replace(view, width=width, height=height, fx=view.fx * sx, fy=view.fy * sy, cx=view.cx * sx, cy=view.cy * sy)
