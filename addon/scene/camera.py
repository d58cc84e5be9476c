"""The clip's camera in Blender. The one place in the add-on that converts camera axes and intrinsics.

Ours: x right, y down, z forward; Blender's: x right, y up, z backward. The camera's own axes change, so
matrix_world = camera_to_world diag(1, -1, -1, 1), a right multiplication.
"""

from __future__ import annotations

from pathlib import Path

import bpy
import numpy as np
from mathutils import Matrix, Quaternion

from ...backend.contract.cameras import Cameras
from ...backend.contract.result import Result
from .ownership import mark, owned_name
from .volume import frame_range

SENSOR_WIDTH = 36.0  # mm
_OPENCV_TO_BLENDER = Matrix.Diagonal((1.0, -1.0, -1.0, 1.0))
_SHORTEST_LENS = 1.0  # mm, Blender takes none shorter


def new_object(job: Path, collection: bpy.types.Collection) -> bpy.types.Object:
    name = owned_name(job, "Camera")
    made = bpy.data.objects.new(name, bpy.data.cameras.new(name))
    made.rotation_mode = "QUATERNION"
    mark(made, job, "camera")
    collection.objects.link(made)
    return made


def match(filmed_from: bpy.types.Object, cameras: Cameras, result: Result) -> None:
    """Lens, shift, clipping and place on every frame. A camera that moves gets a key on every frame."""
    set_intrinsics(filmed_from.data, cameras)
    _set_clipping(filmed_from.data, cameras, result)
    filmed_from.animation_data_clear()
    filmed_from.rotation_mode = "QUATERNION"
    first, last = frame_range(result)
    previous: Quaternion | None = None
    for frame in range(first, (first if cameras.is_still else last) + 1):
        matrix = Matrix(cameras.at(camera_index(cameras, result, frame - first))) @ _OPENCV_TO_BLENDER
        location, rotation, _ = matrix.decompose()
        if previous is not None:
            rotation.make_compatible(previous)  # q and -q are one rotation, but not one to blend through
        previous = rotation
        filmed_from.location, filmed_from.rotation_quaternion = location, rotation
        if not cameras.is_still:
            filmed_from.keyframe_insert("location", frame=frame)
            filmed_from.keyframe_insert("rotation_quaternion", frame=frame)


def camera_index(cameras: Cameras, result: Result, frame: int) -> int:
    """Which camera shows frame `frame` of the asset (0: the first fitted one); the last one stays for the forecast.

    A file with a camera for every frame of the video counts from the video's first frame, else from the first fitted.
    """
    count = len(cameras.camera_to_world)
    covers_video = count >= result.frame_start + result.num_frames
    return min(frame + (result.frame_start if covers_video else 0), count - 1)


def set_intrinsics(data: bpy.types.Camera, cameras: Cameras) -> None:
    """fx, cx, cy as lens and shift. fy differing from fx needs non-square pixels, which are the scene's: match_render.

    Blender measures both shifts in widths of the sensor, and vertical pixels as fx / fy of horizontal ones.
    """
    lens = cameras.fx * SENSOR_WIDTH / cameras.width
    enlarged = max(1.0, _SHORTEST_LENS / lens)
    data.type = "PERSP"
    data.lens_unit = "MILLIMETERS"
    data.sensor_fit = "HORIZONTAL"
    data.sensor_width = SENSOR_WIDTH * enlarged
    data.lens = lens * enlarged
    data.shift_x = (0.5 * cameras.width - cameras.cx) / cameras.width
    data.shift_y = (cameras.cy - 0.5 * cameras.height) * (cameras.fx / cameras.fy) / cameras.width


def match_render(scene: bpy.types.Scene, filmed_from: bpy.types.Object, cameras: Cameras) -> None:
    """The clip's resolution, pixel aspect and frame rate; the scene renders through the camera."""
    render = scene.render
    scene.camera = filmed_from
    render.resolution_x, render.resolution_y, render.resolution_percentage = cameras.width, cameras.height, 100
    aspect = cameras.fx / cameras.fy  # height of a pixel over its width
    render.pixel_aspect_x, render.pixel_aspect_y = max(1.0, 1.0 / aspect), max(1.0, aspect)
    render.fps = max(1, round(cameras.fps))
    render.fps_base = render.fps / cameras.fps


def show_plate(filmed_from: bpy.types.Object, plate: Path | None) -> None:
    """The background plate behind the smoke in the camera's view, if there is one."""
    data = filmed_from.data
    data.background_images.clear()
    data.show_background_images = plate is not None
    if plate is None:
        return
    background = data.background_images.new()
    background.image = bpy.data.images.load(str(plate), check_existing=True)
    background.alpha = 1.0
    background.display_depth = "BACK"
    background.frame_method = "FIT"


def _set_clipping(data: bpy.types.Camera, cameras: Cameras, result: Result) -> None:
    """Near and far so that all of the smoke is between them."""
    corners = np.array(np.meshgrid(*zip(*result.bounds, strict=True))).reshape(3, -1).T  # [8, 3] m
    eyes = np.array(cameras.camera_to_world)[:, :3, 3]
    farthest = float(np.linalg.norm(corners[None] - eyes[:, None], axis=2).max())
    data.clip_end = max(10.0 * farthest, 100.0)
    data.clip_start = min(0.1, 1e-3 * max(farthest, 1e-3))
    data.display_size = max(0.05 * farthest, 1e-3)
