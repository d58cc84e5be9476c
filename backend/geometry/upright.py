"""Which way is up, from how a camera was held: who films turns and tilts the camera but keeps its rows level."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from backend.geometry.camera import View

_LEAST_TURN = 1e-3  # mean square by which the rows must leave a line before they tell a plane: a turn of 6 degrees in all
_MOST_ROLL = 3e-3  # mean square by which they may leave that plane: 3 degrees
_CLOSE = np.cos(np.radians(0.5))


def up_of(views: Sequence[View]) -> np.ndarray:
    """The direction [3] that is square to the rows of all images; the world's z where the cameras do not tell, or agree."""
    z = np.array([0.0, 0.0, 1.0])
    rows = np.stack([view.camera_to_world[:3, 0] for view in views])
    spread, directions = np.linalg.eigh(rows.T @ rows / len(rows))
    if spread[1] < _LEAST_TURN or spread[0] > _MOST_ROLL:
        return z
    down = np.mean([view.camera_to_world[:3, 1] for view in views], axis=0)
    up = directions[:, 0] * (-1.0 if directions[:, 0] @ down > 0 else 1.0)
    return z if up @ z > _CLOSE else up


def upright(up: np.ndarray) -> np.ndarray:
    """[4, 4]: the smallest rotation of the world that takes `up` to z."""
    z = np.array([0.0, 0.0, 1.0])
    matrix = np.eye(4)
    cosine = float(up @ z)
    if cosine < -1 + 1e-9:
        matrix[:3, :3] = np.diag([1.0, -1.0, -1.0])
    elif cosine < 1 - 1e-12:
        axis = np.cross(up, z)
        skew = np.array([[0, -axis[2], axis[1]], [axis[2], 0, -axis[0]], [-axis[1], axis[0], 0]])
        matrix[:3, :3] = np.eye(3) + skew + skew @ skew / (1 + cosine)  # Rodrigues 1840
    return matrix


def turned(view: View, matrix: np.ndarray) -> View:
    """The view in a world that was moved by a rigid motion [4, 4]."""
    return replace(view, camera_to_world=matrix @ view.camera_to_world)
