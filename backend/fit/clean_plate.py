"""The background without smoke: what stays the same over time, and a smooth fill where smoke never clears."""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np

from backend.fit.connected import components
from backend.fit.series import Series
from backend.io.images import LUMINANCE, linear_to_srgb, srgb_to_linear

_MODE_SHARE = 0.25  # of the frames that must agree: smoke may cover a pixel three quarters of the time
_FEW_SHARE = 0.1  # of the frames: as many must agree where the others are known to be smoke
_LIKE_SMOKE = 0.08  # sRGB code, every channel: the shading of opaque smoke
_MIN_NOISE = 0.5 / 255  # sRGB code; half a step of 8 bits
_MAX_SPREAD = 4.0  # noise levels; frames that agree less than this show no background
_MIN_STEP = 1.0 / 255  # sRGB code; codecs move a still pixel by as much when smoke passes beside it
_STANDS_OUT = 0.7  # of the values around a background lie close to it; shades of lasting smoke follow each other evenly
_BREADTH = 0.01  # of the longest side
_RUN_SHARE = 0.15  # of the frames: a stretch of time in which the background shows itself
_MIN_RUN = 8  # frames
_RUN_POOL = 5  # px over which its changes are averaged
_RUN_NOISE = 0.7  # noise levels: standard deviation below which a place stands still
_TEXTURE = 3.0  # noise levels of detail that opaque smoke does not have
_TEXTURE_POOL = 9  # px
_BURNT_OUT = 0.97  # sRGB code
_CALM = 0.1  # share of the frames that differ from the plate
_NOISE_VALUES = 2_000_000  # looked at for the noise
_BAND_VALUES = 8_000_000  # temporal statistics are taken over bands of rows of this size


@dataclass(frozen=True, slots=True, kw_only=True)
class CleanPlate:
    """color: [h, w, 3] linear. is_seen: [h, w] bool, where the background showed itself; elsewhere it is filled in.

    noise: of one frame, sRGB code. activity: [h, w] share of the frames that differ from the plate.
    """

    color: np.ndarray
    is_seen: np.ndarray
    noise: float
    activity: np.ndarray


def temporal_plate(samples: Series[np.ndarray], *, smoke: np.ndarray | None = None) -> CleanPlate:
    """The plate of frames [h, w, 3] linear that lie on each other (NaN where a frame does not reach).

    Per pixel the shortest interval that holds a quarter of the frames (the half-sample mode of Bickel & Fruehwirth
    2006, with a quarter) is centred on the value that repeats best: the background repeats to within noise, smoke in
    front of it does not, whether it brightens or darkens. The plate is the mean of the frames that agree with it.
    smoke: [3] linear colour of opaque smoke, once known; opaque smoke repeats too, so values like it count last.
    """
    coded = [linear_to_srgb(frame[..., :3]).astype(np.float32) for frame in samples]
    noise = frame_noise(coded)
    smoke_coded = None if smoke is None else linear_to_srgb(smoke).astype(np.float32)
    height, width = coded[0].shape[:2]
    rows = max(1, _BAND_VALUES // (len(coded) * width * 3))
    bands = (np.stack([c[top : top + rows] for c in coded]) for top in range(0, height, rows))
    parts = [_band(band, noise, smoke_coded) for band in bands]
    color, is_seen, activity = (np.concatenate([part[k] for part in parts]) for k in range(3))
    is_seen = _connected_with_calm(is_seen, activity)
    color = fill_smoothly(color, is_seen)
    return CleanPlate(color=srgb_to_linear(color).astype(np.float32), is_seen=is_seen, noise=noise, activity=activity)


def _connected_with_calm(is_seen: np.ndarray, activity: np.ndarray) -> np.ndarray:
    """[h, w] bool: the seen pixels without islands and threads amid smoke that by chance repeats.

    A region of background has breadth, and somewhere a part that smoke seldom covers.
    """
    size = 2 * max(1, round(_BREADTH * max(is_seen.shape))) + 1
    kernel = cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (size, size))
    is_calm = is_seen & (activity < _CALM)
    is_broad = cv2.morphologyEx(is_seen.astype(np.uint8), cv2.MORPH_OPEN, kernel) > 0
    num, labels = components(is_broad)
    calm = np.bincount(labels[is_calm], minlength=num) > 0.1 * np.bincount(labels.ravel(), minlength=num)
    calm[0] = False
    return is_seen & calm[labels]


