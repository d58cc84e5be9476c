"""Structural similarity, Wang, Bovik, Sheikh, Simoncelli 2004, eq. 13, as its authors compute it: Gaussian weights of
standard deviation 1.5 px over 11 x 11 px, population (co)variances, pixels nearer to the border than 5 px left out.

The same as scikit-image's `structural_similarity(gaussian_weights=True, sigma=1.5, use_sample_covariance=False,
data_range=1, channel_axis=2)`, which a test compares it with; several times faster, for one truth has many answers.
"""

from __future__ import annotations

import cv2
import numpy as np

RADIUS = 5  # px of the window, and of the border that is left out
_KERNEL = cv2.getGaussianKernel(2 * RADIUS + 1, 1.5)
_C1, _C2 = 0.01**2, 0.03**2  # (K L)^2 for a range L of 1


class Moments:
    """A true picture [H, W, 3] float32, 0..1, with its local mean and variance."""

    def __init__(self, picture: np.ndarray) -> None:
        self.picture = np.asarray(picture, np.float32)
        self.mean = _local(self.picture)
        self.variance = _local(self.picture * self.picture) - self.mean * self.mean


def similarity_map(picture: np.ndarray, truth: Moments) -> np.ndarray:
    """SSIM of a picture [H, W, 3] 0..1 at every pixel, mean of its channels: [H - 10, W - 10]. Raises ValueError where the
    pictures are smaller than the window or of two sizes."""
    picture = np.asarray(picture, np.float32)
    if picture.shape != truth.picture.shape or min(picture.shape[:2]) <= 2 * RADIUS:
        raise ValueError(f"SSIM of {picture.shape} and {truth.picture.shape}")
    mean = _local(picture)
    product = mean * truth.mean
    squares = mean * mean
    variance = _local(picture * picture) - squares
    covariance = _local(picture * truth.picture) - product
    squares += truth.mean * truth.mean
    found = (2.0 * product + _C1) * (2.0 * covariance + _C2) / ((squares + _C1) * (variance + truth.variance + _C2))
    return found.mean(axis=2)[RADIUS:-RADIUS, RADIUS:-RADIUS]


def similarity(picture: np.ndarray, truth: Moments, mask: np.ndarray) -> tuple[float, float]:
    """Mean SSIM over the frame, and over a mask [H, W]; NaN where the mask is empty."""
    found = similarity_map(picture, truth)
    inside = mask[RADIUS:-RADIUS, RADIUS:-RADIUS]
    return float(found.mean(dtype=np.float64)), float(found[inside].mean(dtype=np.float64)) if inside.any() else float("nan")


def _local(values: np.ndarray) -> np.ndarray:
    return cv2.sepFilter2D(values, -1, _KERNEL, _KERNEL, borderType=cv2.BORDER_REFLECT)
