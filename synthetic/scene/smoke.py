"""The smoke as a volume object that shows one VDB file at a time."""

from __future__ import annotations

from pathlib import Path

import bpy
from mathutils import Vector

from synthetic.scene import shading

_ALBEDO = (0.9, 0.885, 0.87)
_ANISOTROPY = 0.25  # smoke throws more light forward than back
_NAME = "smoke"


def show_smoke(path: Path | None) -> None:
    """Show the grids of a VDB file; None: no smoke."""
    item = bpy.data.objects.get(_NAME)
    if item is None:
        item = bpy.data.objects.new(_NAME, bpy.data.volumes.new(_NAME))
        item.data.materials.append(shading.smoke(_NAME, _ALBEDO, anisotropy=_ANISOTROPY))
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
