"""A .blend beside its job, with paths relative to it, so that the folder can be moved as a whole."""

from __future__ import annotations

import os
from pathlib import Path

import bpy

from .ownership import relative_paths


def save_blend(path: str | os.PathLike[str]) -> None:
    """Save the open file under `path`, whole or not at all."""
    target = Path(path).resolve()
    target.parent.mkdir(parents=True, exist_ok=True)
    relative_paths(target.parent)
    # Blender itself writes beside and renames; without remapping, the paths made relative above stay as they are.
    bpy.ops.wm.save_as_mainfile(filepath=str(target), relative_remap=False, check_existing=False)
