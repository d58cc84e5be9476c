"""One frame rendered by Cycles to a PNG, over the background plate where there is one. Never EEVEE: without a window
it ends the process.
"""

from __future__ import annotations

import os
import tempfile
from pathlib import Path

import bpy
import numpy as np

from ...backend.contract.errors import BackendError
from .surroundings import ensure_world, match_look


def render_preview(
    scene: bpy.types.Scene,
    path: str | os.PathLike[str],
    *,
    frame: int,
    samples: int = 16,
    longest_side: int = 0,
    plate: str | os.PathLike[str] | None = None,
) -> None:
    """Render Blender frame `frame` to a PNG (sRGB), over the plate or over black. longest_side: px, 0 for the scene's."""
    layer = render_layer(scene, frame=frame, samples=samples, longest_side=longest_side)
    below = np.zeros_like(layer[..., :3]) if plate is None else _plate_linear(Path(plate), layer.shape)
    write_png(Path(path), layer[..., :3] + below * (1.0 - layer[..., 3:]))


def render_layer(scene: bpy.types.Scene, *, frame: int, samples: int = 16, longest_side: int = 0) -> np.ndarray:
    """The smoke alone: [H, W, 4] float32, linear, premultiplied, top row first. Leaves the scene's settings as they were."""
    if scene.camera is None:
        raise BackendError("no_camera", "The scene has no camera.", hint="Import the job with its camera, or choose one.")
    with tempfile.TemporaryDirectory(prefix="wildsmoke_") as folder:
        path = Path(folder) / "layer.exr"
        kept = _Settings(scene)
        try:
            _set_up(scene, samples, longest_side)
            scene.frame_set(frame)
            scene.render.filepath = str(path)
            bpy.ops.render.render(write_still=True, scene=scene.name)
        finally:
            kept.restore()
        return _read_linear(path)


def write_png(path: Path, linear: np.ndarray) -> None:
    """[H, W, 3] linear -> 8-bit sRGB file, whole or not at all."""
    coded = np.clip(
        np.where(linear <= 0.0031308, 12.92 * linear, 1.055 * np.maximum(linear, 1e-9) ** (1 / 2.4) - 0.055), 0.0, 1.0
    )
    height, width = coded.shape[:2]
    image = bpy.data.images.new("wildsmoke preview", width, height, alpha=False)
    try:
        pixels = np.ones((height, width, 4), np.float32)
        pixels[..., :3] = coded[::-1]
        image.pixels.foreach_set(pixels.ravel())
        image.file_format = "PNG"
        part = path.with_name(path.name + ".part.png")
        image.filepath_raw = str(part)
        image.save()
        os.replace(part, path)
    finally:
        bpy.data.images.remove(image)


def _set_up(scene: bpy.types.Scene, samples: int, longest_side: int) -> None:
    ensure_world(scene)
    match_look(scene)
    scene.cycles.device = "CPU"
    scene.cycles.samples = samples
    scene.cycles.use_adaptive_sampling = False
    scene.cycles.use_denoising = True
    scene.cycles.denoiser = "OPENIMAGEDENOISE"
    scene.render.use_compositing = scene.render.use_sequencer = False
    scene.render.use_border = False
    image = scene.render.image_settings
    if hasattr(image, "media_type"):  # Blender 5: the format is chosen within it
        image.media_type = "IMAGE"
    image.file_format, image.color_mode, image.color_depth = "OPEN_EXR", "RGBA", "32"
    if longest_side:
        share = 100.0 * longest_side / max(scene.render.resolution_x, scene.render.resolution_y)
        scene.render.resolution_percentage = max(1, min(100, round(share)))


def _read_linear(path: Path) -> np.ndarray:
    """[H, W, 4] float32 of an OpenEXR, top row first."""
    image = bpy.data.images.load(str(path))
    try:
        image.colorspace_settings.name = "Non-Color"
        image.alpha_mode = "CHANNEL_PACKED"  # as stored: premultiplied
        width, height = image.size
        pixels = np.empty(width * height * 4, np.float32)
        image.pixels.foreach_get(pixels)
    finally:
        bpy.data.images.remove(image)
    return pixels.reshape(height, width, 4)[::-1].copy()


def _plate_linear(path: Path, shape: tuple[int, ...]) -> np.ndarray:
    """The plate, scaled to the layer, linear."""
    image = bpy.data.images.load(str(path))
    try:
        image.colorspace_settings.name = "Non-Color"
        if tuple(image.size) != (shape[1], shape[0]):
            image.scale(shape[1], shape[0])
        pixels = np.empty(shape[0] * shape[1] * 4, np.float32)
        image.pixels.foreach_get(pixels)
    finally:
        bpy.data.images.remove(image)
    coded = pixels.reshape(shape[0], shape[1], 4)[::-1, :, :3]
    return np.where(coded <= 0.04045, coded / 12.92, ((coded + 0.055) / 1.055) ** 2.4)


class _Settings:
    """Values of a scene that a render changes, to be put back."""

    _NAMES = (
        ("", ("frame_current", "world")),
        (
            "render",
            ("engine", "film_transparent", "filepath", "use_compositing", "use_sequencer", "use_border", "resolution_percentage"),
        ),
        ("render.image_settings", ("media_type", "file_format", "color_mode", "color_depth")),
        ("view_settings", ("view_transform", "look", "exposure", "gamma")),
        (
            "cycles",
            ("device", "samples", "use_adaptive_sampling", "use_denoising", "denoiser", "volume_bounces", "volume_biased"),
        ),
    )

    def __init__(self, scene: bpy.types.Scene) -> None:
        self._kept = []
        for path, names in self._NAMES:
            owner = scene.path_resolve(path) if path else scene
            self._kept += [(owner, name, getattr(owner, name)) for name in names if hasattr(owner, name)]
        self._scene = scene

    def restore(self) -> None:
        for owner, name, value in self._kept:
            if name == "frame_current":
                self._scene.frame_set(value)
            elif name != "world" or value is not None:
                setattr(owner, name, value)
