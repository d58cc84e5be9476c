"""A finished job as a .blend and a preview picture, from the command line, with Blender's Python or the bpy wheel:

python addon/scene/build_blend.py --job DIR --blend FILE --preview PNG [--frame N] [--relight R] [--samples N]
"""

from __future__ import annotations

import argparse
import importlib
import importlib.util
import sys
from pathlib import Path

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


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(prog="build_blend", description=__doc__)
    parser.add_argument("--job", type=Path, required=True, help="folder of a finished job")
    parser.add_argument("--blend", type=Path, help="the .blend to write")
    parser.add_argument("--preview", type=Path, help="the PNG to render with Cycles")
    parser.add_argument("--frame", type=int, help="Blender's frame, from 1; nine tenths through the clip by default")
    parser.add_argument("--samples", type=int, default=16)
    parser.add_argument("--longest-side", type=int, default=0, help="px of the preview; 0: the clip's own size")
    parser.add_argument("--relight", type=float, help="0: as filmed, 1: lit by the scene")
    return parser


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
