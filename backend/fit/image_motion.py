"""What the image says about sideways motion: dense flow between two frames, lifted to the particles' depth."""

from __future__ import annotations

import cv2
import numpy as np

from backend.geometry.camera import View


def dense_flow(before: np.ndarray, after: np.ndarray) -> np.ndarray:
    """Motion of each pixel from one smoke layer to the next.

    before, after [H, W, 4] premultiplied linear RGB and opacity. Returns [H, W, 2] px; zero where there is no smoke.
    Kroeger et al. 2016 (DIS), on the square root of brightness and opacity together.
    """
    if min(before.shape[:2]) < 16:
        return np.zeros((*before.shape[:2], 2), np.float32)
    first, second = _gray(before), _gray(after)
    flow = cv2.DISOpticalFlow.create(cv2.DISOPTICAL_FLOW_PRESET_MEDIUM).calc(first, second, None)  # type: ignore[call-overload]
    weight = np.maximum(before[..., 3], after[..., 3])
    weight = np.minimum(1.0, 10.0 * weight)[..., None]
    blurred = cv2.GaussianBlur(flow * weight, (0, 0), 2.0) / (cv2.GaussianBlur(weight, (0, 0), 2.0)[..., None] + 1e-3)
    return np.where(np.isfinite(blurred), blurred, 0.0).astype(np.float32)


def _gray(layer: np.ndarray) -> np.ndarray:
    """[H, W] uint8: texture and silhouette in one image."""
    luminance = layer[..., :3] @ np.array([0.2126, 0.7152, 0.0722], np.float32)
    mixed = np.sqrt(np.clip(0.6 * luminance + 0.4 * layer[..., 3], 0.0, 1.0))
    return (255.0 * mixed).astype(np.uint8)


def lift_flow(
    flow: np.ndarray,  # [H, W, 2] px, from the first view's frame to the second's
    opacity: np.ndarray,  # [H, W]
    positions: np.ndarray,  # [N, 3] m in the world, at the first frame
    views: tuple[View, View],
) -> tuple[np.ndarray, np.ndarray]:
    """Displacement [N, 3] m that the flow asks of each particle at constant depth, and its confidence [N] 0..1.

    The camera's own motion is taken out: the point is projected by the first view and unprojected by the second.
    """
    first, second = views
    pixels, depth = first.project(positions)
    rows = np.clip(pixels[:, 1].astype(np.int64), 0, first.height - 1)
    columns = np.clip(pixels[:, 0].astype(np.int64), 0, first.width - 1)
    is_seen = (depth > 0) & (pixels >= 0).all(axis=1) & (pixels[:, 0] < first.width) & (pixels[:, 1] < first.height)
    depth_after = second.project(positions)[1]
    target = second.unproject(pixels + flow[rows, columns], depth_after)
    confidence = np.where(is_seen, np.minimum(1.0, 4.0 * opacity[rows, columns]), 0.0)
    displacement = np.where(is_seen[:, None], target - positions, 0.0)
    return displacement, confidence
