"""Whatever `--truth` names."""

from __future__ import annotations

from pathlib import Path

from backend.contract.truth import TRUTH_FILE, TRUTH_FOLDER
from backend.score.camera_set import read_camera_set
from backend.score.truth_set import Truth, read_truth_set


def read_truth(folder: Path, *, num_seen: int, input_name: str) -> Truth:
    """A packed scene where there is one, else a set of cameras. num_seen: frames that were fitted; input_name: of the camera
    that filmed them, in a set. Raises BackendError."""
    if (folder / TRUTH_FOLDER / TRUTH_FILE).is_file():
        return read_truth_set(folder)
    return read_camera_set(folder, num_seen=num_seen, input_name=input_name)
