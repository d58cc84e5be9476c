"""Smoke in front of a background that was never filmed without it: plate, smoke colour, and the layer of each frame."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import cv2
import numpy as np

from backend.contract.job import ExtractionConfig
from backend.fit import matting
from backend.fit.artist_masks import ArtistMasks
from backend.fit.background import Background, find_background
from backend.fit.connected import components
from backend.fit.matting import SmokeColor
from backend.fit.series import Series
from backend.io.images import LUMINANCE, linear_to_srgb

_LOW_NOISES = 3.0  # opacity below this many deviations of noise is none
_MIN_LOW = 0.03  # opacity: errors of the plate that no noise figure knows
_HIGH = 0.15  # opacity that a region must reach somewhere
_MIN_REGION = 6e-4  # of the picture; smaller regions are specks
_MIN_EXPLAINED = 0.55  # of the change over time in a neighbourhood: trees and cars brighten and darken at random
_MIN_DWELL = 0.12  # mean opacity over time that a region must reach somewhere: a car passes, a plume stays
_REACH = 0.03  # of the longest side: smoke may be this far from where the samples showed it
_GUIDE_EPSILON = 2e-4  # variance of the sRGB-coded guide: edges fainter than 0.014 are smoothed over


@dataclass(frozen=True, slots=True, kw_only=True)
class Matte:
    """Ready to take any frame. smoke: None where no smoke was found. region: [h, w] bool of the first frame, where smoke
    may be, None for no limit."""

    background: Background
    smoke: SmokeColor | None
    region: np.ndarray | None
    masks: ArtistMasks
    radius: int
    measured: dict[str, float]

    @property
    def reason(self) -> str:
        return self.background.reason

    @property
    def warnings(self) -> list[tuple[str, str]]:
        return self.background.warnings

    def plate(self, index: int) -> np.ndarray:
        """[h, w, 3] linear: the background of a frame."""
        return self.background.at(index)[0]

    def clear_picture(self, frame: np.ndarray) -> np.ndarray:
        """[h, w, 3] linear: the first frame without its smoke. A sky that was fitted says nothing of the ground below it,
        so there the frame itself is taken."""
        if self.background.plate is not None:
            return self.plate(0)
        opacity = self.layer(frame, 0)[..., 3]
        size = 4 * max(1, self.radius) + 1
        share = cv2.dilate(np.minimum(20.0 * opacity, 1.0).astype(np.float32), np.ones((size, size), np.uint8))
        share = cv2.blur(share, (size, size))[..., None]
        return (1.0 - share) * frame[..., :3] + share * self.plate(0)

    def layer(self, frame: np.ndarray, index: int) -> np.ndarray:
        """[h, w, 4] premultiplied linear RGB and opacity of a frame [h, w, >= 3]. Over the plate it gives the frame."""
        image = frame[..., :3]
        color, is_known = self.background.at(index)
        assert self.smoke is not None
        allowed = is_known if self.region is None else is_known & self.background.placed(self.region, index)
        opacity = self._opacity(image, color, allowed, self.background.seeds(index))
        light = np.maximum(image - (1.0 - opacity[..., None]) * color, 0.0) * (opacity[..., None] > 0.0)
        return np.concatenate([self.smoke.limited(light), opacity[..., None]], axis=2)

    def _opacity(self, image: np.ndarray, color: np.ndarray, allowed: np.ndarray, seeds: np.ndarray | None) -> np.ndarray:
        """[h, w] 0..1 opacity of an image [h, w, 3] before a background [h, w, 3], filtered and freed of specks."""
        assert self.smoke is not None
        found = matting.solve_opacity(image, color, self.smoke, self.background.noise)
        guide = linear_to_srgb(image @ LUMINANCE)
        raw = np.where(allowed, found.value, 0.0)
        value = matting.guided_filter(raw, guide, radius=self.radius, epsilon=_GUIDE_EPSILON)
        value = np.where(allowed, value, 0.0)
        low = np.maximum(_LOW_NOISES * np.minimum(found.deviation, 0.2) / np.sqrt(2.0 * self.radius + 1.0), _MIN_LOW)
        min_pixels = max(9, round(_MIN_REGION * value.size))
        keep = matting.hysteresis(value, low=low, high=_HIGH, min_pixels=min_pixels, explained=found.explained, seeds=seeds)
        if self.masks.kept is not None:
            keep = np.where(self.masks.kept, 1.0, keep)
        return (value * keep).astype(np.float32)


def prepare(
    frames: Series[np.ndarray],
    numbers: Sequence[int],  # of the frames that the plate is made from
    config: ExtractionConfig,
    masks: ArtistMasks,
    *,
    on_step: Callable[[int, int], None],
) -> Matte:
    """Background, smoke colour and region from sampled frames."""
    background = find_background(frames, numbers, config, on_step=on_step)
    height, width = frames[0].shape[:2]
    radius = round(config.guided_radius * max(height, width))
    chosen = list(numbers)[:: max(1, len(numbers) // 16)]
    images = [frames[k][..., :3] for k in chosen]
    places = [background.at(k) for k in chosen]
    candidates = [p[1] & _is_different(i, p[0], background.noise) for i, p in zip(images, places, strict=True)]
    if masks.allowed is not None:
        candidates = [c & (masks.allowed > 0.5) for c in candidates]
    smoke = matting.estimate_smoke_color(images, [p[0] for p in places], candidates, background.noise)
    measured = dict(background.measured)
    matte = Matte(background=background, smoke=smoke, region=None, masks=masks, radius=radius, measured=measured)
    if smoke is None:
        return matte
    measured["smoke_brightness"] = smoke.brightness
    measured["smoke_brightness_spread"] = smoke.spread
    region = _region(images, chosen, matte) if background.is_temporal else None
    return Matte(background=background, smoke=smoke, region=region, masks=masks, radius=radius, measured=measured)


def _is_different(image: np.ndarray, color: np.ndarray, noise: float) -> np.ndarray:
    """[h, w] bool: differs from the background by more than noise, in a neighbourhood."""
    difference = np.abs(linear_to_srgb(image) - linear_to_srgb(color)).max(axis=2).astype(np.float32)
    return cv2.GaussianBlur(difference, (0, 0), 1.5) > 4.0 * noise


def _region(images: list[np.ndarray], numbers: list[int], matte: Matte) -> np.ndarray:
    """[h, w] bool, of the first frame: where things change over time the way smoke changes a picture."""
    assert matte.smoke is not None
    shape = images[0].shape[:2]
    reach = max(2, round(_REACH * max(shape)))
    most, total, weight, explained = (np.zeros(shape, np.float32) for _ in range(4))
    for image, index in zip(images, numbers, strict=True):
        color, is_known = matte.background.at(index)
        found = matting.solve_opacity(image, color, matte.smoke, matte.background.noise)
        change = linear_to_srgb(image) - linear_to_srgb(color)
        difference = np.einsum("hwc,hwc->hw", change, change).astype(np.float32)
        signal = np.maximum(difference - 9.0 * matte.background.noise**2, 0.0) * is_known
        back = [matte.background.unplaced(x.astype(np.float32), index) for x in (found.value * is_known, signal)]
        best = matte.background.unplaced((signal * found.explained).astype(np.float32), index)
        most = np.maximum(most, cv2.GaussianBlur(back[0], (0, 0), 1.0))
        total += back[0]
        weight += back[1]
        explained += best
    box = (2 * reach + 1, 2 * reach + 1)
    share = cv2.blur(explained, box) / np.maximum(cv2.blur(weight, box), 1e-9)
    is_smoke = (most > 2.0 * _MIN_LOW) & (share > _MIN_EXPLAINED)
    num, labels = components(is_smoke)
    dwells = np.zeros(num, bool)
    dwells[np.unique(labels[total / len(images) > _MIN_DWELL])] = True
    dwells[0] = False
    kernel = cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (2 * reach + 1, 2 * reach + 1))
    return cv2.dilate(dwells[labels].astype(np.uint8), kernel) > 0
