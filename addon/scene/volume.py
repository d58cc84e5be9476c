"""The VDB sequence as a Volume object, through the data API alone."""

from __future__ import annotations

from pathlib import Path

import bpy

from ...backend.contract.errors import BackendError
from ...backend.contract.result import Result, vdb_path
from .ownership import mark, owned_name

VOXEL_SIZE_PROPERTY = "wildsmoke_voxel_size"
_CYCLES_CENTERED_SINCE = (5, 0, 0)


def frame_range(result: Result) -> tuple[int, int]:
    """First and last Blender frame: video frame 0 is Blender's frame 1; the forecast is included."""
    first = result.frame_start + 1
    return first, first + result.num_frames + result.num_forecast - 1


def new_object(job: Path, collection: bpy.types.Collection) -> bpy.types.Object:
    name = owned_name(job, "Smoke")
    smoke = bpy.data.objects.new(name, bpy.data.volumes.new(name))
    mark(smoke, job, "volume")
    collection.objects.link(smoke)
    return smoke


def check_readable(job: Path, result: Result) -> None:
    """Whether Blender can read the job's first file, before anything is made. Raises BackendError."""
    path = _first_file(job, result)
    if not path.is_file():
        raise BackendError("vdb_missing", f"There is no {path}.", hint="Run the job again; it writes what is missing.")
    probe = bpy.data.volumes.new("wildsmoke probe")
    try:
        probe.filepath = str(path)
        if not probe.grids.load():
            raise BackendError("vdb_damaged", f"Blender cannot read {path}.", hint="Delete it and run the job again.")
    finally:
        bpy.data.volumes.remove(probe)


def show_sequence(smoke: bpy.types.Object, job: Path, result: Result) -> None:
    """Point the volume at the job's sequence: on frame f it shows the file numbered f - frame_start."""
    data = smoke.data
    data.filepath = str(_first_file(job, result))
    data.is_sequence = False
    data.grids.load()
    data.velocity_grid = "velocity"  # looked up among the grids, so they must be loaded
    data.grids.unload()
    data.is_sequence = True
    data.frame_start, last = frame_range(result)
    data.frame_duration = last - data.frame_start + 1
    data.frame_offset = 0
    data.sequence_mode = "CLIP"
    data.velocity_unit = "SECOND"  # the default, FRAME, would blur too little by the frame rate
    data.velocity_scale = 1.0
    smoke[VOXEL_SIZE_PROPERTY] = result.voxel_size
    align(smoke)
    data.render.space = "WORLD"
    data.render.step_size = result.voxel_size


def _first_file(job: Path, result: Result) -> Path:
    return vdb_path(job / result.vdb_folder, 0)


def align(smoke: bpy.types.Object) -> None:
    """Make up for where this Blender draws a grid.

    Cycles before Blender 5.0 draws every grid half a voxel towards +x, +y and +z (found by fitting a rendered opacity to
    the grid's own; 5.0.1 and 5.2.3 draw it in place). A .blend may be opened by either, so this is done anew on loading.
    """
    half = -0.5 * smoke[VOXEL_SIZE_PROPERTY] if bpy.app.version < _CYCLES_CENTERED_SINCE else 0.0
    smoke.delta_location = (half, half, half)


def align_all() -> None:
    """For every smoke in the file, when it was saved by another version of Blender."""
    for smoke in bpy.data.objects:
        if smoke.type == "VOLUME" and VOXEL_SIZE_PROPERTY in smoke:
            align(smoke)
