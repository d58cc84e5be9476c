"""The job folder's file names, and result.json: written last, so its presence says that all else is whole."""

from __future__ import annotations

import dataclasses
import json
import math
import os
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from .errors import BackendError
from .light import Light, parse_light
from .units import RESULT_FORMAT_VERSION

JOB_FILE = "job.json"
RESULT_FILE = "result.json"
LOG_FILE = "log.txt"
CAMERAS_FILE = "cameras.json"
PARTICLES_FILE = "particles.h5"
VDB_FOLDER = "vdb"
VDB_NAME = "smoke_{:04d}.vdb"  # numbered from 1, as Blender wants it
RUNNING_FILE = "running.json"  # {"pid": ..} while a backend works here


def vdb_path(folder: Path, frame: int) -> Path:
    """Where the volume of a frame lies, frames counted from 0."""
    return folder / VDB_NAME.format(frame + 1)


@dataclass(frozen=True, slots=True, kw_only=True)
class Result:
    """What a finished job made. Paths are relative to the job folder; frames count from 0.

    num_frames: fitted; num_forecast: after them. frame_start: the clip's frame that was fitted first.
    has_color: the VDBs hold a `color` grid; else `smoke_color` (linear RGB) is the colour of all of it.
    bounds: ((x, y, z) low, (x, y, z) high) of the smoke over all frames, m. light: the clip's, where its smoke shows one.
    """

    particles: str
    cameras: str
    vdb_folder: str
    num_frames: int
    num_forecast: int
    frame_start: int
    fps: float
    voxel_size: float
    has_color: bool
    smoke_color: tuple[float, float, float]
    bounds: tuple[tuple[float, float, float], tuple[float, float, float]]
    buoyancy: tuple[float, float, float]
    background_plate: str | None = None
    light: Light | None = None
    warnings: list[dict[str, str]] = field(default_factory=list)
    fingerprint: str = ""

    def to_json(self) -> str:
        data = {"format_version": RESULT_FORMAT_VERSION, **dataclasses.asdict(self)}
        return json.dumps(data, indent=2, sort_keys=True, allow_nan=False)


def read_result(job_folder: str | os.PathLike[str]) -> Result:
    """The result of a job folder. Raises BackendError if the job is not finished or the file is damaged."""
    path = Path(job_folder) / RESULT_FILE
    if not path.is_file():
        raise BackendError(
            "not_finished", f"{job_folder} holds no finished job.", hint="Run the job to its end; it resumes where it stopped."
        )
    try:
        data = json.loads(path.read_text(encoding="utf-8"))
        if data.pop("format_version") != RESULT_FORMAT_VERSION:
            raise ValueError("another format version")
        for name in ("bounds", "smoke_color", "buoyancy"):
            data[name] = _tuples(data[name])
        if data.get("light") is not None:
            data["light"] = parse_light(data["light"])
        return _checked(Result(**data))
    except (OSError, ValueError, TypeError, KeyError, AttributeError, OverflowError, RecursionError) as error:
        raise BackendError("result_unreadable", f"{path} cannot be read: {error}.", hint="Run the job again.") from error


_KINDS: dict[str, tuple[type, ...]] = {
    "str": (str,),
    "int": (int,),
    "float": (int, float),
    "bool": (bool,),
    "str | None": (str, type(None)),
    "list[dict[str, str]]": (list,),
}


def _checked(result: Result) -> Result:
    """The result itself. Raises ValueError where an entry is of another type than it should be, or a count is negative."""
    for item in dataclasses.fields(Result):
        value, kinds = getattr(result, item.name), _KINDS.get(str(item.type))
        if kinds is not None and (not isinstance(value, kinds) or (isinstance(value, bool) and bool not in kinds)):
            raise ValueError(f"{item.name} is {type(value).__name__} where {item.type} is expected")
    if len(result.bounds) != 2:
        raise ValueError("the bounds are not two corners")
    numbers = (result.fps, result.voxel_size, *result.smoke_color, *result.buoyancy, *result.bounds[0], *result.bounds[1])
    counts = (result.num_frames, result.num_forecast, result.frame_start)
    if not all(math.isfinite(number) for number in numbers) or min(counts) < 0:
        raise ValueError("a number is not finite, or a count is negative")
    if (len(result.smoke_color), len(result.buoyancy), *map(len, result.bounds)) != (3, 3, 3, 3) or result.fps <= 0.0:
        raise ValueError("a vector has other than three numbers, or there is no frame rate")
    for entry in result.warnings:
        if not (isinstance(entry, dict) and all(isinstance(word, str) for pair in entry.items() for word in pair)):
            raise ValueError("a warning is not made of words")
    return result


def _tuples(value: Any) -> Any:
    return tuple(_tuples(v) for v in value) if isinstance(value, list) else float(value)
