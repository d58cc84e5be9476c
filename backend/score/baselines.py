"""Answers that need no reconstruction. A figure means nothing without theirs beside it."""

from __future__ import annotations

import cv2
import numpy as np

from backend.geometry.camera import View

TRIVIAL = ("black", "grey", "copy", "mirror", "billboard")


def trivial_view(name: str, picture: np.ndarray, seen: View, wanted: View, anchor: np.ndarray) -> np.ndarray:
    """[H, W, 4] in the view `wanted`, from the input picture [h, w, 4] of the same moment in the view `seen`.

    copy: the picture itself, at the wanted size; mirror: left and right exchanged; billboard: the picture on a plane through
    `anchor` [3] m that faces the input camera, as the wanted camera sees it; grey: the picture's mean light everywhere.
    """
    shape = (wanted.height, wanted.width, 4)
    if name == "black":
        return np.zeros(shape, np.float32)
    if name == "grey":
        return np.broadcast_to(picture.mean(axis=(0, 1)), shape).astype(np.float32)
    if name in ("copy", "mirror"):
        is_same = picture.shape == shape
        sized = picture if is_same else cv2.resize(picture, (wanted.width, wanted.height), interpolation=cv2.INTER_AREA)
        return sized if name == "copy" else sized[:, ::-1]
    if name == "billboard":
        return _billboard(picture, seen, wanted, anchor)
    raise ValueError(f'there is no trivial answer "{name}"')


def _billboard(picture: np.ndarray, seen: View, wanted: View, anchor: np.ndarray) -> np.ndarray:
    """By the homography that the plane makes of the two views."""
    depth = float(seen.to_camera(anchor[None])[0, 2])
    corners = np.array([[0.0, 0.0], [seen.width, 0.0], [seen.width, seen.height], [0.0, seen.height]])
    pixels, depths = wanted.project(seen.unproject(corners, np.full(4, depth)))
    if depths.min() <= 0.0:
        return np.zeros((wanted.height, wanted.width, 4), np.float32)
    # OpenCV counts from the centre of the first pixel, we from its corner.
    matrix = cv2.getPerspectiveTransform((corners - 0.5).astype(np.float32), (pixels - 0.5).astype(np.float32))
    return cv2.warpPerspective(picture, matrix, (wanted.width, wanted.height), flags=cv2.INTER_AREA)