def frame_noise(coded: Series[np.ndarray]) -> float:
    """Noise of frames [h, w, 3], sRGB code: how much a pixel without smoke departs from its median over time.

    Median absolute deviation (times 1.4826 for a normal distribution), of the calmest quarter of the pixels, because
    smoke may cover the others.
    """
    stride = max(1, round((coded[0].size * len(coded) / _NOISE_VALUES) ** 0.5))
    values = np.stack([frame[::stride, ::stride] for frame in coded])
    values = values[:, np.isfinite(values).all(axis=(0, -1))]
    if values.size == 0:
        return _MIN_NOISE
    deviation = 1.4826 * np.median(np.abs(values - np.median(values, axis=0)), axis=0)
    return max(float(np.percentile(deviation, 25)), _MIN_NOISE)


def _band(coded: np.ndarray, noise: float, smoke: np.ndarray | None) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Frames [n, r, w, 3] coded -> plate [r, w, 3] coded, seen [r, w], activity [r, w]."""
    luma = coded @ LUMINANCE
    num = np.isfinite(luma).sum(axis=0)
    length = min(max(3, round(_MODE_SHARE * len(coded))), max(2, len(coded) - 1))
    centre, spread = shortest_interval(luma, length)
    is_smoke = np.zeros(centre.shape, bool)
    if smoke is not None:
        is_like_smoke = np.abs(coded - smoke).max(axis=-1) < _LIKE_SMOKE
        few = max(3, round(_FEW_SHARE * len(coded)))
        other_centre, other_spread = shortest_interval(np.where(is_like_smoke, np.nan, luma), few)
        is_better = other_spread < 0.5 * _MAX_SPREAD * noise
        is_smoke = ~is_better & (is_like_smoke.mean(axis=0) > _FEW_SHARE) & (is_like_smoke.mean(axis=0) < 1.0 - _FEW_SHARE)
        centre, spread = np.where(is_better, other_centre, centre), np.where(is_better, other_spread, spread)
    steady, is_steady = steadiest_run(coded, noise)
    steady_centre = steady @ LUMINANCE
    is_plain = texture(steady_centre) < _TEXTURE * max(noise, _MIN_STEP)
    is_steady &= ~(is_plain & (True if smoke is None else np.abs(steady - smoke).max(axis=-1) < _LIKE_SMOKE))
    centre, spread = np.where(is_steady, steady_centre, centre), np.where(is_steady, 0.0, spread)
    is_smoke &= ~is_steady
    agrees = np.abs(luma - centre) < 0.5 * np.minimum(spread, 1.0) + 2.0 * noise
    weight = agrees[..., None].astype(np.float32)
    color = np.where(weight > 0, coded, 0.0).sum(axis=0) / np.maximum(weight.sum(axis=0), 1.0)
    distance = np.abs(luma - centre)
    unit = max(noise, _MIN_STEP)
    num_near = (distance < 3.0 * unit).sum(axis=0)
    stands_out = num_near > _STANDS_OUT * (distance < 9.0 * unit).sum(axis=0)
    is_seen = is_steady | ((num >= length) & (spread < _MAX_SPREAD * noise) & stands_out & ~is_smoke)
    differs = np.abs(coded - color).max(axis=-1) > 5.0 * noise
    activity = differs.sum(axis=0) / np.maximum(num, 1)
    return color.astype(np.float32), is_seen, activity.astype(np.float32)


def steadiest_run(coded: np.ndarray, noise: float) -> tuple[np.ndarray, np.ndarray]:
    """Colour [r, w, 3] of the stretch of time in which each place changes least, and [r, w] whether it stood still then.

    coded: [n, r, w, 3], NaN where a frame does not reach. Smoke never stands still to within noise, and neither does
    its shadow; a background does, even one that looks like smoke. What is burnt out stands still too and says nothing.
    """
    length = max(_MIN_RUN, round(_RUN_SHARE * len(coded)))
    if len(coded) < 2 * length:
        return np.zeros(coded.shape[1:], np.float32), np.zeros(coded.shape[1:3], bool)
    sums = np.cumsum(np.concatenate([np.zeros_like(coded[:1]), coded]), axis=0, dtype=np.float64)
    squares = np.cumsum(np.concatenate([np.zeros_like(coded[:1]), coded**2]), axis=0, dtype=np.float64)
    best = np.full(coded.shape[1:3], np.inf, np.float32)
    color = np.zeros(coded.shape[1:], np.float32)
    for start in range(len(coded) - length + 1):
        mean = (sums[start + length] - sums[start]) / length
        variance = ((squares[start + length] - squares[start]) / length - mean**2).mean(axis=-1)
        pooled = cv2.blur(np.nan_to_num(variance, nan=1.0).astype(np.float32), (_RUN_POOL, _RUN_POOL))
        is_better = pooled < best
        best = np.where(is_better, pooled, best)
        color = np.where(is_better[..., None], np.nan_to_num(mean), color)
    is_steady = (best < (_RUN_NOISE * max(noise, _MIN_STEP)) ** 2) & (color.max(axis=-1) < _BURNT_OUT)
    return color.astype(np.float32), is_steady


def texture(luma: np.ndarray) -> np.ndarray:
    """Standard deviation [h, w] of an image about its blur, over some pixels: detail, which opaque smoke has none of."""
    detail = luma - cv2.GaussianBlur(luma, (0, 0), 2.0)
    return np.sqrt(cv2.blur(detail * detail, (_TEXTURE_POOL, _TEXTURE_POOL)))


def shortest_interval(values: np.ndarray, length: int) -> tuple[np.ndarray, np.ndarray]:
    """Centre and width [...] of the shortest interval that holds `length` of values [n, ...]; NaN are none of them.

    Infinite width and centre 0 where there are fewer values.
    """
    ordered = np.sort(values, axis=0)  # NaN comes last
    widths = ordered[length - 1 :] - ordered[: len(values) - length + 1]
    widths = np.where(np.isfinite(widths), widths, np.inf)
    best = widths.argmin(axis=0)[None]
    low = np.take_along_axis(ordered, best, axis=0)[0]
    high = np.take_along_axis(ordered, best + length - 1, axis=0)[0]
    return np.nan_to_num(0.5 * (low + high)), np.take_along_axis(widths, best, axis=0)[0]


def fill_smoothly(image: np.ndarray, is_known: np.ndarray) -> np.ndarray:
    """image [h, w, C] with the unknown pixels filled by averages of the known ones around them, near ones first.

    Pull-push (Gortler et al. 1996, section 3.4): halve with weights until a pixel is covered, then take from there.
    """
    if is_known.all() or not is_known.any():
        return image
    weight = is_known.astype(np.float32)[..., None]
    return np.where(is_known[..., None], image, _pull_push(image * weight, weight)).astype(image.dtype)


def _pull_push(weighted: np.ndarray, weight: np.ndarray) -> np.ndarray:
    own = weighted / np.maximum(weight, 1e-6)
    if weight.min() >= 1.0 or max(weighted.shape[:2]) == 1:
        return own
    size = (weighted.shape[1], weighted.shape[0])
    half = ((size[0] + 1) // 2, (size[1] + 1) // 2)
    gain = (size[0] * size[1]) / (half[0] * half[1])
    w = cv2.resize(weight, half, interpolation=cv2.INTER_AREA).reshape(half[1], half[0], 1) * gain
    c = cv2.resize(weighted, half, interpolation=cv2.INTER_AREA).reshape(half[1], half[0], -1) * gain
    full = np.maximum(w, 1.0)
    coarse = _pull_push(c / full, w / full)
    coarse = cv2.resize(coarse, size, interpolation=cv2.INTER_LINEAR).reshape(weighted.shape)
    share = np.minimum(weight, 1.0)
    return share * own + (1.0 - share) * coarse
