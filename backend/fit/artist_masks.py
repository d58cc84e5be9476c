"""What the artist painted: where smoke never is, where it always stays."""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np

from backend.contract.job import ExtractionConfig
from backend.io.images import read_image


@dataclass(frozen=True, slots=True, kw_only=True)
class ArtistMasks:
    """allowed: [h, w] 0..1, black of the garbage matte is never smoke. kept: [h, w] bool, always kept. None: not given."""

    allowed: np.ndarray | None
    kept: np.ndarray | None

    def limited(self, layer: np.ndarray) -> np.ndarray:
        """A smoke layer [h, w, 4] without what the garbage matte forbids."""
        return layer if self.allowed is None else layer * self.allowed[..., None]


def read_masks(config: ExtractionConfig, size: tuple[int, int]) -> ArtistMasks:
    """The masks of the settings at size (width, height). Raises BackendError at a file that cannot be read."""
    kept = _read_mask(config.smoke_mask, size)
    return ArtistMasks(allowed=_read_mask(config.garbage_matte, size), kept=None if kept is None else kept > 0.5)


def _read_mask(path: str, size: tuple[int, int]) -> np.ndarray | None:
    """[h, w] float32 0..1: the painted values themselves, not light."""
    if not path:
        return None
    image = read_image(path)
    mask = image[..., :3].astype(np.float32).mean(axis=2) / np.iinfo(image.dtype).max
    if image.shape[2] == 4:
        mask *= image[..., 3].astype(np.float32) / np.iinfo(image.dtype).max
    return cv2.resize(mask, size, interpolation=cv2.INTER_AREA)
