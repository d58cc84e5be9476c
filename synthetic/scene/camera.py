"""Contract cameras in Blender: the one place where OpenCV axes and pixels become Blender's."""

from __future__ import annotations

import bpy
from mathutils import Matrix

from backend.contract.cameras import Cameras

_SENSOR_WIDTH = 36.0  # mm; any value, it only scales the focal length


def set_camera(cameras: Cameras, frame: int, *, size: tuple[int, int] | None = None) -> bpy.types.Object:
    """Make the scene's camera the one of a frame, and its image `size` (width, height) px, by default the cameras' own.

    Raises ValueError where the pixels are not square.
    """
    if abs(cameras.fx / cameras.fy - 1) > 1e-6:
        raise ValueError(f"fx {cameras.fx} and fy {cameras.fy} differ; only square pixels are rendered")
    scene = bpy.context.scene
    item = scene.camera
    if item is None:
        item = bpy.data.objects.new("camera", bpy.data.cameras.new("camera"))
        scene.collection.objects.link(item)
        scene.camera = item
    width, height = cameras.width, cameras.height
    lens = item.data
    lens.sensor_fit = "HORIZONTAL"
    lens.sensor_width = _SENSOR_WIDTH
    lens.lens = cameras.fx * _SENSOR_WIDTH / width
    lens.shift_x = (0.5 * width - cameras.cx) / width
    lens.shift_y = (cameras.cy - 0.5 * height) / width
    lens.clip_start, lens.clip_end = 0.1, 2000.0
    # Blender's camera looks along -z with y up.
    item.matrix_world = Matrix(cameras.at(frame)) @ Matrix.Diagonal((1.0, -1.0, -1.0, 1.0))
    scene.render.resolution_x, scene.render.resolution_y = size or (width, height)
    scene.render.resolution_percentage = 100
    scene.render.pixel_aspect_x = scene.render.pixel_aspect_y = 1.0
    return item
