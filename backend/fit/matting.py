"""Opacity of smoke in front of a known background.

Image formation (linear light): I = J (1 - a) + S a with background J, smoke colour S, opacity a. S varies from its lit
to its shaded side, so it is taken as s c with a fixed colour direction c and a brightness s that is free within a spread.
"""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np

from backend.fit.connected import components
from backend.io.images import LUMINANCE

_OPACITY_SPREAD = 1.0  # prior deviation of opacity around 0: holds it down where J and S look alike
_MOVING_NOISE = 5.0 / 255  # sRGB code: video codecs spend few bits on what moves, above all on its colour
_ROUNDS = 3  # the spread of the brightness term depends on the opacity itself
_MIN_COLOR_PIXELS = 64
_FAINTEST = 12.0 / 255  # sRGB code: smoke that nowhere stands out by more is lost in coding and changing light
_TINT_SLACK = 1.1
_DARKEST = 0.4  # of the brightness: no side of the smoke is darker
_MIN_SPREAD = 0.25  # of the brightness: the densest pixels are the lit ones, the shaded side is darker


@dataclass(frozen=True, slots=True, kw_only=True)
class SmokeColor:
    """direction: [3] linear, luminance 1. brightness, spread: of the luminance of opaque smoke.

    tint_range: factor by which a channel of dense smoke departs from the direction, either way.
    """

    direction: np.ndarray
    brightness: float
    spread: float
    tint_range: float = 1.5

    @property
    def linear(self) -> np.ndarray:  # [3]
        return (self.brightness * self.direction).astype(np.float32)

    def limited(self, light: np.ndarray) -> np.ndarray:
        """Light of smoke [h, w, 3] with its tint held to what dense smoke shows; its luminance stays."""
        luminance = (light @ LUMINANCE)[..., None]
        tint = np.clip(light, luminance * self.direction / self.tint_range, luminance * self.direction * self.tint_range)
        return tint * (luminance / np.maximum((tint @ LUMINANCE)[..., None], 1e-9))


@dataclass(frozen=True, slots=True, kw_only=True)
class Opacity:
    """value: [h, w] 0..1, unfiltered. deviation: [h, w] what noise alone makes of no smoke (standard deviation).

    explained: [h, w] 0..1, how much of the difference from the background smoke accounts for.
    """

    value: np.ndarray
    deviation: np.ndarray
    explained: np.ndarray


def coded_noise_to_linear(background: np.ndarray, noise: float) -> np.ndarray:
    """Noise of sRGB code, in linear light at the brightness of the background [h, w, 3]: times the slope of the curve."""
    slope = np.where(background <= 0.0031308, 1.0 / 12.92, 2.4 / 1.055 * np.maximum(background, 0.0031308) ** (1.4 / 2.4))
    return (noise * slope).astype(np.float32)


def solve_opacity(
    image: np.ndarray,  # [h, w, 3] linear
    background: np.ndarray,  # [h, w, 3] linear
    smoke: SmokeColor,
    noise: float,  # sRGB code
) -> Opacity:
    """Least squares over channels for opacity a and smoke light u = s a:

    sum_k ((a J_k - u c_k - (J_k - I_k)) / noise_k)^2 + ((u - brightness a) / (spread a))^2 + (a / opacity spread)^2.
    Where that asks for smoke darker than its shaded side may be, brightness is held there and opacity solved alone.
    For spread -> 0 this is a = (J - I).(J - S) / |J - S|^2, the published transmittance (I - S) / (J - S) solved for opacity.
    """
    weight = 1.0 / coded_noise_to_linear(np.maximum(background, image), max(noise, _MOVING_NOISE)) ** 2
    difference = background - image
    direction = smoke.direction.astype(np.float32)
    weighted = weight * background
    jj, jc, jd = _dot(weighted, background), weighted @ direction, _dot(weighted, difference)
    cc, cd = weight @ (direction * direction), (weight * difference) @ direction
    opacity = np.full(image.shape[:2], 0.5, np.float32)
    s, prior = np.float32(smoke.brightness), np.float32(1.0 / _OPACITY_SPREAD**2)
    light = s * opacity
    a11 = determinant = np.ones_like(opacity)
    for _ in range(_ROUNDS):
        pull = 1.0 / (smoke.spread * np.maximum(opacity, 0.05)) ** 2
        a11, a12, a22 = jj + s * s * pull + prior, -jc - s * pull, cc + pull
        determinant = np.maximum(a11 * a22 - a12 * a12, 1e-12)
        opacity = np.clip((jd * a22 + cd * a12) / determinant, 0.0, 1.0)
        light = np.maximum((s * pull * opacity + jc * opacity - cd) / a22, 0.0)
    darkest = np.float32(_DARKEST * s)
    is_too_dark = light < darkest * opacity
    contrast = jj - 2.0 * darkest * jc + darkest * darkest * cc
    opaque = np.clip((jd - darkest * cd) / np.maximum(contrast, 1e-9), 0.0, 1.0)
    opacity = np.where(is_too_dark & (contrast > prior), opaque, opacity)
    light = np.where(is_too_dark, darkest * opacity, light)
    rest = opacity[..., None] * background - light[..., None] * direction - difference
    residual, total = _dot(weight * rest, rest), _dot(weight * difference, difference)
    explained = np.clip(1.0 - residual / np.maximum(total, 3.0), 0.0, 1.0)
    # The element a a of the inverse of the normal matrix, at the noise of the background: that is where it is needed.
    deviation = np.sqrt(a22 / determinant) * (noise / max(noise, _MOVING_NOISE))
    return Opacity(value=opacity, deviation=deviation.astype(np.float32), explained=explained.astype(np.float32))


