# Without `from __future__ import annotations`: Blender takes the annotations themselves, not their text.
"""The add-on's preferences: where the backend is, and whether it is any good."""

import bpy
from bpy.props import EnumProperty, StringProperty

from . import session
from .settings import DEVICE_ITEMS
from .text import characters_across, draw_paragraph


class WildsmokePreferences(bpy.types.AddonPreferences):
    bl_idname = session.PACKAGE

    backend_python: StringProperty(
        name="Backend's Python",
        description="The Python, or the folder of the virtual environment, that has the backend's packages. "
        "Empty: the environment in your home folder's wildsmoke-backend",
        subtype="FILE_PATH",
    )
    device: EnumProperty(name="Device", description="What to compute on", items=DEVICE_ITEMS, default="auto")

    def draw(self, context: bpy.types.Context) -> None:
        layout = self.layout
        layout.use_property_split = True
        layout.prop(self, "backend_python")
        layout.prop(self, "device")
        is_checking = session.current.check is not None
        row = layout.row()
        row.enabled = not is_checking
        row.operator("wildsmoke.check_backend", text="Checking..." if is_checking else "Check Backend", icon="VIEWZOOM")
        if session.current.finding is not None:
            draw_finding(layout, session.current.finding, width=characters_across(context))


def draw_finding(layout: bpy.types.UILayout, finding: session.Finding, *, width: int) -> None:
    """What the check found and, if something lacks, exactly what to type. width: characters in a line."""
    box = layout.box().column(align=True)
    verdict = "The backend is ready" if finding.is_usable else "The backend cannot run yet"
    box.label(text=verdict, icon="CHECKMARK" if finding.is_usable else "ERROR")
    for is_good, sentence in finding.lines:
        draw_paragraph(box, sentence, width=width, icon="DOT" if is_good else "ERROR")
    if finding.commands:
        box.separator()
        draw_paragraph(box, "In a terminal, type (some gigabytes are downloaded):", width=width)
        for command in finding.commands:
            draw_paragraph(box, command, width=width, icon="CONSOLE")
        draw_paragraph(box, "Then press Check Backend again.", width=width)
        box.operator("wildsmoke.copy_commands", icon="COPYDOWN")


CLASSES = (WildsmokePreferences,)
