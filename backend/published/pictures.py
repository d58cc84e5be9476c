"""Losses of the published methods on pictures; on colours they compare sRGB-coded values. Each with its gradient."""

from __future__ import annotations

import numpy as np

from backend.fit import losses
from backend.io.images import linear_to_srgb, linear_to_srgb_slope

FREQUENCY_WEIGHT = 0.001  # supplement 7.6.2
_WINDOW_REACH = 5  # px, of SSIM's window


def coded_target(layer: np.ndarray) -> np.ndarray:
    """Smoke on black [3, H, W], sRGB-coded, of a layer [H, W, 4] of premultiplied linear light and opacity."""
    return linear_to_srgb(np.moveaxis(np.maximum(layer[..., :3], 0.0), -1, 0).astype(np.float64))


def picture_loss(picture: np.ndarray, target: np.ndarray, *, frequency: float = 0.0) -> tuple[float, np.ndarray]:
    """0.8 L1 + 0.2 (1 - SSIM) + frequency * (amplitude and phase of the spectrum, as published), and its gradient.

    Both [K, H, W], black where there is no smoke.
    """
    loss, gradient = _reconstruction(picture, target)
    if frequency > 0.0:
        extra, slope = losses.frequency_as_published(picture, target)
        loss, gradient = loss + frequency * extra, gradient + frequency * slope
    return loss, gradient


def linear_picture_loss(
    linear: np.ndarray,  # [3, H, W] as rendered
    target: np.ndarray,  # [3, H, W] sRGB-coded
    *,
    frequency: float = 0.0,
) -> tuple[float, np.ndarray]:
    """picture_loss of the coded picture, and its gradient by the linear one."""
    shown = np.maximum(np.asarray(linear, np.float64), 0.0)
    loss, gradient = picture_loss(linear_to_srgb(shown), target, frequency=frequency)
    return loss, np.where(linear >= 0.0, gradient * linear_to_srgb_slope(shown), 0.0)


def _reconstruction(picture: np.ndarray, target: np.ndarray) -> tuple[float, np.ndarray]:
    """losses.reconstruction over the whole picture, computed only where either picture is not black.

    Where both are, the loss is 0, and what SSIM's window takes from outside is 0 as well. The gradient there is left at 0:
    no particle reaches there.
    """
    rows, columns = (_span((picture > 0.0) | (target > 0.0), axis) for axis in (1, 2))
    gradient = np.zeros_like(picture, np.float64)
    if rows.start == rows.stop:
        return 0.0, gradient
    part = (slice(None), rows, columns)
    loss, slope = losses.reconstruction(picture[part], target[part])
    share = slope.size / picture.size
    gradient[part] = share * slope
    return share * loss, gradient


def _span(is_used: np.ndarray, axis: int) -> slice:
    """The rows (axis 1) or columns (axis 2) that are used, and as many more as SSIM looks around."""
    used = np.flatnonzero(is_used.any(axis=(0, 3 - axis)))
    if len(used) == 0:
        return slice(0, 0)
    return slice(max(0, int(used[0]) - _WINDOW_REACH), min(is_used.shape[axis], int(used[-1]) + 1 + _WINDOW_REACH))
