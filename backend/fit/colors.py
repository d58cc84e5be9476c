"""Of what colour the smoke of a clip is, and how much of its colours one hue can tell."""

from __future__ import annotations

from collections.abc import Iterable

import numpy as np

from backend.io.images import LUMINANCE, linear_to_srgb


def hue_of(
    layers: Iterable[np.ndarray],  # each [H, W, 4] premultiplied linear RGB and opacity
) -> np.ndarray:  # [3] linear, of luminance one
    """The colour that, times each pixel's luminance, is nearest to the pixels, in the least-squares sense."""
    moment, total = np.zeros(3), 0.0
    for layer in layers:
        luminance = layer[..., :3] @ LUMINANCE
        moment += np.einsum("hwc,hw->c", layer[..., :3], luminance, dtype=np.float64)
        total += float(np.square(luminance, dtype=np.float64).sum())
    return moment / total if total > 0.0 else np.ones(3)


def error_of_one_hue(
    layers: Iterable[np.ndarray],  # each [H, W, 4] premultiplied linear RGB and opacity
    hue: np.ndarray,  # [3] linear
) -> float:
    """Mean squared error, sRGB-coded on black over the full frame, of the layers with every pixel's colour brought to one hue."""
    squares, count = 0.0, 0
    along = np.asarray(hue, np.float64) / max(float(np.linalg.norm(hue)), 1e-12)
    for layer in layers:
        color = layer[..., :3]
        one = (color @ along)[..., None] * along
        off = linear_to_srgb(np.clip(one, 0.0, 1.0)) - linear_to_srgb(np.clip(color, 0.0, 1.0))
        squares += float(np.square(off, dtype=np.float64).sum())
        count += off.size
    return squares / max(count, 1)
