"""Where a benchmark scene keeps what a method may read and what it is scored on. Written by synthetic/, read by backend/score.

    SCENE/input/   clip.mp4, smoke.mkv (seen frames), cameras.json (all frames)          a method may read this
    SCENE/truth/   truth.json, and what it tells of                                      it is scored on this

A view other than the input's has a folder of its own under truth/.
"""

from __future__ import annotations

from pathlib import PurePosixPath

INPUT_VIEW = "input"
INPUT_FOLDER = "input"
TRUTH_FOLDER = "truth"
TRUTH_FILE = "truth.json"
CLIP_VIDEO = "clip.mp4"
SMOKE_VIDEO = "smoke.mkv"
FUTURE_VIDEO = "future.mkv"
VOLUMES_FILE = "volumes.h5"


def view_folder(view: str) -> PurePosixPath:
    """Of a view's cameras and pictures, inside the scene's folder."""
    return PurePosixPath(INPUT_FOLDER) if view == INPUT_VIEW else PurePosixPath(TRUTH_FOLDER, view)
