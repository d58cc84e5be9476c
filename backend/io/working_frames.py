"""From coded images of any size to the frames that are worked on: linear light, straight alpha, the working size."""

from __future__ import annotations

from collections.abc import Iterator

import cv2
import numpy as np

from backend.contract.job import FramesConfig
from backend.io.images import LUMINANCE, decode_srgb
from backend.io.video import Clip

_MIN_WORKING_SIDE = 8  # px, of very wide clips
_PREMULTIPLIED_SAMPLES = 12  # frames with half-transparent pixels that are looked at


def working_size(clip: Clip, config: FramesConfig) -> tuple[int, int]:
    """(width, height) px that is fitted: the longest side at most config.working_size, never larger than the clip."""
    scale = min(1.0, config.working_size / max(clip.width, clip.height))
    if scale == 1.0:
        return clip.width, clip.height
    return max(_MIN_WORKING_SIDE, round(clip.width * scale)), max(_MIN_WORKING_SIDE, round(clip.height * scale))


def reduced(image: np.ndarray, size: tuple[int, int], *, is_premultiplied: bool = False) -> np.ndarray:
    """[H, W, 3 or 4] uint8 or uint16 sRGB -> [h, w, 4] float32 linear, straight alpha, at size (width, height).

    Every output pixel is the mean of the light that falls on it (area filter), colours weighted by their alpha.
    """
    linear = decode_srgb(image)
    has_alpha = linear.shape[2] == 4
    if has_alpha and not is_premultiplied:
        linear[..., :3] *= linear[..., 3:]
    if (linear.shape[1], linear.shape[0]) != size:
        linear = cv2.resize(linear, size, interpolation=cv2.INTER_AREA)
    if not has_alpha:
        return np.concatenate([linear, np.ones((*linear.shape[:2], 1), np.float32)], axis=2)
    alpha = linear[..., 3:]
    linear[..., :3] /= np.maximum(alpha, 1e-6)
    return np.clip(linear, 0.0, 1.0)


def has_premultiplied_alpha(images: Iterator[np.ndarray]) -> bool:
    """Whether the colours of an RGBA clip already carry their alpha (smoke on black with its opacity beside it).

    Of straight colours the brightness does not depend on alpha; of premultiplied ones it grows in proportion.
    The mean brightness of thin (alpha about 0.15) and of thicker pixels (about 0.6) is compared on the log scale.
    """
    thin, thick, num_seen = [], [], 0
    for image in images:
        coded_alpha = image[..., 3] * (1.0 / np.iinfo(image.dtype).max)
        is_partial = (coded_alpha > 0.08) & (coded_alpha < 0.85)
        if is_partial.sum() < 32:
            continue
        linear = decode_srgb(image[is_partial][None])[0]
        luminance, alpha = linear[:, :3] @ LUMINANCE, linear[:, 3]
        thin += [luminance[alpha < 0.25]]
        thick += [luminance[alpha > 0.45]]
        num_seen += 1
        if num_seen == _PREMULTIPLIED_SAMPLES:
            break
    low, high = (np.concatenate(part) if part else np.zeros(0) for part in (thin, thick))
    if low.size < 16 or high.size < 16 or np.median(high) < 1e-3:
        return False
    return bool(np.median(low) < 0.5 * np.median(high))  # straight: 1; premultiplied: about 0.25
