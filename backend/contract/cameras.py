"""cameras.json: the camera of every frame. Read, checked and written here for both processes.

Axes x right, y down, z forward (OpenCV); world right-handed with z up; pixel centres at +0.5.
"""

from __future__ import annotations

import json
import math
import os
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from .errors import BackendError

Matrix = tuple[tuple[float, ...], ...]  # 4x4
_ROTATION_TOLERANCE = 1e-3
_LARGEST = 1e12  # of any number; beyond it sums of squares of metres lose the picture
_LARGEST_SIDE = 32_768  # px; a count beyond it is damage, and must not ask for memory


@dataclass(frozen=True, slots=True, kw_only=True)
class Cameras:
    """Intrinsics in px of a width x height image, and camera_to_world per frame (one: the camera stands still)."""

    width: int
    height: int
    fx: float
    fy: float
    cx: float
    cy: float
    fps: float
    camera_to_world: tuple[Matrix, ...]

    @property
    def is_still(self) -> bool:
        return len(self.camera_to_world) == 1

    def at(self, frame: int) -> Matrix:
        """camera_to_world of a frame. Raises IndexError beyond the last one of a moving camera."""
        return self.camera_to_world[0 if self.is_still else frame]

    def to_json(self) -> str:
        data: dict[str, Any] = {"axes": "opencv", "up": "z"}
        for name in ("width", "height", "fx", "fy", "cx", "cy", "fps", "camera_to_world"):
            data[name] = getattr(self, name)
        return json.dumps(data, allow_nan=False)


def read_cameras(path: str | os.PathLike[str], *, num_frames: int | None = None) -> Cameras:
    """The cameras in a file, checked; with num_frames, that there are as many (or one). Raises BackendError."""
    try:
        text = Path(path).read_text(encoding="utf-8")
    except (OSError, UnicodeDecodeError) as error:
        raise BackendError(
            "cameras_unreadable", f"{path} cannot be read: {error}.", hint="Give the path of a cameras.json."
        ) from error
    return parse_cameras(text, name=str(path), num_frames=num_frames)


def parse_cameras(text: str, *, name: str = "cameras.json", num_frames: int | None = None) -> Cameras:
    """As read_cameras, from the text of the file."""
    try:
        data = json.loads(text)
    except (ValueError, RecursionError) as error:
        raise _bad(name, f"is not JSON ({error})") from error
    if not isinstance(data, dict):
        raise _bad(name, "is not an object")
    if data.get("axes", "opencv") != "opencv" or data.get("up", "z") != "z":
        raise _bad(name, 'has other axes than "opencv" with up "z"')
    numbers = {key: _number(name, data, key) for key in ("width", "height", "fx", "fy", "cx", "cy", "fps")}
    width, height = numbers["width"], numbers["height"]
    for key in ("width", "height", "fx", "fy", "fps"):
        if numbers[key] <= 0:
            raise _bad(name, f"has {key} = {numbers[key]:g}, which is not positive")
    if not (width.is_integer() and height.is_integer()):
        raise _bad(name, "has a size that is not whole pixels")
    if max(width, height) > _LARGEST_SIDE:
        raise _bad(name, f"is for pictures of {width:g} x {height:g}; at most {_LARGEST_SIDE} a side can be drawn")
    matrices = data.get("camera_to_world")
    if not isinstance(matrices, list) or not matrices:
        raise _bad(name, "has no camera_to_world")
    if not isinstance(matrices[0], list) or (matrices[0] and not isinstance(matrices[0][0], list)):
        matrices = [matrices]  # one bare 4x4 is taken for a still camera
    checked = tuple(_matrix(name, frame, matrix) for frame, matrix in enumerate(matrices))
    if num_frames is not None and len(checked) not in (1, num_frames) and len(checked) < num_frames:
        raise BackendError(
            "cameras_too_few",
            f"{name} has {len(checked)} cameras for {num_frames} frames.",
            hint="Give one camera for each frame, or a single one for a camera that stands still.",
        )
    return Cameras(
        width=int(width),
        height=int(height),
        fx=numbers["fx"],
        fy=numbers["fy"],
        cx=numbers["cx"],
        cy=numbers["cy"],
        fps=numbers["fps"],
        camera_to_world=checked,
    )


def _bad(name: str, problem: str) -> BackendError:
    return BackendError("cameras_invalid", f"{name} {problem}.", hint="Correct the file; docs/conventions.md describes it.")


def _number(name: str, data: dict[str, Any], key: str) -> float:
    value = data.get(key)
    if isinstance(value, bool) or not isinstance(value, (int, float)):
        raise _bad(name, f"has no number {key}")
    if not math.isfinite(value) or abs(value) > _LARGEST:
        raise _bad(name, f"has a {key} that is not finite")
    return float(value)


def _matrix(name: str, frame: int, matrix: Any) -> Matrix:
    where = f"camera_to_world of frame {frame}"
    if not isinstance(matrix, list) or len(matrix) != 4 or any(not isinstance(row, list) or len(row) != 4 for row in matrix):
        raise _bad(name, f"has a {where} that is not 4x4")
    if any(isinstance(v, bool) or not isinstance(v, (int, float)) or not math.isfinite(v) for row in matrix for v in row):
        raise _bad(name, f"has NaN, infinity or no number in {where}")
    if any(abs(v) > _LARGEST for row in matrix for v in row):
        raise _bad(name, f"has a number beyond {_LARGEST:g} in {where}")
    rows = tuple(tuple(float(v) for v in row) for row in matrix)
    a, b, c = (row[:3] for row in rows[:3])
    determinant = a[0] * (b[1] * c[2] - b[2] * c[1]) - a[1] * (b[0] * c[2] - b[2] * c[0]) + a[2] * (b[0] * c[1] - b[1] * c[0])
    if abs(determinant) < 1e-9:
        raise _bad(name, f"has a singular {where}")
    columns = list(zip(a, b, c, strict=True))
    for i in range(3):
        for j in range(3):
            dot = sum(x * y for x, y in zip(columns[i], columns[j], strict=True))
            if abs(dot - (i == j)) > _ROTATION_TOLERANCE:
                raise _bad(name, f"has a {where} that is not a rotation and a position")
    if determinant < 0 or max(abs(rows[3][k] - (k == 3)) for k in range(4)) > 1e-6:
        raise _bad(name, f"has a {where} that mirrors or projects")
    return rows
