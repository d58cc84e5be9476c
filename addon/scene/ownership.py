"""Which objects and collections came from which job: two custom properties, so that a second import finds them."""

from __future__ import annotations

from pathlib import Path

import bpy

JOB_PROPERTY = "wildsmoke_job"
ROLE_PROPERTY = "wildsmoke_role"


def owned_name(job: Path, title: str) -> str:
    return f"{title} {job.name}"[:63]


def mark(data: bpy.types.ID, job: Path, role: str) -> None:
    data[JOB_PROPERTY], data[ROLE_PROPERTY] = str(job), role


def belongs_to(data: bpy.types.ID, job: Path, role: str) -> bool:
    """The stored path may be relative to the .blend (`//`): it is made so when one is saved."""
    if data.get(ROLE_PROPERTY) != role or not isinstance(data.get(JOB_PROPERTY), str):
        return False
    return Path(bpy.path.abspath(data[JOB_PROPERTY])).resolve() == job


def find_object(job: Path, role: str) -> bpy.types.Object | None:
    return next((item for item in bpy.data.objects if belongs_to(item, job, role)), None)


def collection_of(job: Path, scene: bpy.types.Scene) -> bpy.types.Collection:
    """The job's own collection, in the scene."""
    found = next((item for item in bpy.data.collections if belongs_to(item, job, "collection")), None)
    if found is None:
        found = bpy.data.collections.new(owned_name(job, "Wildsmoke"))
        mark(found, job, "collection")
    if found not in scene.collection.children_recursive:
        scene.collection.children.link(found)
    return found


def relative_paths(folder: Path) -> None:
    """Make the paths of volumes, images and jobs relative to a .blend in `folder`; another drive's stay as they are."""

    def relative(path: str) -> str:
        absolute = bpy.path.abspath(path)
        try:
            return bpy.path.relpath(absolute, start=str(folder))
        except ValueError:
            return absolute

    for item in bpy.data.volumes:
        if item.filepath:
            item.filepath = relative(item.filepath)
    for item in bpy.data.images:
        if item.source in {"FILE", "SEQUENCE", "MOVIE"} and item.filepath:
            item.filepath = relative(item.filepath)
    for owners in (bpy.data.objects, bpy.data.collections):
        for item in owners:
            if isinstance(item.get(JOB_PROPERTY), str):
                item[JOB_PROPERTY] = relative(item[JOB_PROPERTY])
