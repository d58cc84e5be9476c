"""Frames -> smoke layer: premultiplied colour and opacity of the smoke alone, and the background behind it."""

from __future__ import annotations

import numpy as np

from backend.contract.job import ExtractionConfig
from backend.fit.extraction import SmokeLayer, extract
from backend.fit.series import Series
from backend.reporting import Report


def run(frames: Series[np.ndarray], config: ExtractionConfig, report: Report, *, has_alpha: bool) -> SmokeLayer:
    """frames: each [h, w, 4] float32, linear RGB and straight alpha, read again and again by number.

    The layer's frames are made while they are taken. Raises BackendError "no_smoke" where the clip shows none.
    """
    return extract(frames, config, report, has_alpha=has_alpha)
