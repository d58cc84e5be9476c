"""Given cameras, brought to the frames that are fitted: their number, their size, their rate."""

from __future__ import annotations

import math

from backend.contract.cameras import Cameras, Matrix
from backend.contract.errors import BackendError
from backend.reporting import Report

_ASPECT_TOLERANCE = 0.01
_FPS_TOLERANCE = 0.01


def fitting(
    given: Cameras,
    num_frames: int,
    frame_start: int,
    *,
    size: tuple[int, int],  # (width, height) px of the frames that are fitted
    fps: float,
    report: Report,
) -> Cameras:
    """The given cameras from the first fitted frame on, at the size of the frames. Raises BackendError where they do not fit."""
    sx, sy = size[0] / given.width, size[1] / given.height
    tolerance = _ASPECT_TOLERANCE + 1.0 / min(size)  # the frames' size is rounded to whole pixels
    if abs(math.log(sx / sy)) > tolerance:
        raise BackendError(
            "cameras_aspect",
            f"cameras.json is for pictures of {given.width} x {given.height}, the clip's are shaped like {size[0]} x {size[1]}.",
            hint="Solve the camera on the same picture, without letterbox or crop.",
        )
    if abs(given.fps / fps - 1.0) > _FPS_TOLERANCE:
        report.warning(
            "cameras_fps",
            f"cameras.json says {given.fps:g} frames a second, the clip {fps:g}; the clip's rate is used.",
        )
    return Cameras(
        width=size[0],
        height=size[1],
        fx=given.fx * sx,
        fy=given.fy * sy,
        cx=given.cx * sx,
        cy=given.cy * sy,
        fps=fps,
        camera_to_world=_of_frames(given, num_frames, frame_start),
    )


def _of_frames(given: Cameras, num_frames: int, frame_start: int) -> tuple[Matrix, ...]:
    """One matrix for each fitted frame, and those behind them. A file of exactly the fitted frames is taken as it is."""
    matrices = given.camera_to_world
    if given.is_still or len(matrices) == num_frames:
        return matrices
    if len(matrices) < frame_start + num_frames:
        raise BackendError(
            "cameras_too_few",
            f"cameras.json has {len(matrices)} cameras, but frames {frame_start} to {frame_start + num_frames - 1} are fitted.",
            hint="Give one camera for each frame of the clip, or a single one for a camera that stands still.",
        )
    return matrices[frame_start:]
