"""What a whole clip shows of the levels of its smoke, in the form that the network of levels is shown it.

Of each frame one sheet is looked at, upright through the source and across the view: how much smoke each level shows on each part
of it. Lengths are in voxels of the prior's grids, times in strides.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import cv2
import numpy as np

from backend.geometry.camera import View
from backend.prior.window import OFFSETS, away_of

NUM_LEVELS, NUM_MOMENTS, NUM_PARTS = 32, 32, 28
PART = 2.0  # voxels across a sheet, whose middle is above the source
UNIT = 5.0  # voxels: of lengths that the network sees and says
NUM_CLUES = 6
HEIGHT = 2  # of the clues: that of the level above the source, in 4 UNIT
_REACH = OFFSETS[-1]  # strides to either side of a window's middle
_LEVEL = 1.25  # voxels
_FINE = 4  # samples of each part
_FLOOR = 0.02  # of a frame's largest optical depth, taken off everywhere: noise is no smoke


@dataclass(frozen=True, slots=True, kw_only=True)
class Sheets:
    """profile [T, Z, X] float32: shares of the fullest level's smoke; turns [3, T]: cosine and sine of the way across the view
    from the middle one's, and time in half windows; clues [NUM_CLUES, T, Z]: where the picture's edges are, height, which way the
    camera looks up or down, how near it is, how long the window is; heights [Z] m."""

    profile: np.ndarray
    turns: np.ndarray
    clues: np.ndarray
    heights: np.ndarray


def parts() -> np.ndarray:
    """[X] units: where the middles of the parts of a sheet are."""
    return PART / UNIT * (np.arange(NUM_PARTS) - 0.5 * (NUM_PARTS - 1))


def moments_around(frame: int, *, stride: int, num_frames: int) -> np.ndarray:
    """[T]: the frames that tell about `frame`, as far to either side as a window reaches; near an end, more to the other."""
    length = min(2 * _REACH * stride, num_frames - 1)
    first = min(max(frame - length // 2, 0), num_frames - 1 - length)
    return np.linspace(first, first + length, NUM_MOMENTS).round().astype(int)


def look_at_sheets(
    depth_at: Callable[[int], np.ndarray],
    view_at: Callable[[int], View],
    source: np.ndarray,
    frames: np.ndarray,
    *,
    height: float,
    voxel_size: float,
    stride: int,
) -> Sheets:
    """frames [T], in order; source [3] m; height m: of the grids' middle. depth_at, view_at: as for `look`."""
    heights = height + _LEVEL * voxel_size * (np.arange(NUM_LEVELS) - 0.5 * (NUM_LEVELS - 1))
    count = NUM_PARTS * _FINE
    across = PART / _FINE * voxel_size * (np.arange(count) - 0.5 * (count - 1))
    views = [view_at(int(frame)) for frame in frames]
    away = np.stack([away_of(view) for view in views])
    right = np.cross(away, [0.0, 0.0, 1.0])
    shown = np.empty((len(frames), NUM_LEVELS, NUM_PARTS), np.float32)
    edges = np.zeros((2, len(frames), NUM_LEVELS))
    sheet = np.empty((NUM_LEVELS, count, 3))
    sheet[..., 2] = heights[:, None]
    for index, view in enumerate(views):
        sheet[..., :2] = source[:2] + across[:, None] * right[index, :2]
        pixels, distances = view.project(sheet.reshape(-1, 3))
        at = (pixels - 0.5).astype(np.float32).reshape(*sheet.shape[:2], 2)
        image = np.ascontiguousarray(depth_at(int(frames[index])), np.float32)
        found = cv2.remap(image, at[..., 0], at[..., 1], cv2.INTER_LINEAR, borderMode=cv2.BORDER_CONSTANT, borderValue=0.0)
        inside = (distances > 0.0) & (pixels > 0.0).all(axis=1) & (pixels < (view.width, view.height)).all(axis=1)
        inside = inside.reshape(sheet.shape[:2])
        found = np.where(inside, np.maximum(found - _FLOOR * float(image.max(initial=0.0)), 0.0), 0.0)
        shown[index] = found.reshape(NUM_LEVELS, NUM_PARTS, _FINE).sum(axis=-1)
        is_any = inside.any(axis=-1)
        edges[0, index] = np.where(is_any, across[inside.argmax(axis=-1)], 0.0)
        edges[1, index] = np.where(is_any, across[-1 - inside[..., ::-1].argmax(axis=-1)], 0.0)
    half = len(frames) // 2
    one = np.ones(shown.shape[:2])
    distance = np.array([view.to_camera(source[None])[0, 2] for view in views])
    clues = [
        *(edges / (5 * UNIT * voxel_size)),
        (heights - source[2]) / (4 * UNIT * voxel_size) * one,
        np.array([view.camera_to_world[2, 2] for view in views])[:, None] * one,
        (20 * voxel_size / np.maximum(distance, voxel_size))[:, None] * one,
        (frames[-1] - frames[0]) / (2 * _REACH * stride) * one,
    ]
    time = (frames - frames[half]) / (_REACH * stride)
    return Sheets(
        profile=shown / max(float(shown.sum(axis=-1).max()), 1e-6),
        turns=np.stack([right @ right[half], right @ away[half], time]).astype(np.float32),
        clues=np.stack(clues).astype(np.float32),
        heights=heights,
    )
