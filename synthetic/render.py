"""Renders a benchmark scene with Cycles. Runs inside Blender, in the bpy wheel or in a real binary:

    blender -b --python synthetic/render.py -- SCENE --out DIR [--preset bench] [--frames A:B] ...
    .venv/blender/bin/python synthetic/render.py SCENE --out DIR ...

The smoke must lie in DIR/smoke (`python3 wildsmoke.py synth simulate`) or in a folder of VDB files given by --smoke.
Images that exist are kept, so a broken run goes on where it stopped; several workers may share DIR.
"""

from __future__ import annotations

import argparse
import json
import platform
import sys
import time
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

if __name__ == "__main__":
    sys.path.insert(0, str(Path(__file__).resolve().parents[1]))

import bpy

from backend.contract.errors import EXIT_DONE, EXIT_USER, BackendError
from backend.contract.result import CAMERAS_FILE, vdb_path
from backend.contract.truth import view_folder
from synthetic.claims import claimed, write_once
from synthetic.layers import Layer
from synthetic.plan import (
    SMOKE_FOLDER,
    Image,
    first_frames,
    plan_images,
    plan_shipped,
    view_cameras,
)
from synthetic.presets import PRESETS, Preset
from synthetic.progress import Progress, duration
from synthetic.scene.camera import set_camera
from synthetic.scene.cycles import render_image, set_quality
from synthetic.scene.landscape import build_landscape
from synthetic.scene.light import add_black_world, add_light
from synthetic.scene.smoke import show_smoke
from synthetic.scenes import SCENES

RENDER_FILE = "render.json"
_FORMAT_VERSION = 1


@dataclass(frozen=True, slots=True, kw_only=True)
class RenderOrder:
    """What to render. frames: start and stop, or all; views: of "input", "nvs", "side", "back", or all.

    smoke_folder: VDB files in order of name, by default DIR/smoke; blend_file: a static scene in place of ours;
    only_shipped: only the images of the set that ships; seed: of the noise, by default the scene's; wait_seconds: how long
    to wait for a smoke file that a simulation at work has not written yet.
    """

    scene: str
    folder: Path
    preset: Preset
    preset_name: str
    frames: tuple[int, int] | None = None
    views: tuple[str, ...] | None = None
    smoke_folder: Path | None = None
    blend_file: Path | None = None
    only_shipped: bool = False
    seed: int | None = None
    wait_seconds: float = 0.0


def render_set(order: RenderOrder) -> int:
    """Render all images that are missing. Returns how many others are still at work on. Raises BackendError."""
    if order.scene not in SCENES:
        raise BackendError("unknown_scene", f'There is no scene "{order.scene}".', hint=f"Choose one of {', '.join(SCENES)}.")
    smoke = _SmokeFiles(order)
    images = _ordered(order)
    _prepare_folders(order, images)
    build_scene(order)
    missing = [image for image in images if not (order.folder / image.path).exists()]
    progress = Progress(label=f"render {order.scene}", total=len(images), done=len(images) - len(missing))
    samples = {frame: [] for frame in first_frames(*_frame_range(order))}
    for index, image in enumerate(missing):
        seconds = _render_one(order, image, smoke)
        progress.step(is_made=seconds is not None)
        if image.frame in samples and seconds is not None:
            samples[image.frame].append(seconds)
        is_estimated = index + 1 < len(missing) and image.frame in samples and missing[index + 1].frame not in samples
        if is_estimated and any(samples.values()):
            made = [value for values in samples.values() for value in values]
            _say_cost(sum(made) / len(made), len(missing) - index - 1)
    return sum(not (order.folder / image.path).exists() for image in images)


def build_scene(order: RenderOrder) -> None:
    """The static scene, its light and the render settings."""
    if order.blend_file is None:
        bpy.ops.wm.read_factory_settings(use_empty=True)
        build_landscape(SCENES[order.scene])
        add_light()
    else:
        if not order.blend_file.is_file():
            raise BackendError("scene_missing", f"There is no file {order.blend_file}.", hint="Give a .blend file.")
        bpy.ops.wm.open_mainfile(filepath=str(order.blend_file))
        if bpy.context.scene.world is None:
            add_black_world()
    # One seed for all frames: what does not change looks the same in all of them, noise included.
    set_quality(order.preset.quality, seed=_seed(order))


