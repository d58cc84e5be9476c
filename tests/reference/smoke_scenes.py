"""Cameras and random Gaussians for the tests of the renderer."""

from __future__ import annotations

from typing import Any

import numpy as np

from backend.geometry.camera import View
from backend.render.gaussians import Gaussians


def turned_view(width: int, height: int, *, seed: int = 0, at: tuple[float, float, float] = (3.0, -2.0, 5.0)) -> View:
    """A camera in a random direction; its principal point is off the centre and its pixels are not square."""
    random = np.random.default_rng(seed)
    rotation, _ = np.linalg.qr(random.normal(size=(3, 3)))
    rotation *= np.sign(np.linalg.det(rotation))
    matrix = np.eye(4)
    matrix[:3, :3], matrix[:3, 3] = rotation, at
    return View(
        width=width, height=height, fx=1.2 * width, fy=1.3 * width, cx=0.52 * width, cy=0.48 * height, camera_to_world=matrix
    )


def plain_view(width: int, height: int, focal: float) -> View:
    """A camera at the origin that looks along z."""
    return View(width=width, height=height, fx=focal, fy=focal, cx=width / 2, cy=height / 2, camera_to_world=np.eye(4))


def cloud(view: View, num: int, *, seed: int = 1, smallest: float = 1e-3, largest: float = 0.6) -> Gaussians:
    """Random Gaussians before the camera, some outside the image; sizes spread evenly in the logarithm, aspect up to 10."""
    random = np.random.default_rng(seed)
    depth = random.uniform(1.0, 4.0, num)
    in_camera = np.stack([random.uniform(-0.6, 0.6, num) * depth, random.uniform(-0.45, 0.45, num) * depth, depth], axis=1)
    sizes = np.exp(random.uniform(np.log(smallest), np.log(largest), (num, 1)))
    return Gaussians(
        positions=view.to_world(in_camera),
        scales=sizes * 10 ** random.uniform(-1.0, 0.0, (num, 3)),
        rotations=random.normal(size=(num, 4)),
        optical_masses=random.uniform(0.1, 1.0, num) * sizes[:, 0] ** 2,
        colors=random.uniform(size=(num, 3)),
    )


def one(position: Any, scales: Any, *, mass: float = 1.0, rotation: Any = (1.0, 0.0, 0.0, 0.0)) -> Gaussians:
    """A single white Gaussian."""
    return Gaussians(
        positions=np.array([position], np.float64),
        scales=np.array([scales], np.float64) * np.ones((1, 3)),
        rotations=np.array([rotation], np.float64),
        optical_masses=np.array([mass], np.float64),
        colors=np.ones((1, 3)),
    )
