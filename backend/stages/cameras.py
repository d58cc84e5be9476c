"""Smoke layer -> the camera of every frame: given, or one that stands still.

The still camera looks along +y at the world's origin from `distance_m`, z up; `elevation_deg` lifts it and tilts it
down around the origin. Its focal length follows from `field_of_view_deg` over the longer side of the picture:
f = (longer side / 2) / tan(field of view / 2), the same for x and y, with the principal point in the middle.
"""

from __future__ import annotations

import math
from collections.abc import Callable

import numpy as np

from backend.contract.cameras import Cameras
from backend.contract.errors import BackendError
from backend.contract.job import CamerasConfig
from backend.fit import stabilise
from backend.fit.camera_path import fitting
from backend.fit.scene import is_origin_seen
from backend.fit.series import Series
from backend.fit.stabilise import ImageMotion
from backend.geometry.camera import view_at
from backend.reporting import Report

_MAX_SAMPLES = 120


def run(
    *,
    num_frames: int,
    frame_start: int = 0,
    size: tuple[int, int],  # (width, height) px of the frames that are fitted
    fps: float,
    config: CamerasConfig,
    given: Cameras | None,
    motion: Callable[[], ImageMotion],
    report: Report,
) -> Cameras:
    """Cameras of the fitted frames, intrinsics in px of `size`; frame 0 is the clip's frame `frame_start`.

    Given cameras may go on beyond the fitted frames (a forecast reaches there). Raises BackendError.
    """
    if config.mode == "given" and given is None:
        raise BackendError(
            "cameras_missing", "No cameras.json was given.", hint='Give one with --cameras, or set cameras.mode to "auto".'
        )
    if given is not None and config.mode != "still":
        fitted = fitting(given, num_frames, frame_start, size=size, fps=fps, report=report)
        if fitted.is_still and not is_origin_seen(view_at(fitted, 0)):
            report.warning(
                "camera_misses_origin",
                "The given camera stands still and does not look at the world's origin, where smoke is taken to stand; how far "
                "away it is, and so how large, is a guess. Give the camera with the origin at the smoke.",
            )
        return fitted
    if given is not None:
        report.warning("cameras_ignored", 'A cameras.json was given, but cameras.mode is "still"; it is not used.')
    elif config.mode == "auto":
        moved = motion()
        if not moved.is_still:
            report.warning(
                "camera_moves",
                f"The camera moves (the background shifts by {moved.displacement:.0%} of the picture); for now it is "
                "treated as if it stood still. Give the solved camera with --cameras cameras.json.",
            )
    return still_camera(size, fps, config)


def still_camera(size: tuple[int, int], fps: float, config: CamerasConfig) -> Cameras:
    """The camera of the settings; size: (width, height) px."""
    width, height = size
    focal = 0.5 * max(size) / math.tan(math.radians(config.field_of_view_deg) / 2.0)
    e = math.radians(config.elevation_deg)
    position = (0.0, -config.distance_m * math.cos(e), config.distance_m * math.sin(e))
    right, down, forward = (1.0, 0.0, 0.0), (0.0, -math.sin(e), -math.cos(e)), (0.0, math.cos(e), -math.sin(e))
    rows = [(right[k], down[k], forward[k], position[k]) for k in range(3)]
    return Cameras(
        width=width,
        height=height,
        fx=focal,
        fy=focal,
        cx=width / 2.0,
        cy=height / 2.0,
        fps=fps,
        camera_to_world=((*rows, (0.0, 0.0, 0.0, 1.0)),),
    )


def measure_motion(
    frames: Series[np.ndarray],  # each [h, w, >= 3] linear
    report: Report,
    *,
    smoke: Series[np.ndarray] | None = None,  # each [h, w, 4], its opacity excludes smoke
) -> ImageMotion:
    """How the picture moves as a whole, from features of the background (backend.fit.stabilise)."""
    num = min(len(frames), _MAX_SAMPLES)
    indices = np.unique(np.linspace(0, len(frames) - 1, num).astype(int)).tolist()
    return stabilise.measure_motion(
        frames,
        indices,
        background=None if smoke is None else lambda index: stabilise.is_background(smoke[index]),
        on_step=report.progress,
    )