def _dot(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """[h, w]: sum over the channels; much faster than .sum(axis=2)."""
    return np.einsum("hwc,hwc->hw", a, b)


def guided_filter(value: np.ndarray, guide: np.ndarray, *, radius: int, epsilon: float) -> np.ndarray:
    """value [h, w] smoothed along the structures of guide [h, w]. He, Sun & Tang 2010, eq. 5, 6 and 8."""
    if radius < 1:
        return value
    size = (2 * radius + 1, 2 * radius + 1)

    def mean(x: np.ndarray) -> np.ndarray:
        return cv2.blur(x.astype(np.float64), size, borderType=cv2.BORDER_REFLECT)

    mean_guide, mean_value = mean(guide), mean(value)
    covariance = mean(guide * value) - mean_guide * mean_value
    variance = mean(guide * guide) - mean_guide**2
    slope = covariance / (np.maximum(variance, 0.0) + epsilon)
    offset = mean_value - slope * mean_guide
    return np.clip(mean(slope) * guide + mean(offset), 0.0, 1.0).astype(np.float32)


def hysteresis(
    opacity: np.ndarray,  # [h, w]
    *,
    low: np.ndarray | float,  # below it nothing is kept; a soft ramp up to twice it
    high: float,  # a connected region must reach it
    min_pixels: int = 9,
    explained: np.ndarray | None = None,  # [h, w] 0..1, of which a region must have `min_explained` in the mean
    min_explained: float = 0.6,
    seeds: np.ndarray | None = None,  # [h, w] bool: where `high` must be reached
) -> np.ndarray:
    """[h, w] 0..1: what to keep of an opacity. Regions that stay below `high`, are specks or unlike smoke, go."""
    num, labels = components(opacity > low)
    reaches = np.zeros(num, np.int64)
    is_high = opacity > high if seeds is None else (opacity > high) & seeds
    np.add.at(reaches, labels[is_high], 1)
    is_kept = (reaches >= max(1, min_pixels // 3)) & (np.bincount(labels.ravel(), minlength=num) >= min_pixels)
    if explained is not None:
        mass = np.bincount(labels.ravel(), weights=opacity.ravel(), minlength=num)
        share = np.bincount(labels.ravel(), weights=(opacity * explained).ravel(), minlength=num)
        is_kept &= share >= min_explained * mass
    is_kept[0] = False
    ramp = np.clip(opacity / np.maximum(low, 1e-6) - 1.0, 0.0, 1.0)
    return np.where(is_kept[labels], ramp, 0.0).astype(np.float32)


def estimate_smoke_color(
    images: list[np.ndarray],  # [h, w, 3] linear
    backgrounds: list[np.ndarray],  # [h, w, 3] linear
    candidates: list[np.ndarray],  # [h, w] bool: where smoke is believed
    noise: float,  # sRGB code
) -> SmokeColor | None:
    """Colour of opaque smoke from the pixels that differ most from the background; None where there are too few.

    The densest smoke is taken for opaque. Thin smoke that is nowhere opaque is therefore taken for thicker and darker
    than it is; its picture over the clean plate stays the same.
    """
    colors, strengths = [], []
    for image, background, candidate in zip(images, backgrounds, candidates, strict=True):
        scaled = (image - background) / coded_noise_to_linear(np.maximum(image, background), max(noise, _FAINTEST / 8.0))
        strength = np.sqrt(_dot(scaled, scaled))
        is_strong = candidate & (strength > 8.0)
        colors.append(image[is_strong])
        strengths.append(strength[is_strong])
    color, strength = np.concatenate(colors), np.concatenate(strengths)
    if len(color) < _MIN_COLOR_PIXELS:
        return None
    dense = color[strength >= np.percentile(strength, 85)]
    direction = np.median(dense, axis=0)
    luminance = dense @ LUMINANCE
    brightness = float(np.median(luminance))
    spread = float(np.percentile(luminance, 84) - np.percentile(luminance, 16)) / 2.0
    if brightness < 1e-4:
        return SmokeColor(direction=np.ones(3, np.float32), brightness=1e-4, spread=1e-2)
    direction = (direction / float(direction @ LUMINANCE)).astype(np.float32)
    tints = np.abs(np.log(np.maximum(dense, 1e-4) / np.maximum(luminance, 1e-4)[:, None] / direction))
    return SmokeColor(
        direction=direction,
        brightness=brightness,
        spread=max(spread, _MIN_SPREAD * brightness),
        tint_range=float(np.exp(np.percentile(tints, 90))) * _TINT_SLACK,
    )
