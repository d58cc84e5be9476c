"""What every frame of a fit shares: the views at the size of the smoke layer, the time step, where the smoke stands."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from backend.contract.cameras import Cameras
from backend.fit.foot import standing_point
from backend.fit.series import Series
from backend.fit.source import source_point
from backend.geometry.camera import View, view_at

MAX_OPACITY = 0.99  # an 8-bit frame cannot tell more: beyond it optical depth is a guess
LEAST_TURN = math.radians(5.0)  # of the camera about the smoke, for anything to be seen of its depth


@dataclass(frozen=True, slots=True, kw_only=True)
class Scene:
    """Views of all frames at the smoke layer's size, seconds a frame, and a point that the smoke rises from."""

    views: tuple[View, ...]
    seconds_per_frame: float
    anchor: np.ndarray  # [3] m

    @property
    def num_frames(self) -> int:
        return len(self.views)


def make_scene(layers: Series[np.ndarray], cameras: Cameras) -> Scene:
    """layers: [H, W, 4] premultiplied linear RGB and opacity, one a frame."""
    height, width = layers[0].shape[:2]
    views = tuple(view_at(cameras, frame, size=(width, height)) for frame in range(len(layers)))
    anchor = standing_point(views[0]) if cameras.is_still else source_point(lambda frame: optical_depth(layers[frame]), views)
    return Scene(views=views, seconds_per_frame=1.0 / cameras.fps, anchor=anchor)


def optical_depth(layer: np.ndarray) -> np.ndarray:
    """tau = -log(1 - opacity) [H, W] of a smoke layer [H, W, 4]."""
    return -np.log1p(-np.clip(layer[..., 3], 0.0, MAX_OPACITY)).astype(np.float32)


def is_origin_seen(view: View) -> bool:
    """Whether the world's origin is before the camera, in the picture or at most half a picture beside it."""
    pixels, depth = view.project(np.zeros((1, 3)))
    share = np.abs(pixels[0] / (view.width, view.height) - 0.5)
    return bool(depth[0] > 0.0 and share.max() <= 1.0)


def turned_about(views: Sequence[View], anchor: np.ndarray) -> float:
    """Radians: how far the camera goes around the smoke's anchor [3] m. Exact where it goes along an arc: from the place that is
    furthest from the first one to the place that is furthest from that."""
    ways = np.array([view.position for view in views]) - anchor
    ways /= np.maximum(np.linalg.norm(ways, axis=1, keepdims=True), 1e-12)
    end = ways[np.argmin(ways @ ways[0])]
    return float(np.arccos(np.clip((ways @ end).min(), -1.0, 1.0)))