def _seed(order: RenderOrder) -> int:
    return SCENES[order.scene].seed if order.seed is None else order.seed


def _render_one(order: RenderOrder, image: Image, smoke: _SmokeFiles) -> float | None:
    """Seconds that the image took; None where it was not ours to make."""
    target = order.folder / image.path
    with claimed(target) as is_ours:
        if not is_ours:
            return None
        for left_behind in target.parent.glob(f"{target.name}.*.part*"):  # by a worker that was killed
            left_behind.unlink()
        begin = time.monotonic()
        has_smoke = image.layer in (Layer.CLIP, Layer.SMOKE)
        show_smoke(smoke.path(image.frame) if has_smoke else None, albedo=SCENES[order.scene].albedo)
        set_camera(view_cameras(order.preset)[image.view], image.frame)
        render_image(target, image.layer)
        return time.monotonic() - begin


class _SmokeFiles:
    """The VDB file of each frame."""

    def __init__(self, order: RenderOrder) -> None:
        self._folder = order.smoke_folder or order.folder / SMOKE_FOLDER
        self._wait = order.wait_seconds
        self._files: list[Path] | None = None
        if order.smoke_folder is not None:
            self._files = sorted(self._folder.glob("*.vdb"))
            if len(self._files) < order.preset.num_frames:
                raise BackendError(
                    "smoke_too_short",
                    f"{self._folder} holds {len(self._files)} VDB files for {order.preset.num_frames} frames.",
                    hint="Give a folder with one VDB file for each frame.",
                )

    def path(self, frame: int) -> Path:
        if self._files is not None:
            return self._files[frame]
        path = vdb_path(self._folder, frame)
        end = time.monotonic() + self._wait
        while not path.exists():
            if time.monotonic() >= end:
                raise BackendError(
                    "smoke_missing", f"There is no smoke file {path}.", hint="Run `synth simulate` with the same --out first."
                )
            time.sleep(1.0)
        return path


def _ordered(order: RenderOrder) -> list[Image]:
    """The images of the order; those of the first frames come first."""
    unknown = set(order.views or ()) - set(order.preset.views)
    if unknown:
        raise BackendError(
            "unknown_view",
            f'The preset has no view "{sorted(unknown)[0]}".',
            hint=f"Choose of {', '.join(order.preset.views)}.",
        )
    start, stop = _frame_range(order)
    images = plan_images(order.preset, views=order.views)
    if order.only_shipped:
        shipped = set(plan_shipped(order.preset))
        images = [image for image in images if image in shipped]
    images = [image for image in images if start <= image.frame < stop]
    early = set(first_frames(start, stop))
    return sorted(images, key=lambda image: image.frame not in early)


def _frame_range(order: RenderOrder) -> tuple[int, int]:
    """First frame, and one past the last."""
    start, stop = order.frames or (0, order.preset.num_frames)
    if not 0 <= start < stop <= order.preset.num_frames:
        raise BackendError(
            "bad_frame_range",
            f"The frame range {start}:{stop} does not fit a clip of {order.preset.num_frames} frames.",
            hint="Give A:B with 0 <= A < B.",
        )
    return start, stop


def _prepare_folders(order: RenderOrder, images: Sequence[Image]) -> None:
    """Folders, cameras, and render.json, which must be the same in every run on this folder."""
    for folder in {(order.folder / image.path).parent for image in images}:
        folder.mkdir(parents=True, exist_ok=True)
    for view, cameras in view_cameras(order.preset).items():
        if order.views is None or view in order.views:
            write_once(order.folder / view_folder(view) / CAMERAS_FILE, cameras.to_json())
    text = json.dumps(describe(order), indent=2, sort_keys=True)
    if write_once(order.folder / RENDER_FILE, text) != text:
        raise BackendError(
            "other_render",
            f"{order.folder} holds images of other settings or another Blender.",
            hint=f"Choose another folder, or remove it; {RENDER_FILE} in it says how it was made.",
        )


