"""Checks of the installed extension. Runs inside Blender's wheel, see conftest.py; HOME is a temporary folder."""

from __future__ import annotations

import os
import re
import sys
from pathlib import Path

import bpy

from tools import package

MODULE = "bl_ext.user_default.wildsmoke"
CHECKOUT = Path(package.__file__).resolve().parents[1]


def install(folder: Path) -> Path:
    """Build the zip and install it as a user does; gives the folder of the extension."""
    archive = package.build(CHECKOUT, folder)
    outcome = bpy.ops.extensions.package_install_files(
        filepath=str(archive), repo="user_default", enable_on_install=True, overwrite=True
    )
    assert outcome == {"FINISHED"}
    return Path(sys.modules[MODULE].__file__).parent


def check_it_installs_and_registers_twice(folder: Path) -> None:
    root = install(folder)
    assert Path(os.environ["HOME"]) in root.parents, root
    assert (root / "backend" / "requirements.txt").is_file() and (root / "LICENSE").is_file()
    assert bpy.context.scene.wildsmoke.preset == "preview"
    for _ in range(2):
        bpy.ops.preferences.addon_disable(module=MODULE)
        assert not hasattr(bpy.types.Scene, "wildsmoke")
        bpy.ops.preferences.addon_enable(module=MODULE)
        assert hasattr(bpy.types.Scene, "wildsmoke") and MODULE in bpy.context.preferences.addons
    assert not {"torch", "numba", "h5py"} & set(sys.modules)
    assert f"{MODULE}.addon.session" in sys.modules and f"{MODULE}.backend.contract.job" in sys.modules
    others = [name for name in sys.modules if re.match(rf"{re.escape(MODULE)}\.backend\.(?!contract)", name)]
    assert not others, others


def check_preferences_hold_the_backend(folder: Path) -> None:
    root = install(folder)
    chosen = bpy.context.preferences.addons[MODULE].preferences
    chosen.backend_python = str(folder / "no_such_python")
    chosen.device = "cpu"
    session = sys.modules[f"{MODULE}.addon.session"]
    assert session.backend().python == str(folder / "no_such_python")
    assert session.backend().root == root and session.default_device() == "cpu"
    settings = bpy.context.scene.wildsmoke
    settings.video, settings.output_folder = str(folder / "a.mp4"), str(folder / "job")
    said = ""
    try:
        bpy.ops.wildsmoke.start()
    except RuntimeError as error:
        said = str(error)
    assert "no_such_python, cannot be started" in said, said


def check_an_update_while_it_is_enabled(folder: Path) -> None:
    install(folder)
    install(folder)
    assert bpy.context.scene.wildsmoke.preset == "preview"
