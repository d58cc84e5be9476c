"""Makes the add-on's classes known to Blender, and takes them back."""

from __future__ import annotations

import bpy

from . import operators, panel, preferences, session, settings

_CLASSES = (*settings.CLASSES, *preferences.CLASSES, *operators.CLASSES, *panel.CLASSES)


def register() -> None:
    for made in _CLASSES:
        bpy.utils.register_class(made)
    bpy.types.Scene.wildsmoke = bpy.props.PointerProperty(type=settings.WILDSMOKE_PG_settings)
    session.register()


def unregister() -> None:
    session.unregister()
    del bpy.types.Scene.wildsmoke
    for made in reversed(_CLASSES):
        bpy.utils.unregister_class(made)