def describe(order: RenderOrder) -> dict[str, object]:
    """Everything that decides the images, for render.json."""
    quality = order.preset.quality
    return {
        "format_version": _FORMAT_VERSION,
        "scene": order.scene,
        "preset": order.preset_name,
        "blender": bpy.app.version_string,
        "machine": platform.machine(),
        "seed": _seed(order),
        "albedo": SCENES[order.scene].albedo,
        "quality": {name: getattr(quality, name) for name in quality.__slots__ if name != "threads"},
        "own_smoke": order.smoke_folder is not None,
        "own_scene": order.blend_file.name if order.blend_file else None,
    }


def _say_cost(mean: float, num_left: int) -> None:
    print(
        f"estimate: {mean:.1f} s an image, {num_left} images left, about {duration(mean * num_left)} for one worker like this.",
        file=sys.stderr,
        flush=True,
    )


def parse_arguments(arguments: Sequence[str]) -> RenderOrder:
    """The order that a command line gives."""
    parser = argparse.ArgumentParser(prog="synthetic render", description="Render a benchmark scene with Cycles.")
    parser.add_argument("scene", help=f"one of {', '.join(SCENES)}")
    parser.add_argument("--out", type=Path, required=True, help="folder of this scene")
    parser.add_argument("--preset", choices=sorted(PRESETS), default="bench")
    parser.add_argument("--frames", help="A:B, frames A to B-1 only")
    parser.add_argument("--views", help="comma-separated, of input,nvs,side,back; by default all")
    parser.add_argument("--smoke", type=Path, help="folder of VDB files in place of DIR/smoke")
    parser.add_argument("--scene-file", "--scene", type=Path, help="a .blend in place of our scene")
    parser.add_argument("--shipped", action="store_true", help="only the images of the set that ships")
    parser.add_argument("--samples", type=int, help="in place of the preset's")
    parser.add_argument("--seed", type=int, help="of the noise, in place of the scene's")
    parser.add_argument("--plain", action="store_true", help="leave the noise in")
    parser.add_argument("--threads", type=int, default=0, help="0: all cores")
    parser.add_argument("--wait", type=float, default=0.0, help="seconds to wait for smoke that is still being simulated")
    given = parser.parse_args(list(arguments))
    preset = PRESETS[given.preset]
    quality = replace(preset.quality, threads=given.threads, samples=given.samples or preset.quality.samples)
    quality = replace(quality, is_denoised=quality.is_denoised and not given.plain)
    return RenderOrder(
        scene=given.scene,
        folder=given.out.absolute(),
        preset=replace(preset, quality=quality),
        preset_name=given.preset,
        frames=parse_frames(given.frames) if given.frames else None,
        views=tuple(given.views.split(",")) if given.views else None,
        smoke_folder=given.smoke.absolute() if given.smoke else None,
        blend_file=given.scene_file.absolute() if given.scene_file else None,
        only_shipped=given.shipped,
        seed=given.seed,
        wait_seconds=given.wait,
    )


def parse_frames(text: str) -> tuple[int, int]:
    """A:B."""
    start, colon, stop = text.partition(":")
    if not (colon and start.isdigit() and stop.isdigit()):
        raise BackendError("bad_frame_range", f'"{text}" is no frame range.', hint="Give A:B, for example 0:45.")
    return int(start), int(stop)


def main(arguments: Sequence[str]) -> int:
    try:
        others = render_set(parse_arguments(arguments))
    except BackendError as error:
        print(f"synthetic: {error}", file=sys.stderr)
        return EXIT_USER
    if others:
        print(f"{others} images are being made by other workers.", file=sys.stderr)
    return EXIT_DONE


if __name__ == "__main__":
    sys.exit(main(sys.argv[sys.argv.index("--") + 1 :] if "--" in sys.argv else sys.argv[1:]))
