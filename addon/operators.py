"""The operators: thin, so that all they do can also be called and tested without them.

In background mode each runs to its end and says on standard output what happens, so that it can be scripted.
"""

from pathlib import Path

import bpy

from ..backend.contract import events
from ..backend.contract.errors import BackendError
from ..backend.contract.result import LOG_FILE, read_result
from . import session
from .settings import job_folder, make_job, set_config
from .status import Phase

_NO_FOLDER = BackendError(
    "no_output_folder",
    "There is no output folder.",
    hint="Choose one; a path that starts with // needs the .blend to be saved first.",
)


def _folder_of(context: bpy.types.Context) -> Path:
    folder = job_folder(context.scene.wildsmoke)
    if folder is None:
        raise _NO_FOLDER
    return folder


class WILDSMOKE_OT_start(bpy.types.Operator):
    """Reconstruct the smoke of the clip in a process of its own. A job that was interrupted resumes"""

    bl_idname = "wildsmoke.start"
    bl_label = "Start"

    @classmethod
    def poll(cls, context: bpy.types.Context) -> bool:
        return session.current.supervisor.running_folder is None

    def execute(self, context: bpy.types.Context) -> set[str]:
        supervisor = session.current.supervisor
        try:
            folder = _folder_of(context)
            job = make_job(context.scene.wildsmoke, device=session.default_device())
            supervisor.start(session.backend(), folder, job)
        except BackendError as error:
            self.report({"ERROR"}, str(error))
            return {"CANCELLED"}
        if not bpy.app.background:
            session.start_ticking()
            return {"FINISHED"}
        return self._wait(context, folder)

    def _wait(self, context: bpy.types.Context, folder: Path) -> set[str]:
        supervisor = session.current.supervisor
        status = supervisor.run_to_end(_print_event)
        supervisor.take_finished()
        if status.phase is not Phase.DONE:
            self.report({"ERROR"}, f"{status.message or 'Cancelled.'} {status.hint}".strip())
            return {"CANCELLED"}
        if context.scene.wildsmoke.import_when_done:
            return _import(self, context.scene, folder)
        return {"FINISHED"}


def _print_event(event: events.Event) -> None:
    """For whoever watches a script: everything but the steps."""
    if not isinstance(event, events.Progress):
        print(f"wildsmoke: {events.encode(event)}", flush=True)


def _import(operator: bpy.types.Operator, scene: bpy.types.Scene, folder: Path) -> set[str]:
    try:
        made = session.import_into(scene, folder)
    except BackendError as error:
        session.current.supervisor.note(folder, error)
        operator.report({"ERROR"}, str(error))
        return {"CANCELLED"}
    operator.report({"INFO"}, f"Imported {made.name}")
    return {"FINISHED"}


class WILDSMOKE_OT_inspect_clip(bpy.types.Operator):
    """Look at the clip: what it requires, and what each preset will take in minutes and memory. Nothing is fitted"""

    bl_idname = "wildsmoke.inspect_clip"
    bl_label = "Estimate"

    @classmethod
    def poll(cls, context: bpy.types.Context) -> bool:
        return session.current.clip_look is None

    def execute(self, context: bpy.types.Context) -> set[str]:
        current = session.current
        try:
            session.start_look(make_job(context.scene.wildsmoke, device=session.default_device()))
        except BackendError as error:
            self.report({"ERROR"}, str(error))
            return {"CANCELLED"}
        if not bpy.app.background:
            session.start_ticking()
            return {"FINISHED"}
        current.look, current.clip_look = current.clip_look.wait(), None
        if current.look.outlook is None:
            self.report({"ERROR"}, current.look.problem)
            return {"CANCELLED"}
        print(current.look.outlook.to_text())
        return {"FINISHED"}


class WILDSMOKE_OT_cancel(bpy.types.Operator):
    """Stop the running job. What it has computed is kept, and Start resumes it"""

    bl_idname = "wildsmoke.cancel"
    bl_label = "Cancel"

    def execute(self, context: bpy.types.Context) -> set[str]:
        if not session.current.supervisor.cancel():
            self.report({"INFO"}, "No job is running")
            return {"CANCELLED"}
        return {"FINISHED"}


