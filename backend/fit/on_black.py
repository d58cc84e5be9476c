"""Smoke that already stands on black: recognising it, and its opacity.

On black the picture itself is the premultiplied colour. Opacity is not recorded there; it is taken from brightness,
a = luminance / luminance of the smoke where it is densest, which is exact for one smoke colour under even light.
"""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np

from backend.fit.connected import components
from backend.fit.series import Series
from backend.io.images import LUMINANCE, linear_to_srgb, srgb_to_linear

MAX_BLACK_LEVEL = 20 / 255  # sRGB code; video black of limited range is 16
MIN_BLACK_SHARE = 0.3  # of all pixels
MIN_BLACK_BORDER = 0.4  # of the pixels along the border: smoke may leave the picture, a background reaches round it
MAX_BLACK_NOISE = 2.5 / 255  # sRGB code; a dark scene is noisier than a cut-out
_NEAR_BLACK = 5 / 255  # sRGB code above the black level that still counts as black
_PEAK_PERCENTILE = 99.5  # of the luminance of smoke pixels: opaque; above it are glints and ringing
_SEED = 4.0  # smoke must somewhere exceed the noise floor by this factor


@dataclass(frozen=True, slots=True, kw_only=True)
class BlackBackground:
    """What is under the smoke. level, noise, floor: sRGB code 0..1; shares: of pixels; peak: luminance taken as opaque."""

    level: float
    noise: float
    share: float
    border_share: float
    floor: float
    peak: float
    smoke_share: float

    @property
    def is_black(self) -> bool:
        return (
            self.level <= MAX_BLACK_LEVEL
            and self.noise <= MAX_BLACK_NOISE
            and self.share >= MIN_BLACK_SHARE
            and self.border_share >= MIN_BLACK_BORDER
        )


def measure_black(samples: Series[np.ndarray]) -> BlackBackground:
    """Black level, its noise, how much of the picture it covers. samples: frames [h, w, >= 3] linear."""
    coded = [linear_to_srgb(frame[..., :3].max(axis=2)) for frame in samples]
    values = np.concatenate([image.ravel() for image in coded])
    level = float(np.percentile(values, 10))
    near = values[values <= level + _NEAR_BLACK]
    level = float(np.median(near))
    noise = float(np.std(near))
    border = np.concatenate([edge for image in coded for edge in (image[0], image[-1], image[:, 0], image[:, -1])])
    floor = level + 3 / 255 + 4.0 * noise
    unit = _floor_luminance(level, floor)
    luminance = np.concatenate([(frame[..., :3] @ LUMINANCE).ravel() for frame in samples]) - srgb_to_linear(np.array(level))
    smoke = luminance[luminance > _SEED * unit]
    return BlackBackground(
        level=level,
        noise=noise,
        share=float(np.mean(values <= level + _NEAR_BLACK)),
        border_share=float(np.mean(border <= level + _NEAR_BLACK)),
        floor=floor,
        peak=float(np.percentile(smoke, _PEAK_PERCENTILE)) if smoke.size else 0.0,
        smoke_share=smoke.size / max(values.size, 1),
    )


def layer_on_black(
    frame: np.ndarray,  # [h, w, >= 3] linear
    black: BlackBackground,
) -> np.ndarray:
    """The smoke layer [h, w, 4]: the picture less its black level, and opacity from brightness; exactly 0 on the black."""
    color = np.maximum(frame[..., :3] - np.float32(srgb_to_linear(np.array(black.level))), 0.0)
    luminance = color @ LUMINANCE
    keep = _above_floor(luminance, _floor_luminance(black.level, black.floor))
    opacity = np.clip(luminance / max(black.peak, 1e-6), 0.0, 1.0)
    return np.concatenate([color, opacity[..., None]], axis=2) * keep[..., None]


def _floor_luminance(level: float, floor: float) -> float:
    """Linear light between the black level and the noise floor above it."""
    return float(srgb_to_linear(np.array(floor)) - srgb_to_linear(np.array(level)))


def _above_floor(luminance: np.ndarray, floor: float) -> np.ndarray:
    """[h, w] 0..1: 0 below the noise floor and on specks that nowhere rise well above it, 1 from twice the floor on."""
    smooth = cv2.GaussianBlur(luminance, (0, 0), 1.0)
    num, labels = components(smooth > floor)
    has_seed = np.zeros(num, bool)
    has_seed[np.unique(labels[smooth > _SEED * floor])] = True
    has_seed[0] = False
    ramp = np.clip((smooth - floor) / floor, 0.0, 1.0)
    return np.where(has_seed[labels], ramp, 0.0).astype(np.float32)
