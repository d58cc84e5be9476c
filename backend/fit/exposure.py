"""Steps of the exposure: smoke that becomes brighter or darker from one frame to the next while its outline stays."""

from __future__ import annotations

from collections.abc import Iterable, Iterator

import numpy as np

from backend.reporting import Report

STEP = 2.0  # times as bright or as dark: one stop; a puff that starts reaches 1.6, other smoke 1.06
_OUTLINE = 0.1  # of a frame's 99th percentile: what is brighter is inside the outline, whatever the exposure
_ALIKE = 0.7  # intersection over union from which two outlines count as one


def watched(
    frames: Iterable[np.ndarray],  # each [h, w, 4] float32 premultiplied linear RGB and opacity
    report: Report,
) -> Iterator[np.ndarray]:
    """The frames as they are; one warning where the exposure steps, since the smoke's density then steps as well."""
    before: tuple[np.ndarray, np.ndarray] | None = None
    is_told = False
    for index, frame in enumerate(frames):
        light = frame[..., :3].sum(axis=2)
        now = (light, light > _OUTLINE * float(np.percentile(light[light > 0], 99.0)) if light.any() else light > 0)
        if before is not None and not is_told:
            step = _step(before, now)
            if max(step, 1.0 / step) > STEP:
                is_told = True
                report.warning(
                    "exposure_steps",
                    f"From frame {index - 1} to {index} the smoke becomes {step:.2g} times as bright while its outline stays: "
                    "the exposure steps. The smoke's density is taken to step with it; even out the exposure before.",
                )
        before = now
        yield frame


def _step(before: tuple[np.ndarray, np.ndarray], now: tuple[np.ndarray, np.ndarray]) -> float:
    """How many times as bright; 1 where the outlines differ."""
    both, either = before[1] & now[1], before[1] | now[1]
    if both.sum() <= _ALIKE * either.sum():
        return 1.0
    return float(now[0][both].sum(dtype=np.float64) / before[0][both].sum(dtype=np.float64))