class WILDSMOKE_OT_import_result(bpy.types.Operator):
    """Bring the finished smoke into the scene as an animated volume with its material and camera"""

    bl_idname = "wildsmoke.import_result"
    bl_label = "Import"

    def execute(self, context: bpy.types.Context) -> set[str]:
        try:
            folder = _folder_of(context)
            read_result(folder)
        except BackendError as error:
            self.report({"ERROR"}, str(error))
            return {"CANCELLED"}
        return _import(self, context.scene, folder)


class WILDSMOKE_OT_check_backend(bpy.types.Operator):
    """Look for the backend's Python and its packages, and say what is missing"""

    bl_idname = "wildsmoke.check_backend"
    bl_label = "Check Backend"

    def execute(self, context: bpy.types.Context) -> set[str]:
        session.start_check()
        current = session.current
        if not bpy.app.background:
            session.start_ticking()
            return {"FINISHED"}
        if current.check is not None:
            current.finding, current.check = current.check.wait(), None
        finding = current.finding
        for is_good, sentence in finding.lines:
            print(f"wildsmoke: {'' if is_good else '! '}{sentence}")
        if not finding.is_usable:
            problem = next(sentence for is_good, sentence in finding.lines if not is_good)
            self.report({"ERROR"}, "\n".join((f"{problem.rstrip('.')}. In a terminal, type:", *finding.commands)))
            return {"CANCELLED"}
        return {"FINISHED"}


class WILDSMOKE_OT_copy_commands(bpy.types.Operator):
    """Copy the commands that set up the backend, to paste into a terminal"""

    bl_idname = "wildsmoke.copy_commands"
    bl_label = "Copy Commands"

    @classmethod
    def poll(cls, context: bpy.types.Context) -> bool:
        finding = session.current.finding
        return finding is not None and bool(finding.commands)

    def execute(self, context: bpy.types.Context) -> set[str]:
        context.window_manager.clipboard = "\n".join(session.current.finding.commands) + "\n"
        self.report({"INFO"}, "Copied; paste them into a terminal")
        return {"FINISHED"}


class WILDSMOKE_OT_open_log(bpy.types.Operator):
    """Open the job's whole log with the system's text viewer"""

    bl_idname = "wildsmoke.open_log"
    bl_label = "Open Log"

    def execute(self, context: bpy.types.Context) -> set[str]:
        folder = job_folder(context.scene.wildsmoke)
        if folder is None or not (folder / LOG_FILE).is_file():
            self.report({"INFO"}, "There is no log yet")
            return {"CANCELLED"}
        if bpy.app.background:
            print((folder / LOG_FILE).read_text(encoding="utf-8", errors="replace"))
            return {"FINISHED"}
        return bpy.ops.wm.path_open(filepath=str(folder / LOG_FILE))


class WILDSMOKE_OT_reset_settings(bpy.types.Operator):
    """Give every setting the value of the preset again"""

    bl_idname = "wildsmoke.reset_settings"
    bl_label = "Reset to Preset"
    bl_options = {"REGISTER", "UNDO"}

    def execute(self, context: bpy.types.Context) -> set[str]:
        from ..backend.contract.job import preset_config

        settings = context.scene.wildsmoke
        set_config(settings.config, preset_config(settings.preset))
        return {"FINISHED"}


class WILDSMOKE_OT_open_preferences(bpy.types.Operator):
    """Show the add-on's preferences, where the backend is set up"""

    bl_idname = "wildsmoke.open_preferences"
    bl_label = "Set Up Backend"

    def execute(self, context: bpy.types.Context) -> set[str]:
        return bpy.ops.preferences.addon_show(module=session.PACKAGE)


CLASSES = (
    WILDSMOKE_OT_start,
    WILDSMOKE_OT_inspect_clip,
    WILDSMOKE_OT_cancel,
    WILDSMOKE_OT_import_result,
    WILDSMOKE_OT_check_backend,
    WILDSMOKE_OT_copy_commands,
    WILDSMOKE_OT_open_log,
    WILDSMOKE_OT_reset_settings,
    WILDSMOKE_OT_open_preferences,
)
