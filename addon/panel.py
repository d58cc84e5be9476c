"""The panel in the 3D viewport's sidebar."""

from dataclasses import replace

import bpy

from ..backend.contract.decisions import Decisions
from ..backend.contract.errors import BackendError
from ..backend.contract.job import Job
from . import session
from .settings import changed_settings, fields_of, job_folder, make_job
from .status import JobStatus, Phase, headline, progress_text
from .text import characters_across, draw_paragraph

SECTIONS = (
    ("frames", "Frames"),
    ("extraction", "Smoke Layer"),
    ("cameras", "Camera"),
    ("volume", "Depth"),
    ("physical", "Motion"),
    ("visual", "Look"),
    ("published", "Published Methods"),
    ("forecast", "Forecast"),
    ("export", "Volume"),
)
BACKEND_CODES = ("backend_not_set", "backend_python_missing")  # mended in the preferences
_ICONS = {
    Phase.DONE: "CHECKMARK",
    Phase.FAILED: "ERROR",
    Phase.CRASHED: "ERROR",
    Phase.INTERRUPTED: "PAUSE",
    Phase.CANCELLED: "PAUSE",
    Phase.BUSY: "TIME",
}


class _SidebarPanel:
    bl_space_type = "VIEW_3D"
    bl_region_type = "UI"
    bl_category = "Wildsmoke"


class WILDSMOKE_PT_main(_SidebarPanel, bpy.types.Panel):
    bl_idname = "WILDSMOKE_PT_main"
    bl_label = "Wildsmoke"

    def draw(self, context: bpy.types.Context) -> None:
        settings = context.scene.wildsmoke
        supervisor = session.current.supervisor
        folder = job_folder(settings)
        status = supervisor.status(folder)
        layout = self.layout
        form = layout.column()
        form.enabled = not status.phase.is_active
        form.use_property_split = True
        form.use_property_decorate = False
        for name in ("video", "output_folder", "preset", "device"):
            form.prop(settings, name)
        form.prop(settings, "cameras_file", placeholder="optional")
        _draw_range(form, settings)
        _draw_buttons(layout, settings, status)
        running = supervisor.running_folder
        width = characters_across(context)
        if running is not None and running != folder:
            draw_paragraph(layout, f"A job is running in {running}.", width=width, icon="TIME")
        draw_status(layout, status, width=width)


def _draw_range(layout: bpy.types.UILayout, settings: bpy.types.PropertyGroup) -> None:
    layout.prop(settings, "use_frame_range")
    if settings.use_frame_range:
        row = layout.column(align=True)
        row.prop(settings, "frame_start")
        row.prop(settings, "frame_stop")


def _draw_buttons(layout: bpy.types.UILayout, settings: bpy.types.PropertyGroup, status: JobStatus) -> None:
    row = layout.row(align=True)
    row.scale_y = 1.4
    if session.current.supervisor.running_folder is not None:
        row.enabled = status.phase is not Phase.CANCELLING
        row.operator("wildsmoke.cancel", icon="CANCEL")
        return
    is_resume = status.phase in (Phase.INTERRUPTED, Phase.CANCELLED, Phase.CRASHED)
    start = row.row(align=True)
    start.enabled = status.phase is not Phase.BUSY
    start.operator("wildsmoke.start", text="Resume" if is_resume else "Start", icon="PLAY")
    importing = row.row(align=True)
    importing.enabled = status.phase is Phase.DONE
    importing.operator("wildsmoke.import_result", icon="IMPORT")
    layout.prop(settings, "import_when_done")


def draw_status(layout: bpy.types.UILayout, status: JobStatus, *, width: int) -> None:
    """Progress, and what the user should know. width: characters in a line."""
    if status.phase is Phase.NONE:
        return
    box = layout.box().column(align=True)
    box.label(text=headline(status), icon=_ICONS.get(status.phase, "SORTTIME"))
    if status.phase.is_active:
        box.progress(factor=status.fraction, type="BAR", text=progress_text(status))
    is_bad = status.phase in (Phase.FAILED, Phase.CRASHED)
    for text, icon in ((status.message, "NONE"), (status.hint, "INFO" if is_bad else "NONE")):
        if text:
            draw_paragraph(box, text, width=width, icon=icon)
    if status.code in BACKEND_CODES:
        box.operator("wildsmoke.open_preferences", icon="PREFERENCES")
    elif status.phase is Phase.CRASHED:
        box.operator("wildsmoke.open_log", icon="TEXT")
    for warning in status.warnings:
        draw_paragraph(box, warning, width=width, icon="INFO")


