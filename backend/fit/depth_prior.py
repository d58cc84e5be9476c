"""How deep is smoke that one view shows? As deep as it is wide, unless something says otherwise.

The silhouette is filled with the largest balls that fit into it (its medial balls); their union is the prior's
solid. Along a ray the smoke is spread over the solid's chord with the profile (1 - s^2)^1.5, s in -1..1, the
projection of which is what a round plume with soft edges shows.
"""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np

from backend.geometry.camera import View

MAX_SIDE = 160  # px on which the balls are laid; the prior is smooth, more is waste
MASK_SHARE = 0.03  # of the robust maximum of the optical depth: where the silhouette ends


@dataclass(frozen=True, slots=True, kw_only=True)
class DepthPrior:
    """Per pixel of the optical-depth image: where along the ray the smoke is."""

    half_thickness: np.ndarray  # [H, W] m, half the chord of the solid; positive where there is smoke
    center_depth: np.ndarray  # [H, W] m along the optical axis
    is_smoke: np.ndarray  # [H, W] bool, the silhouette


def inflate(optical_depth: np.ndarray, view: View, anchor: np.ndarray) -> DepthPrior:
    """The solid of medial balls of a silhouette, about the upright plane through the anchor that faces the camera.

    optical_depth [H, W]; anchor [3] m, a point of the smoke in the world.
    """
    height, width = optical_depth.shape
    scale = min(1.0, MAX_SIDE / max(height, width))
    size = (max(1, round(width * scale)), max(1, round(height * scale)))
    small = cv2.resize(optical_depth.astype(np.float32), size, interpolation=cv2.INTER_AREA)
    threshold = MASK_SHARE * max(float(np.percentile(small, 99.5)), 1e-6)
    chord = _ball_union(small > threshold)
    chord = cv2.GaussianBlur(chord, (0, 0), 1.5)  # the union of balls has creases, smoke has none
    full = cv2.resize(chord, (width, height), interpolation=cv2.INTER_LINEAR)
    center = plane_depth(view, anchor)
    metres_per_pixel = center / (0.5 * (view.fx + view.fy)) / scale
    return DepthPrior(
        half_thickness=np.maximum(full, 0.5) * metres_per_pixel,
        center_depth=center,
        is_smoke=optical_depth > threshold,
    )


def plane_depth(view: View, anchor: np.ndarray) -> np.ndarray:
    """Depth [H, W] m at which each pixel's ray meets the upright plane through the anchor that faces the camera.

    A camera that looks steeply down has no such plane; then the plane is parallel to the image. Depth is kept within
    a factor two of the anchor's, which a plane seen at a slant would leave near the horizon.
    """
    forward = view.camera_to_world[:3, 2]
    normal = np.array([forward[0], forward[1], 0.0])
    if np.linalg.norm(normal) < 0.5:
        normal = forward
    normal = normal / np.linalg.norm(normal)
    x = (np.arange(view.width) + 0.5 - view.cx) / view.fx
    y = (np.arange(view.height) + 0.5 - view.cy) / view.fy
    axes = view.camera_to_world[:3, :3].T @ normal  # the normal in camera axes
    slope = axes[0] * x[None, :] + axes[1] * y[:, None] + axes[2]
    own = max(float(view.to_camera(anchor[None])[0, 2]), 1e-9)
    depth = float(normal @ (anchor - view.position)) / np.maximum(slope, 1e-6)
    return np.clip(depth, 0.5 * own, 2.0 * own)


