"""A finished job as a .blend and pictures by Cycles, from the command line, with Blender's Python or the bpy wheel:

python addon/scene/build_blend.py --job DIR --blend FILE --preview PNG [--frame N] [--relight R] [--samples N]
python addon/scene/build_blend.py --job DIR --layers DIR --layer-frames 1,40,80        the smoke alone, for measurements
"""

from __future__ import annotations

import argparse
import importlib
import importlib.util
import os
import sys
from pathlib import Path
from typing import Any

PACKAGE = "wildsmoke"


def main(arguments: list[str] | None = None) -> int:
    """Exit codes: 0 done, 2 the user can act."""
    options = _parser().parse_args(_own_arguments() if arguments is None else arguments)
    _name_checkout()
    errors = importlib.import_module(f"{PACKAGE}.backend.contract.errors")
    try:
        _build(options)
    except errors.BackendError as error:
        print(f"wildsmoke: {error}", file=sys.stderr)
        return errors.EXIT_USER
    return 0


def _build(options: argparse.Namespace) -> None:
    import bpy

    scene_package = importlib.import_module(f"{PACKAGE}.addon.scene")
    saving = importlib.import_module(f"{PACKAGE}.addon.scene.saving")
    preview = importlib.import_module(f"{PACKAGE}.addon.scene.preview")
    result = importlib.import_module(f"{PACKAGE}.backend.contract.result").read_result(options.job)
    bpy.ops.wm.read_factory_settings(use_empty=True)
    scene = bpy.context.scene
    smoke = scene_package.import_result(options.job, scene=scene)
    if options.relight is not None:
        smoke.data.materials[0].node_tree.nodes["Wildsmoke Smoke"].inputs["Relight"].default_value = options.relight
    frame = options.frame if options.frame is not None else scene.frame_start + (9 * result.num_frames) // 10
    scene.frame_set(min(max(frame, scene.frame_start), scene.frame_end))
    if options.blend is not None:
        saving.save_blend(options.blend)
    if options.preview is not None:
        plate = None if result.background_plate is None else options.job / result.background_plate
        preview.render_preview(
            scene,
            options.preview,
            frame=scene.frame_current,
            samples=options.samples,
            longest_side=options.longest_side,
            plate=plate,
        )
    if options.layers is not None:
        print(f"blender {bpy.app.version_string}", flush=True)
        options.layers.mkdir(parents=True, exist_ok=True)
        for number in options.layer_frames:
            path = options.layers / f"{number:04d}.npy"
            if not path.exists():
                _keep_layer(path, preview.render_layer, scene, options, number)
            print(f"layer {number}", flush=True)


def _keep_layer(path: Path, render_layer: Any, scene: Any, options: argparse.Namespace, number: int) -> None:
    """[H, W, 4] float32 linear premultiplied as a NumPy file, whole or not at all: who asks again goes on behind it."""
    import numpy as np

    layer = render_layer(scene, frame=number, samples=options.samples, longest_side=options.longest_side)
    part = path.with_name(path.name + ".part")
    with open(part, "wb") as file:
        np.save(file, layer)
    os.replace(part, path)


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(prog="build_blend", description=__doc__)
    parser.add_argument("--job", type=Path, required=True, help="folder of a finished job")
    parser.add_argument("--blend", type=Path, help="the .blend to write")
    parser.add_argument("--preview", type=Path, help="the PNG to render with Cycles")
    parser.add_argument("--frame", type=int, help="Blender's frame, from 1; nine tenths through the clip by default")
    parser.add_argument("--samples", type=int, default=16)
    parser.add_argument("--longest-side", type=int, default=0, help="px of the preview; 0: the clip's own size")
    parser.add_argument("--layers", type=Path, help="a folder for the smoke alone, %%04d.npy by Blender's frame")
    parser.add_argument("--layer-frames", type=_numbers, default=[], help="Blender's frames, from 1, such as 1,40,80")
    parser.add_argument("--relight", type=float, help="0: as filmed, 1: lit by the scene")
    return parser


def _numbers(text: str) -> list[int]:
    return [int(part) for part in text.split(",")]


def _own_arguments() -> list[str]:
    """After `--` where Blender runs this (blender -b --python build_blend.py -- ...), else all."""
    return sys.argv[sys.argv.index("--") + 1 :] if "--" in sys.argv else sys.argv[1:]


def _name_checkout() -> None:
    """Make the checkout importable as a package, whatever its folder is called, so that relative imports work."""
    if PACKAGE in sys.modules:
        return
    root = Path(__file__).resolve().parents[2]
    spec = importlib.util.spec_from_file_location(PACKAGE, root / "__init__.py", submodule_search_locations=[str(root)])
    if spec is None or spec.loader is None:
        raise ImportError(f"{root} is no checkout")
    module = importlib.util.module_from_spec(spec)
    sys.modules[PACKAGE] = module
    spec.loader.exec_module(module)


if __name__ == "__main__":
    sys.exit(main())