class WILDSMOKE_PT_outlook(_SidebarPanel, bpy.types.Panel):
    bl_idname = "WILDSMOKE_PT_outlook"
    bl_parent_id = "WILDSMOKE_PT_main"
    bl_label = "What to Expect"

    def draw(self, context: bpy.types.Context) -> None:
        settings, current = context.scene.wildsmoke, session.current
        layout, width = self.layout, characters_across(context)
        is_looking = current.clip_look is not None
        row = layout.row()
        row.enabled = not is_looking
        row.operator("wildsmoke.inspect_clip", text="Looking at the clip..." if is_looking else "Estimate", icon="TIME")
        look = current.look
        if look is not None and look.problem:
            draw_paragraph(layout, look.problem, width=width, icon="ERROR")
        decisions = current.supervisor.decisions(job_folder(settings))
        if look is not None and look.outlook is not None:
            box = layout.box().column(align=True)
            if not _is_of(look.job, settings):
                draw_paragraph(box, "Clip or settings have changed since.", width=width, icon="INFO")
            for item in look.outlook.estimates:
                icon = "RADIOBUT_ON" if item.preset == settings.preset else "RADIOBUT_OFF"
                text = item.to_text()
                draw_paragraph(box, text[:1].upper() + text[1:], width=width, icon=icon)
            decisions = look.outlook.decisions
        if decisions is not None:
            draw_decisions(layout, decisions, width=width)


def _is_of(job: Job, settings: bpy.types.PropertyGroup) -> bool:
    """Whether a look is still true. The preset may be another: all of them were looked at."""
    try:
        wanted = make_job(settings, device=job.device)
    except BackendError:
        return False
    return replace(wanted, preset=job.preset, device=job.device) == job


def draw_decisions(layout: bpy.types.UILayout, decisions: Decisions, *, width: int) -> None:
    """What the clip requires, one decision a paragraph. width: characters in a line."""
    box = layout.box().column(align=True)
    box.label(text="What the clip requires", icon="VIEWZOOM")
    for decision in decisions.decisions:
        name = decision.name.replace("_", " ").capitalize()
        icon = "MODIFIER" if decision.is_overridden else "DOT"
        draw_paragraph(box, f"{name}: {decision.value}. {decision.reason}", width=width, icon=icon)
    for warning in decisions.warnings:
        draw_paragraph(box, warning.message, width=width, icon="ERROR")


class WILDSMOKE_PT_settings(_SidebarPanel, bpy.types.Panel):
    bl_idname = "WILDSMOKE_PT_settings"
    bl_parent_id = "WILDSMOKE_PT_main"
    bl_label = "More Settings"
    bl_options = {"DEFAULT_CLOSED"}

    def draw(self, context: bpy.types.Context) -> None:
        settings = context.scene.wildsmoke
        layout = self.layout
        layout.use_property_split = True
        layout.use_property_decorate = False
        layout.enabled = not session.current.supervisor.status(job_folder(settings)).phase.is_active
        changed = changed_settings(settings.config, settings.preset)
        if changed:
            row = layout.row()
            row.label(text=f"{len(changed)} changed from {settings.preset.capitalize()}", icon="MODIFIER")
            row.operator("wildsmoke.reset_settings", text="", icon="LOOP_BACK")
        layout.prop(settings.config, "follow_clip")
        layout.prop(settings.config, "method")
        layout.prop(settings.config, "seed")


def _draw_section(self: bpy.types.Panel, context: bpy.types.Context) -> None:
    settings = context.scene.wildsmoke
    layout = self.layout
    layout.use_property_split = True
    layout.use_property_decorate = False
    layout.enabled = not session.current.supervisor.status(job_folder(settings)).phase.is_active
    group = getattr(settings.config, self.section)
    for name in fields_of(self.section):
        layout.prop(group, name)


def _section_panel(section: str, label: str) -> type:
    return type(
        f"WILDSMOKE_PT_{section}",
        (_SidebarPanel, bpy.types.Panel),
        {
            "bl_idname": f"WILDSMOKE_PT_{section}",
            "bl_parent_id": "WILDSMOKE_PT_settings",
            "bl_label": label,
            "bl_options": {"DEFAULT_CLOSED"},
            "section": section,
            "draw": _draw_section,
        },
    )


class WILDSMOKE_PT_log(_SidebarPanel, bpy.types.Panel):
    bl_idname = "WILDSMOKE_PT_log"
    bl_parent_id = "WILDSMOKE_PT_main"
    bl_label = "Log"
    bl_options = {"DEFAULT_CLOSED"}

    def draw(self, context: bpy.types.Context) -> None:
        lines = session.current.supervisor.log_lines(job_folder(context.scene.wildsmoke))
        column = self.layout.column(align=True)
        column.scale_y = 0.75
        for line in lines or ["Nothing yet"]:
            column.label(text=line)
        self.layout.operator("wildsmoke.open_log", icon="TEXT")


CLASSES = (
    WILDSMOKE_PT_main,
    WILDSMOKE_PT_outlook,
    WILDSMOKE_PT_settings,
    *(_section_panel(section, label) for section, label in SECTIONS),
    WILDSMOKE_PT_log,
)
