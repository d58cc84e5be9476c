"""Opens a clip: a video file, a GIF, or a sequence of images. Frames are streamed, never held.

Every clip is checked when it is opened, so that a bad one is refused with one sentence before work begins.
"""

from __future__ import annotations

import os
from collections.abc import Iterator
from pathlib import Path
from typing import Protocol

import numpy as np

from backend.contract.errors import BackendError
from backend.io.image_sequence import IMAGE_SUFFIXES, ImageSequence, find_images
from backend.io.video_file import VideoFile

MIN_FRAMES = 3  # motion needs two differences: a velocity and its change
MIN_SIDE = 16  # px; below this there is nothing to track


class Clip(Protocol):
    """What every kind of clip offers. width, height px; fps frames a second; has_alpha: some pixel is not opaque.

    fingerprint: names the content; the same bytes give the same text, wherever they lie.
    """

    name: str
    width: int
    height: int
    num_frames: int
    fps: float
    has_alpha: bool
    bit_depth: int

    @property
    def fingerprint(self) -> str: ...

    def frames(self, start: int = 0, stop: int | None = None) -> Iterator[np.ndarray]:
        """Frames start to stop-1 in order, [H, W, 3 or 4] uint8 or uint16, sRGB-coded, straight alpha."""
        ...

    def close(self) -> None: ...

    def __enter__(self) -> Clip: ...

    def __exit__(self, *_: object) -> None: ...


def open_clip(path: str | os.PathLike[str], *, frame_rate: float = 0.0) -> Clip:
    """Open a video file, a GIF, a folder of images, a pattern such as shot_%04d.png, or one image of a sequence.

    frame_rate: frames per second, 0 for the file's own (sequences: 24). Raises BackendError.
    """
    path = Path(path)
    if "%" in path.name or path.is_dir() or (path.suffix.lower() in IMAGE_SUFFIXES and path.is_file()):
        files = find_images(path)
        _check_length(path.name, len(files))
        clip: Clip = ImageSequence(files, name=path.name, frame_rate=frame_rate)
    else:
        _check_file(path)
        clip = VideoFile(path, frame_rate=frame_rate)
        _check_length(path.name, clip.num_frames)
    if min(clip.width, clip.height) < MIN_SIDE:
        raise BackendError(
            "clip_too_small",
            f"{path.name} is {clip.width} x {clip.height} pixels; at least {MIN_SIDE} on each side are needed.",
            hint="Give the clip in its full size.",
        )
    return clip


def _check_file(path: Path) -> None:
    """That there is a file with something in it."""
    try:
        with open(path, "rb") as handle:
            is_empty = not handle.read(1)
    except FileNotFoundError as error:
        raise BackendError("clip_missing", f"There is no file {path}.", hint="Check the path of the video.") from error
    except OSError as error:
        raise BackendError(
            "clip_forbidden", f"{path} cannot be read: {error.strerror}.", hint="Check who may read the file."
        ) from error
    if is_empty:
        raise BackendError("clip_empty", f"{path.name} is an empty file.", hint="Copy or export the video again.")


def _check_length(name: str, num_frames: int) -> None:
    if num_frames < MIN_FRAMES:
        frames = "frame" if num_frames == 1 else "frames"
        raise BackendError(
            "clip_too_short",
            f"{name} has {num_frames} {frames}; at least {MIN_FRAMES} are needed to see the smoke move.",
            hint="Give a longer clip, or the whole image sequence.",
        )
