"""Answers that need no reconstruction. A figure means nothing without theirs beside it."""

from __future__ import annotations

import cv2
import numpy as np

from backend.geometry.camera import View

TRIVIAL = ("black", "grey", "copy", "mirror", "billboard")


def trivial_view(name: str, picture: np.ndarray, seen: View, wanted: View, anchor: np.ndarray) -> np.ndarray:
    """[H, W, 4] in the view `wanted`, from the input picture [H, W, 4] of the same moment in the view `seen`.

    copy: the picture itself; mirror: left and right exchanged; billboard: the picture on a plane through `anchor` [3] m that
    faces the input camera, as the wanted camera sees it; grey: the picture's mean light everywhere. All assume equal sizes.
    """
    if name == "black":
        return np.zeros_like(picture)
    if name == "grey":
        return np.broadcast_to(picture.mean(axis=(0, 1)), picture.shape).astype(np.float32)
    if name == "copy":
        return picture
    if name == "mirror":
        return picture[:, ::-1]
    if name == "billboard":
        return _billboard(picture, seen, wanted, anchor)
    raise ValueError(f'there is no trivial answer "{name}"')


def _billboard(picture: np.ndarray, seen: View, wanted: View, anchor: np.ndarray) -> np.ndarray:
    """By the homography that the plane makes of the two views."""
    depth = float(seen.to_camera(anchor[None])[0, 2])
    corners = np.array([[0.0, 0.0], [seen.width, 0.0], [seen.width, seen.height], [0.0, seen.height]])
    pixels, depths = wanted.project(seen.unproject(corners, np.full(4, depth)))
    if depths.min() <= 0.0:
        return np.zeros_like(picture)
    # OpenCV counts from the centre of the first pixel, we from its corner.
    matrix = cv2.getPerspectiveTransform((corners - 0.5).astype(np.float32), (pixels - 0.5).astype(np.float32))
    return cv2.warpPerspective(picture, matrix, (wanted.width, wanted.height), flags=cv2.INTER_AREA)
