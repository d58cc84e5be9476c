"""How far a picture, a volume or a velocity is from the truth."""

from __future__ import annotations

from functools import cached_property

import cv2
import numpy as np

from backend.io.images import linear_to_srgb
from backend.score.similarity import Moments

LARGEST_DB = 50.0  # an image of the scoring camera itself would otherwise decide a mean
SMOKE_OPACITY = 0.02
_DILATION = 4  # px around the smoke that count as smoke


class Target:
    """A true picture [H, W, 4], linear premultiplied light and opacity, with what every answer is compared with."""

    def __init__(self, picture: np.ndarray) -> None:
        self.picture = picture

    @cached_property
    def coded(self) -> np.ndarray:
        """[H, W, 3] sRGB-coded on black."""
        return coded(self.picture)

    @cached_property
    def smoke(self) -> np.ndarray:
        """[H, W], see smoke_mask."""
        return smoke_mask(self.picture)

    @cached_property
    def moments(self) -> Moments:
        return Moments(self.coded)


def coded(picture: np.ndarray) -> np.ndarray:
    """[..., 4] linear premultiplied light -> [..., 3] sRGB-coded on black, 0..1."""
    return linear_to_srgb(np.clip(picture[..., :3], 0.0, 1.0))


def decibels(squared_error: float) -> float:
    """PSNR of a mean squared error, peak 1, at most LARGEST_DB; NaN of NaN."""
    if np.isnan(squared_error):
        return float("nan")
    return float(min(LARGEST_DB, -10.0 * np.log10(max(squared_error, 1e-12))))


def squared_errors(picture: np.ndarray, truth: np.ndarray) -> tuple[float, float]:
    """Mean squares of the coded difference of [H, W, 4] pictures: over the frame, and over the smoke of the truth, dilated;
    the second is NaN where the truth shows no smoke."""
    return coded_errors(coded(picture), Target(truth))


def coded_errors(shown: np.ndarray, target: Target) -> tuple[float, float]:
    """As squared_errors, of a picture [H, W, 3] that is coded."""
    squares = np.square(shown - target.coded, dtype=np.float64)
    mask = target.smoke
    return float(squares.mean()), float(squares[mask].mean()) if mask.any() else float("nan")


def smoke_mask(truth: np.ndarray) -> np.ndarray:
    """[H, W, 4] -> [H, W]: where there is smoke, and four pixels around."""
    size = 2 * _DILATION + 1
    kernel = cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (size, size))
    return cv2.dilate((truth[..., 3] > SMOKE_OPACITY).astype(np.uint8), kernel) > 0


def correlation(a: np.ndarray, b: np.ndarray) -> float:
    """Pearson's, of all values; NaN where one of them does not vary."""
    x, y = (np.asarray(values, np.float64).ravel() for values in (a, b))
    x, y = x - x.mean(), y - y.mean()
    size = np.sqrt((x @ x) * (y @ y))
    return float(x @ y / size) if size > 0 else float("nan")


def relative_l2(density: np.ndarray, truth: np.ndarray) -> float:
    """|density - truth| / |truth|."""
    return float(np.linalg.norm((density - truth).ravel()) / max(np.linalg.norm(truth.ravel()), 1e-12))


def inside_smoke(density: np.ndarray) -> np.ndarray:
    """[X, Y, Z]: where there is smoke whose motion is scored, above a hundredth of the peak."""
    return density > 0.01 * density.max()


def velocity_scores(velocity: np.ndarray, truth: np.ndarray, density: np.ndarray, axes: np.ndarray) -> dict[str, float]:
    """Of [X, Y, Z, 3] m/s inside true smoke (inside_smoke of its density): correlation along the rows of `axes`
    [3, 3] (sideways, up, in depth of a camera), and the root mean squared end-point error, m/s."""
    inside = inside_smoke(density)
    ours, real = velocity[inside] @ axes.T, truth[inside] @ axes.T
    names = ("sideways", "up", "depth")
    found = {f"correlation_{name}": correlation(ours[:, axis], real[:, axis]) for axis, name in enumerate(names)}
    found["end_point_error"] = float(np.sqrt(np.mean(np.sum((ours - real) ** 2, axis=1))))
    found["still_error"] = float(np.sqrt(np.mean(np.sum(real**2, axis=1))))
    return found