def _ball_union(mask: np.ndarray) -> np.ndarray:
    """Half the chord of the union of medial balls [H, W], px. The image border is no edge: smoke goes on behind it."""
    padded = cv2.copyMakeBorder(mask.astype(np.uint8), 1, 1, 1, 1, cv2.BORDER_REPLICATE)
    border = max(mask.shape)
    padded = cv2.copyMakeBorder(padded, border, border, border, border, cv2.BORDER_REPLICATE)
    distance = cv2.distanceTransform(padded, cv2.DIST_L2, 5)
    limit = 0.35 * max(mask.shape)  # a frame full of smoke has no width to measure
    inner = np.minimum(distance[border + 1 : -border - 1, border + 1 : -border - 1], limit)
    is_ridge = (inner >= cv2.dilate(inner, np.ones((3, 3), np.uint8)) - 0.25) & (inner > 0)
    rows, columns = np.nonzero(is_ridge)
    order = np.argsort(-inner[rows, columns], kind="stable")
    square = np.zeros(mask.shape, np.float32)
    for row, column in zip(rows[order], columns[order], strict=True):
        radius = float(inner[row, column])
        reach = int(radius) + 1
        y0, y1 = max(0, row - reach), min(mask.shape[0], row + reach + 1)
        x0, x1 = max(0, column - reach), min(mask.shape[1], column + reach + 1)
        y = np.arange(y0, y1, dtype=np.float32)[:, None] - row
        x = np.arange(x0, x1, dtype=np.float32)[None, :] - column
        np.maximum(square[y0:y1, x0:x1], radius * radius - y * y - x * x, out=square[y0:y1, x0:x1])
    return np.sqrt(np.maximum(square, 0.0))


def sample_points(
    weight: np.ndarray,  # [H, W] not negative: optical depth still to be explained
    count: int,
    prior: DepthPrior,
    view: View,
    *,
    seed: int,
    is_even: bool = False,
) -> tuple[np.ndarray, np.ndarray]:
    """`count` points spread over a weight image and over the prior's depth, by its profile or evenly.

    Returns world positions [count, 3] m and the pixel each came from [count, 2]. Systematic sampling along a
    serpentine scan keeps neighbours apart; depth takes a golden-ratio sequence through the profile's quantiles.
    """
    total = float(weight.sum())
    if count <= 0 or not total > 0.0:
        return np.zeros((0, 3)), np.zeros((0, 2))
    random = np.random.default_rng(seed)
    height, width = weight.shape
    index = np.arange(height * width).reshape(height, width)
    index[1::2] = index[1::2, ::-1]
    scan = index.ravel()
    cumulative = np.cumsum(weight.ravel()[scan], dtype=np.float64)
    targets = (np.arange(count) + random.random()) / count * cumulative[-1]
    chosen = scan[np.minimum(np.searchsorted(cumulative, targets, side="right"), scan.size - 1)]
    rows, columns = chosen // width, chosen % width
    pixels = np.stack([columns + random.random(count), rows + random.random(count)], axis=1)
    quantile = (random.random() + np.arange(count) * 0.6180339887498949) % 1.0
    shuffled = random.permutation(quantile)
    share = 2.0 * shuffled - 1.0 if is_even else _profile_quantile(shuffled)
    offset = share * prior.half_thickness[rows, columns]
    center = prior.center_depth[rows, columns]
    return view.unproject(pixels, np.maximum(center + offset, 1e-2 * center)), pixels


def contain(
    positions: np.ndarray,  # [N, 3] m
    prior: DepthPrior,
    view: View,
    *,
    share: float,
) -> np.ndarray:
    """Positions with a share of what they stand out of the prior's solid, in depth, taken back.

    Sideways the image says where smoke is; in depth only the prior does, and pressure would drive it out there.
    """
    pixels, depth = view.project(positions)
    columns = np.clip(pixels[:, 0].astype(np.int64), 0, view.width - 1)
    rows = np.clip(pixels[:, 1].astype(np.int64), 0, view.height - 1)
    offset = depth - prior.center_depth[rows, columns]
    excess = np.sign(offset) * np.maximum(np.abs(offset) - prior.half_thickness[rows, columns], 0.0)
    wanted = np.where(depth > 0, depth - share * excess, depth)
    return np.where((depth > 0)[:, None], view.unproject(pixels, wanted), positions)


_S = np.linspace(-1.0, 1.0, 513)
_CUMULATIVE = np.concatenate([[0.0], np.cumsum((1.0 - 0.25 * (_S[1:] + _S[:-1]) ** 2) ** 1.5)])
_CUMULATIVE /= _CUMULATIVE[-1]


def _profile_quantile(quantile: np.ndarray) -> np.ndarray:
    """Inverse of the cumulative profile (1 - s^2)^1.5: [N] in 0..1 -> [N] in -1..1."""
    return np.interp(quantile, _CUMULATIVE, _S)
