"""This Blender's jobs and checks, tied to Blender: the timer, the handlers, the redraws.

The only module-wide state of the add-on. bpy is touched on the main thread only: the timer and the handlers run there.
"""

from __future__ import annotations

import atexit
import importlib.util
import os
import sys
from pathlib import Path

import bpy
from bpy.app.handlers import persistent

from ..backend.contract.errors import BackendError
from ..backend.contract.job import Job
from .backend_check import BackendCheck, Finding, find_python, python_for_set_up, set_up_commands
from .clip_look import ClipLook, Look
from .job_runner import Backend
from .supervisor import Supervisor

ROOT = Path(__file__).resolve().parents[1]  # holds backend/
PACKAGE = __package__.rpartition(".")[0]
TICK_SECONDS = 0.1
_REDRAWN_REGIONS = (("VIEW_3D", "UI"), ("PREFERENCES", "WINDOW"))  # not the viewport itself: a heavy scene takes its time


class Session:
    """What the panel and the operators share."""

    def __init__(self) -> None:
        self.supervisor = Supervisor()
        self.check: BackendCheck | None = None
        self.finding: Finding | None = None
        self.clip_look: ClipLook | None = None
        self.look: Look | None = None

    def close(self) -> None:
        """End everything that runs."""
        self.supervisor.close()
        if self.check is not None:
            self.check.close()
        if self.clip_look is not None:
            self.clip_look.close()
        self.check = self.finding = self.clip_look = self.look = None


current = Session()


def preferences() -> bpy.types.AddonPreferences | None:
    """The add-on's preferences; None where it was registered without being enabled, as scripts do."""
    addon = bpy.context.preferences.addons.get(PACKAGE)
    return addon.preferences if addon is not None else None


def backend() -> Backend:
    """The backend to launch. Raises BackendError if there is no Python for it."""
    chosen = preferences()
    python = find_python(chosen.backend_python if chosen else "", home=Path.home(), variables=os.environ)
    return Backend(python=python, root=ROOT, variables=openvdb_variables())


def openvdb_variables() -> dict[str, str]:
    """Where Blender has its OpenVDB module, and a Python that fits it: the backend's environment has none of its own."""
    before = list(sys.path)
    bpy.utils.expose_bundled_modules()  # Blender as a module keeps it off the search path
    try:
        found = importlib.util.find_spec("openvdb")
    finally:
        sys.path[:] = before
    variables = {"WILDSMOKE_VDB_PYTHON": sys.executable}
    if found is not None and found.origin is not None:
        origin = Path(found.origin)
        is_package = origin.name == "__init__.py"
        variables["WILDSMOKE_OPENVDB_PATH"] = str(origin.parents[1] if is_package else origin.parent)
    return variables


def default_device() -> str:
    chosen = preferences()
    return chosen.device if chosen else "auto"


def start_check() -> None:
    """Begin to look at the backend. Without any Python for it, the finding is there at once."""
    if current.check is not None:
        current.check.close()
    commands = set_up_commands(ROOT, python=python_for_set_up(), home=Path.home())
    current.finding = None
    try:
        current.check = BackendCheck(backend().python, ROOT, commands=commands)
    except BackendError as error:
        current.check = None
        current.finding = Finding(is_usable=False, lines=((False, error.message),), commands=commands)


def start_look(job: Job) -> None:
    """Begin to look at a clip. Raises BackendError where there is no backend."""
    if current.clip_look is not None:
        current.clip_look.close()
    current.look = current.clip_look = None
    current.clip_look = ClipLook(backend(), job)


def look(folder: Path | None) -> None:
    """See what a job folder holds, and follow it if somebody works there."""
    if folder is not None:
        current.supervisor.look(folder)
        if current.supervisor.needs_ticks:
            start_ticking()


def start_ticking() -> None:
    """Follow what runs. In background mode nothing fires timers: the operators wait instead."""
    if not bpy.app.background and not bpy.app.timers.is_registered(tick):
        bpy.app.timers.register(tick, first_interval=TICK_SECONDS, persistent=True)


def tick() -> float | None:
    """Of the timer: take in events, import what is finished, redraw what changed. None ends the timer."""
    shown = current.supervisor.shown()
    current.supervisor.tick()
    has_news = current.supervisor.shown() != shown
    if current.check is not None and (finding := current.check.poll()) is not None:
        current.finding, current.check = finding, None
        has_news = True
    if current.clip_look is not None and (seen := current.clip_look.poll()) is not None:
        current.look, current.clip_look = seen, None
        has_news = True
    for folder in current.supervisor.take_finished():
        # apart, so that a defect in the import cannot stop this timer
        bpy.app.timers.register(lambda folder=folder: import_finished(folder), first_interval=0.0)
    if has_news:
        redraw()
    is_asking = current.check is not None or current.clip_look is not None
    return TICK_SECONDS if current.supervisor.needs_ticks or is_asking else None


def redraw() -> None:
    for window in bpy.context.window_manager.windows:
        for area in window.screen.areas:
            for region in area.regions:
                if (area.type, region.type) in _REDRAWN_REGIONS:
                    region.tag_redraw()


def import_finished(folder: Path) -> None:
    """Import into the scene that asked for it, if it is still open."""
    from .settings import job_folder

    for scene in bpy.data.scenes:
        if scene.wildsmoke.import_when_done and job_folder(scene.wildsmoke) == folder:
            try:
                import_into(scene, folder)
            except BackendError as error:
                current.supervisor.note(folder, error)
            redraw()
            return


def import_into(scene: bpy.types.Scene, folder: Path) -> bpy.types.Object:
    """Bring a finished job into a scene, as one step that can be undone. Raises BackendError."""
    from .scene import import_result

    made = import_result(folder, scene=scene)
    windows = bpy.context.window_manager.windows
    if windows and not bpy.app.background:
        with bpy.context.temp_override(window=windows[0]):
            bpy.ops.ed.undo_push(message="Import Smoke")
    return made


@persistent
def on_load(_file: object, _unused: object = None) -> None:
    """A .blend was opened: find its jobs again, whether running, finished or interrupted."""
    from .settings import job_folder

    for scene in bpy.data.scenes:
        look(job_folder(scene.wildsmoke))
    from .scene.volume import align_all

    align_all()  # the file may have been saved by a Blender that draws grids elsewhere


def register() -> None:
    bpy.app.handlers.load_post.append(on_load)
    atexit.register(current.close)
    if not bpy.app.background:  # there no timer fires, and one that waits when bpy 4.5's wheel exits makes it hang
        # the add-on may be enabled with a file open; while Blender registers, its data is not to be touched
        bpy.app.timers.register(_look_once, first_interval=0.0)


def _look_once() -> None:
    on_load(None)


def unregister() -> None:
    atexit.unregister(current.close)
    for handler in [h for h in bpy.app.handlers.load_post if h.__name__ == on_load.__name__ and h.__module__ == __name__]:
        bpy.app.handlers.load_post.remove(handler)
    for timer in (tick, _look_once):
        if bpy.app.timers.is_registered(timer):
            bpy.app.timers.unregister(timer)
    current.close()
