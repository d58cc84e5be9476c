"""Cycles: its settings, and one image to one whole file."""

from __future__ import annotations

import os
import sys
from collections.abc import Iterator
from contextlib import contextmanager, nullcontext
from pathlib import Path
from tempfile import TemporaryDirectory

import bpy
import numpy as np

from synthetic.layers import Layer, Quality
from synthetic.scene import shading
from synthetic.scene.pixels import encode_png, read_exr
from synthetic.scene.smoke import smoke_window

_OPACITY_SAMPLES = "wildsmoke_opacity_samples"  # property of the scene; the other settings are Cycles' own


def set_quality(quality: Quality, *, seed: int) -> None:
    """The scene's render settings. The image is plain sRGB of linear radiance, without a film look."""
    scene = bpy.context.scene
    scene.render.engine = "CYCLES"
    cycles = scene.cycles
    cycles.device = "CPU"
    cycles.samples = quality.samples
    scene[_OPACITY_SAMPLES] = quality.opacity_samples
    cycles.seed = seed
    cycles.use_adaptive_sampling = False
    cycles.use_denoising = quality.is_denoised
    if quality.is_denoised:
        cycles.denoiser = "OPENIMAGEDENOISE"
    cycles.max_bounces = max(quality.bounces, quality.volume_bounces)
    cycles.diffuse_bounces = quality.bounces
    cycles.glossy_bounces = quality.bounces
    cycles.volume_bounces = quality.volume_bounces
    cycles.volume_step_rate = quality.step_rate
    cycles.volume_max_steps = 1024
    if hasattr(cycles, "volume_biased"):  # Blender 5; 4.5 has nothing but ray marching
        cycles.volume_biased = quality.is_biased
    if quality.threads:
        scene.render.threads_mode, scene.render.threads = "FIXED", quality.threads
    scene.render.use_persistent_data = True
    scene.render.resolution_percentage = 100
    scene.render.use_file_extension = False
    scene.view_settings.view_transform = "Standard"
    scene.view_settings.look = "None"
    scene.view_settings.exposure = 0.0
    scene.view_settings.gamma = 1.0
    scene.display_settings.display_device = "sRGB"


def render_image(path: Path, layer: Layer) -> None:
    """Render the scene as it stands to a file that is whole or absent."""
    # The process number keeps two workers apart, should a claim ever fail on a shared folder.
    part = path.with_name(f"{path.name}.{os.getpid()}.part")
    if layer is Layer.SMOKE:
        part.write_bytes(encode_png(render_smoke()))
    elif layer is Layer.DEPTH:
        _prepare(layer)
        with _depth_instead_of_light():
            _render_exr(part)
    else:
        _prepare(layer)
        settings = bpy.context.scene.render.image_settings
        settings.file_format, settings.color_mode, settings.color_depth = "PNG", "RGB", "8"
        settings.compression = 60
        _render(part)
    with open(part, "rb") as file:
        os.fsync(file.fileno())
    os.replace(part, path)


def render_smoke() -> np.ndarray:
    """[H, W, 4] linear: smoke alone, its premultiplied light and its opacity.

    Two renders: Cycles draws lots for the opacity of what scatters, and the denoiser leaves it alone; of what only absorbs,
    the opacity is integrated along the ray.
    """
    image = render_light(Layer.SMOKE)
    image[..., 3] = render_opacity()
    return image


def render_light(layer: Layer) -> np.ndarray:
    """[H, W, 4] linear light of the scene as it stands; the fourth channel is what Cycles takes for opacity."""
    _prepare(layer)
    with _smoke_only() if layer is Layer.SMOKE else nullcontext():
        return _rendered()


def render_opacity() -> np.ndarray:
    """[H, W] opacity of the smoke alone."""
    _prepare(Layer.SMOKE)
    with _smoke_only(), _absorption_instead_of_light():
        return _rendered()[..., 3]


def _rendered() -> np.ndarray:
    with TemporaryDirectory() as folder:
        path = Path(folder, "image.exr")
        _render_exr(path)
        return read_exr(path)


def _prepare(layer: Layer) -> None:
    scene = bpy.context.scene
    scene.render.film_transparent = layer in (Layer.SMOKE, Layer.DEPTH)
    for item in scene.objects:
        if item.type == "MESH":
            item.is_holdout = layer is Layer.SMOKE
    shading.show_texture(layer is not Layer.SMOKE)


@contextmanager
def _smoke_only() -> Iterator[None]:
    """Render nothing but the part of the image that the smoke's box covers; the rest is empty anyway."""
    render = bpy.context.scene.render
    low, high = smoke_window(bpy.context.scene.camera)
    render.use_border, render.use_crop_to_border = True, False
    render.border_min_x, render.border_min_y = low
    render.border_max_x, render.border_max_y = high
    try:
        yield
    finally:
        render.use_border = False


def _render_exr(path: Path) -> None:
    settings = bpy.context.scene.render.image_settings
    settings.file_format, settings.color_mode, settings.color_depth = "OPEN_EXR", "RGBA", "32"
    settings.exr_codec = "ZIP"
    _render(path)


def _render(path: Path) -> None:
    bpy.context.scene.render.filepath = str(path)
    with _quiet():
        bpy.ops.render.render(write_still=True)


@contextmanager
def _absorption_instead_of_light() -> Iterator[None]:
    """The smoke swallows all light: alpha is 1 - transmittance, and only the ray marching's jitter is left to average."""
    cycles = bpy.context.scene.cycles
    kept_settings = cycles.samples, cycles.use_denoising, cycles.max_bounces
    cycles.samples, cycles.use_denoising, cycles.max_bounces = bpy.context.scene[_OPACITY_SAMPLES], False, 0
    volumes = [item.data for item in bpy.context.scene.objects if item.type == "VOLUME"]
    kept = [volume.materials[0] for volume in volumes]
    for volume in volumes:
        volume.materials[0] = bpy.data.materials.get("absorption") or shading.absorption("absorption")
    try:
        yield
    finally:
        for volume, material in zip(volumes, kept, strict=True):
            volume.materials[0] = material
        cycles.samples, cycles.use_denoising, cycles.max_bounces = kept_settings


@contextmanager
def _depth_instead_of_light() -> Iterator[None]:
    """Everything shines with its distance along the optical axis, m, sampled once in the middle of each pixel."""
    cycles, layer = bpy.context.scene.cycles, bpy.context.view_layer
    kept = cycles.samples, cycles.use_denoising, cycles.filter_width, cycles.max_bounces
    cycles.samples, cycles.use_denoising, cycles.filter_width, cycles.max_bounces = 1, False, 0.01, 0
    layer.material_override = bpy.data.materials.get("depth") or shading.depth("depth")
    try:
        yield
    finally:
        layer.material_override = None
        cycles.samples, cycles.use_denoising, cycles.filter_width, cycles.max_bounces = kept


@contextmanager
def _quiet() -> Iterator[None]:
    """Blender prints a line for every object and frame to file descriptor 1, past Python."""
    sys.stdout.flush()
    kept, nothing = os.dup(1), os.open(os.devnull, os.O_WRONLY)
    os.dup2(nothing, 1)
    try:
        yield
    finally:
        os.dup2(kept, 1)
        os.close(kept)
        os.close(nothing)
