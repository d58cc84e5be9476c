"""The smoke as a volume object that shows one VDB file at a time."""

from __future__ import annotations

import itertools
from pathlib import Path

import bpy
from bpy_extras.object_utils import world_to_camera_view
from mathutils import Vector

from synthetic.scene import shading

_ANISOTROPY = 0.25  # smoke throws more light forward than back
_NAME = "smoke"
_MARGIN = 4.0  # px around the smoke's box
_CORNER = (0.0, 0.0), (0.1, 0.1)


def show_smoke(path: Path | None, *, albedo: tuple[float, float, float]) -> None:
    """Show the grids of a VDB file; None: no smoke. albedo, linear RGB, counts when the smoke is first shown."""
    item = bpy.data.objects.get(_NAME)
    if item is None:
        item = bpy.data.objects.new(_NAME, bpy.data.volumes.new(_NAME))
        item.data.materials.append(shading.smoke(_NAME, albedo, anisotropy=_ANISOTROPY))
        bpy.context.scene.collection.objects.link(item)
    item.hide_render = path is None
    if path is not None:
        if not path.is_file():
            raise FileNotFoundError(f"there is no smoke file {path}")
        item.data.filepath = str(path)
        item.location = -_misplacement(item.data)


def _misplacement(volume: bpy.types.Volume) -> Vector:
    """How far Cycles draws the grid from where its file says, m. test_cycles_images.py measures that it is made good.

    OpenVDB's transform gives the centre of a voxel. Blender 5.2 draws it so; 4.5 takes it for the low corner.
    """
    if bpy.app.version >= (5, 0):
        return Vector()
    if not volume.grids.load():
        raise ValueError(f"{volume.filepath} holds no grids: {volume.grids.error_message}")
    if not len(volume.grids):
        return Vector()
    return volume.grids[0].matrix_object.to_3x3() @ Vector((0.5, 0.5, 0.5))


def smoke_window(camera: bpy.types.Object) -> tuple[tuple[float, float], tuple[float, float]]:
    """Left bottom and right top of what the shown smoke's box covers in the image, each 0..1 and a few pixels wider;
    the whole image where the box reaches behind the camera, and a small corner where there is no smoke in view."""
    item, scene = bpy.data.objects[_NAME], bpy.context.scene
    bpy.context.view_layer.update()
    corners = [] if item.hide_render else _corners(item)
    if not corners:
        return _CORNER
    seen = [world_to_camera_view(scene, camera, item.matrix_world @ corner) for corner in corners]
    if min(point.z for point in seen) <= camera.data.clip_start:
        return (0.0, 0.0), (1.0, 1.0)
    low, high = [], []
    for axis, size in enumerate((scene.render.resolution_x, scene.render.resolution_y)):
        margin = _MARGIN / size
        low.append(min(max(min(point[axis] for point in seen) - margin, 0.0), 1.0))
        high.append(min(max(max(point[axis] for point in seen) + margin, 0.0), 1.0))
    if min(b - a for a, b in zip(low, high, strict=True)) <= 0.0:
        return _CORNER
    return (low[0], low[1]), (high[0], high[1])


def _corners(item: bpy.types.Object) -> list[Vector]:
    """Corners of the box around the density, object coordinates, m; empty where there is none. An object's own box is
    that of all grids, and velocity fills the whole air."""
    if hasattr(bpy.utils, "expose_bundled_modules"):  # a distribution's Blender has its modules on Python's path
        bpy.utils.expose_bundled_modules()
    try:
        import openvdb
    except ImportError:  # a Blender without the module: a larger window, the same image
        return [Vector(corner) for corner in item.bound_box]
    grid = openvdb.read(item.data.filepath, "density")
    if grid.activeVoxelCount() == 0:
        return []
    low, high = grid.evalActiveVoxelBoundingBox()
    spans = [(a - 1, b + 2) for a, b in zip(low, high, strict=True)]  # values reach one voxel beyond their centre
    return [Vector(grid.transform.indexToWorld(index)) for index in itertools.product(*spans)]
