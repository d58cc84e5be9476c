"""The whole path as the panel takes it, in Blender's wheel: register, start, import, save, render.

    .venv/blender/bin/python tests/end_to_end/operators_on_clip.py CLIP FOLDER [--preset P] [--set path=value ...]

Needs the backend's environment beside the wheel's (python3 wildsmoke.py test makes both). Prints what it made as JSON.
"""

from __future__ import annotations

import argparse
import importlib.util
import json
import os
import sys
from pathlib import Path

CHECKOUT = Path(__file__).resolve().parents[2]


def name_checkout():
    """The checkout as the package `wildsmoke`, whatever its folder is called."""
    spec = importlib.util.spec_from_file_location(
        "wildsmoke", CHECKOUT / "__init__.py", submodule_search_locations=[str(CHECKOUT)]
    )
    module = importlib.util.module_from_spec(spec)
    sys.modules["wildsmoke"] = module
    spec.loader.exec_module(module)
    return module


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("clip", type=Path)
    parser.add_argument("folder", type=Path)
    parser.add_argument("--preset", default="draft")
    parser.add_argument("--set", action="append", default=[], metavar="section.field=value")
    options = parser.parse_args()
    os.environ.setdefault("WILDSMOKE_BACKEND_PYTHON", str(CHECKOUT / ".venv" / "backend" / "bin" / "python"))
    import bpy

    wildsmoke = name_checkout()
    bpy.ops.wm.read_factory_settings(use_empty=True)
    wildsmoke.register()
    try:
        made = run_operators(bpy, options)
    finally:
        wildsmoke.unregister()
    print(json.dumps(made))
    return 0


def run_operators(bpy, options: argparse.Namespace) -> dict:
    """Set the panel's properties, press its buttons."""
    settings = bpy.context.scene.wildsmoke
    settings.output_folder = str(options.folder.resolve())
    settings.video = str(options.clip.resolve())
    settings.preset = options.preset
    for text in options.set:
        key, _, value = text.partition("=")
        section, _, name = key.partition(".")
        group = getattr(settings.config, section)
        setattr(group, name, type(getattr(group, name))(value))
    assert bpy.ops.wildsmoke.check_backend() == {"FINISHED"}
    assert bpy.ops.wildsmoke.start() == {"FINISHED"}
    assert bpy.ops.wildsmoke.import_result() == {"FINISHED"}
    scene = bpy.context.scene
    volumes = [item for item in scene.objects if item.type == "VOLUME"]
    assert len(volumes) == 1, "importing twice must update, not duplicate"
    scene.frame_set((scene.frame_start + 2 * scene.frame_end) // 3)
    evaluated = volumes[0].evaluated_get(bpy.context.evaluated_depsgraph_get()).data
    evaluated.grids.load()
    blend, preview = options.folder / "smoke.blend", options.folder / "preview.png"
    from wildsmoke.addon.scene import preview as previews
    from wildsmoke.addon.scene import saving
    from wildsmoke.backend.contract.result import read_result

    saving.save_blend(blend)
    plate = read_result(options.folder).background_plate
    previews.render_preview(scene, preview, frame=scene.frame_current, plate=None if plate is None else options.folder / plate)
    return {
        "blender": bpy.app.version_string,
        "grids": sorted(grid.name for grid in evaluated.grids),
        "frames": [scene.frame_start, scene.frame_end],
        "blend": str(blend),
        "preview": str(preview),
    }


if __name__ == "__main__":
    sys.exit(main())
