"""Text in Blender's panels, where a label is cut off instead of going on in the next line."""

from __future__ import annotations

import textwrap

import bpy

PIXELS_PER_CHARACTER = 6.6  # of the interface's font at scale 1, on average
MARGIN_PIXELS = 60.0  # panel's border, scroll bar, icon


def characters_across(context: bpy.types.Context) -> int:
    """How many characters a line of the region holds."""
    region = context.region
    width = region.width if region is not None else 300
    scale = context.preferences.system.ui_scale or 1.0  # 0 where there is no window
    return max(int((width / scale - MARGIN_PIXELS) / PIXELS_PER_CHARACTER), 16)


def draw_paragraph(layout: bpy.types.UILayout, text: str, *, width: int, icon: str = "NONE") -> None:
    """Labels that show all of a text in lines of `width` characters; the icon stands before the first."""
    lines = textwrap.wrap(text, width, break_on_hyphens=False) or [""]
    column = layout.column(align=True)
    column.scale_y = 0.8
    for number, line in enumerate(lines):
        first = icon if number == 0 else "BLANK1"
        column.label(text=line, icon="NONE" if icon == "NONE" else first)
