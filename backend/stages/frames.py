"""Video -> frames at the size that is fitted: linear light, straight alpha."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from backend.contract.errors import BackendError
from backend.contract.job import FramesConfig
from backend.io.video import MIN_FRAMES, Clip
from backend.io.working_frames import has_premultiplied_alpha, reduced, working_size
from backend.reporting import Report

__all__ = ["frame_range", "run", "working_size"]


def frame_range(clip: Clip, start: int | None, stop: int | None) -> tuple[int, int]:
    """The frames A to B-1 that are fitted, None for the clip's own ends. Raises BackendError outside the clip."""
    first, last = start or 0, clip.num_frames if stop is None else stop
    if not 0 <= first < last <= clip.num_frames:
        raise BackendError(
            "frame_range_outside",
            f"Frames {first}:{last} are not inside {clip.name}, which has {clip.num_frames} frames.",
            hint=f"Give --frames A:B with 0 <= A < B <= {clip.num_frames}.",
        )
    if last - first < MIN_FRAMES:
        raise BackendError(
            "frame_range_too_short",
            f"Frames {first}:{last} are {last - first}; at least {MIN_FRAMES} are needed to see the smoke move.",
            hint="Give a longer range.",
        )
    return first, last


def run(clip: Clip, config: FramesConfig, report: Report, *, frame_start: int, frame_stop: int) -> Iterator[np.ndarray]:
    """Frames frame_start to frame_stop-1, each [h, w, 4] float32: linear RGB and straight alpha (1 where there is none)."""
    size = working_size(clip, config)
    is_premultiplied = clip.has_alpha and has_premultiplied_alpha(clip.frames(frame_start, frame_stop))
    if is_premultiplied:
        report.warning("alpha_premultiplied", "The colours are already multiplied by the alpha channel; they are taken so.")
    total = frame_stop - frame_start
    for step, image in enumerate(clip.frames(frame_start, frame_stop), start=1):
        yield reduced(image, size, is_premultiplied=is_premultiplied)
        report.progress(step, total)
