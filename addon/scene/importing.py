"""A finished job becomes objects in a scene. Importing it again updates them: each carries the job and its role."""

from __future__ import annotations

import os
from pathlib import Path

import bpy

from ...backend.contract.cameras import read_cameras
from ...backend.contract.result import Result, read_result
from . import camera, material, surroundings, volume
from .ownership import collection_of, find_object, owned_name


def import_result(
    job_folder: str | os.PathLike[str],
    *,
    scene: bpy.types.Scene,
    collection: bpy.types.Collection | None = None,
    match_render: bool = True,
) -> bpy.types.Object:
    """Bring the result of a job into a scene and return the volume object. Raises BackendError.

    collection: where new objects go; None makes one named after the job folder. match_render: set the scene's
    resolution, frame rate, frame range, camera, engine and colours as the clip has them.
    """
    job = Path(job_folder).resolve()
    result = read_result(job)
    cameras = read_cameras(job / result.cameras)
    volume.check_readable(job, result)
    target = collection or collection_of(job, scene)
    smoke = find_object(job, "volume") or volume.new_object(job, target)
    volume.show_sequence(smoke, job, result)
    material.apply(smoke, result, name=owned_name(job, "Smoke"))
    filmed_from = find_object(job, "camera") or camera.new_object(job, target)
    camera.match(filmed_from, cameras, result)
    camera.show_plate(filmed_from, None if result.background_plate is None else job / result.background_plate)
    surroundings.ensure(scene, target, job, result)
    if match_render:
        camera.match_render(scene, filmed_from, cameras)
        _match_timeline(scene, result)
        surroundings.match_look(scene)
    return smoke


def _match_timeline(scene: bpy.types.Scene, result: Result) -> None:
    first, last = volume.frame_range(result)
    scene.frame_start, scene.frame_end = first, last
    if not first <= scene.frame_current <= last:
        scene.frame_set(first)
