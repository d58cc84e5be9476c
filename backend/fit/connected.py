"""Connected regions of a mask."""

from __future__ import annotations

import cv2
import numpy as np


def components(mask: np.ndarray) -> tuple[int, np.ndarray]:
    """Of a mask [h, w] bool: how many labels there are, and the label of each pixel [h, w] int64; 0 outside the mask.

    Pixels that touch at a corner are connected.
    """
    num, labels = cv2.connectedComponents(np.ascontiguousarray(mask, np.uint8), connectivity=8)
    return num, np.asarray(labels, np.int64)
