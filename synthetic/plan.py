"""Which images a benchmark scene consists of, and where each lies.

DIR/input/   what a method may read: clip.mp4, clip/0000.png .. (the seen frames only), cameras.json (all frames)
DIR/truth/   what it is scored on: future/ (the clip's unseen frames), smoke/ plate/ depth/ of the input cameras,
             nvs/ side/ back/ each with smoke/ plate/ depth/ cameras.json, volumes/, truth.json
DIR/smoke/   the smoke of every frame as VDB: what is rendered, truth too
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import PurePosixPath

from backend.contract.cameras import Cameras
from backend.contract.truth import INPUT_FOLDER, INPUT_VIEW, TRUTH_FOLDER
from synthetic.layers import Layer
from synthetic.presets import Preset
from synthetic.sweep import orbit_cameras, still_cameras

SMOKE_FOLDER = "smoke"
SHIPPED_EVERY = {"input": 1, "nvs": 3, "side": 9, "back": 9}  # frames
TEST_VIEWS = {"nvs": 0.0, "side": 120.0, "back": 180.0}  # degrees that the camera is turned from the first frame's


@dataclass(frozen=True, slots=True, kw_only=True)
class Image:
    """One image: a view ("input" or a test view), a layer, a frame; path relative to the scene's folder."""

    view: str
    layer: Layer
    frame: int
    path: PurePosixPath


def view_cameras(preset: Preset) -> dict[str, Cameras]:
    """The cameras of every view."""
    size = {"width": preset.width, "height": preset.height, "fps": preset.fps}
    cameras = {INPUT_VIEW: orbit_cameras(preset.orbit, num_frames=preset.num_frames, **size)}
    for name in preset.views:
        if name != INPUT_VIEW:
            cameras[name] = still_cameras(preset.orbit, turned=TEST_VIEWS[name], **size)
    return cameras


def plan_images(preset: Preset, *, views: tuple[str, ...] | None = None) -> list[Image]:
    """All images, ordered by frame. A camera that stands still has one plate and one depth, at frame 0."""
    cameras = view_cameras(preset)
    chosen = tuple(cameras) if views is None else views
    images = []
    for frame in range(preset.num_frames):
        for view in chosen:
            is_first = frame == 0 or not cameras[view].is_still
            if view == INPUT_VIEW:
                images.append(_image(preset, view, Layer.CLIP, frame))
            if frame % preset.smoke_every == 0:
                images.append(_image(preset, view, Layer.SMOKE, frame))
            if is_first:
                images += [_image(preset, view, layer, frame) for layer in (Layer.PLATE, Layer.DEPTH)]
    return images


def plan_shipped(preset: Preset) -> list[Image]:
    """The images of the set that ships: the clip's seen frames, and the smoke alone at the rates of SHIPPED_EVERY."""
    num_seen = preset.num_frames - preset.num_future
    kept = {view: every for view, every in SHIPPED_EVERY.items() if view in preset.views}
    return [
        image
        for image in plan_images(preset)
        if (image.layer is Layer.CLIP and image.frame < num_seen)
        or (image.layer is Layer.SMOKE and image.frame % kept[image.view] == 0)
    ]


def first_frames(start: int, stop: int) -> tuple[int, ...]:
    """First, middle and last of start .. stop - 1: made first, because the cost of all is estimated from them."""
    return tuple(dict.fromkeys((start, (start + stop - 1) // 2, stop - 1)))


def _image(preset: Preset, view: str, layer: Layer, frame: int) -> Image:
    name = f"{frame:04d}{layer.suffix}"
    if layer is Layer.CLIP:
        is_seen = frame < preset.num_frames - preset.num_future
        folder = PurePosixPath(INPUT_FOLDER, "clip") if is_seen else PurePosixPath(TRUTH_FOLDER, "future")
    else:
        folder = PurePosixPath(TRUTH_FOLDER, *(() if view == INPUT_VIEW else (view,)), layer.value)
    return Image(view=view, layer=layer, frame=frame, path=folder / name)
