"""Inside a Blender with a window: presses the panel's buttons from a timer and writes down what happens.

WILDSMOKE_GUI_PLAN names a JSON file: report (where to write), video, job_folder, root and python of a backend that only
pretends, steps (names of the functions below, in order). A step returns True when it is through.
"""

from __future__ import annotations

import json
import os
import sys
import time
from pathlib import Path

import bpy

MODULE = "bl_ext.user_default.wildsmoke"
PLAN = json.loads(Path(os.environ["WILDSMOKE_GUI_PLAN"]).read_text())
REPORT: dict = {"phases": [], "gaps": {}}
STATE: dict = {"began": time.monotonic(), "last": None, "steps": list(PLAN["steps"])}


def write_report() -> None:
    path = Path(PLAN["report"])
    part = path.with_suffix(".part")
    part.write_text(json.dumps(REPORT))
    part.replace(path)


def session():
    return sys.modules[f"{MODULE}.addon.session"]


def status():
    folder = sys.modules[f"{MODULE}.addon.settings"].job_folder(bpy.context.scene.wildsmoke)
    return session().current.supervisor.status(folder)


def view_area():
    window = bpy.context.window_manager.windows[0]
    return window, max((area for area in window.screen.areas if area.type == "VIEW_3D"), key=lambda area: area.width)


def pressed(name: str, **properties) -> set[str]:
    """Call an operator as its button does, in the window and the viewport."""
    window, area = view_area()
    region = next(region for region in area.regions if region.type == "UI")
    with bpy.context.temp_override(window=window, area=area, region=region):
        return getattr(bpy.ops.wildsmoke, name)("INVOKE_DEFAULT", **properties)


def shot(name: str) -> bool:
    """Ask for a picture and wait until it is taken, a while after the last redraw."""
    path = Path(PLAN["report"]).parent / f"{name}.shot"
    if f"shot {name}" not in STATE:
        STATE[f"shot {name}"] = time.monotonic()
        for area in bpy.context.window_manager.windows[0].screen.areas:
            area.tag_redraw()
        return False
    if time.monotonic() - STATE[f"shot {name}"] < 1.0:
        return False
    if f"asked {name}" not in STATE:
        STATE[f"asked {name}"] = True
        path.touch()
    return not path.exists()


def measure_ticks() -> bool:
    """From now on note the most that one tick of the add-on's timer keeps Blender's main thread busy."""
    REPORT["tick_seconds"] = 0.0
    real_tick = session().tick

    def timed_tick() -> float | None:
        began = time.thread_time()
        try:
            return real_tick()
        finally:
            REPORT["tick_seconds"] = max(REPORT["tick_seconds"], time.thread_time() - began)

    session().tick = timed_tick
    return True


def rest() -> bool:
    """Three seconds of nothing, to compare with."""
    STATE.setdefault("rest", time.monotonic())
    return time.monotonic() - STATE["rest"] > 3.0


def open_sidebar() -> bool:
    """Open it and turn the wheel over its tabs until ours is in front: the tab cannot be set from Python."""
    window, area = view_area()
    area.spaces.active.show_region_ui = True
    region = next(region for region in area.regions if region.type == "UI")
    if region.width < 10 or time.monotonic() - STATE["began"] < 2.0:
        return False
    REPORT["category"] = region.active_panel_category
    if REPORT["category"] == "Wildsmoke":
        return True
    x, y = region.x + region.width - 8, region.y + region.height // 2
    window.event_simulate(type="MOUSEMOVE", value="NOTHING", x=x, y=y)
    window.event_simulate(type="WHEELDOWNMOUSE", value="PRESS", x=x, y=y, ctrl=True)
    return False


def use_fake_backend() -> bool:
    session().ROOT = Path(PLAN["root"])
    os.environ["WILDSMOKE_BACKEND_PYTHON"] = PLAN.get("python") or sys.executable
    return True


def fill_in() -> bool:
    settings = bpy.context.scene.wildsmoke
    settings.output_folder = PLAN["job_folder"]
    settings.video = PLAN["video"]
    settings.import_when_done = PLAN.get("import", False)
    for name, value in PLAN.get("settings", {}).items():
        group, _, field = name.rpartition(".")
        setattr(settings.path_resolve(group) if group else settings, field, value)
    return True


def start() -> bool:
    REPORT["start"] = sorted(pressed("start"))
    REPORT["pid"] = session().current.supervisor.runner.pid
    return True


def wait_half() -> bool:
    return status().fraction > 0.4 and status().seconds_left is not None


def wait_end() -> bool:
    return not status().phase.is_active


def wait_half_second() -> bool:
    STATE.setdefault("half_second", time.monotonic())
    return time.monotonic() - STATE["half_second"] > 0.5


def wait_busy_gone() -> bool:
    return status().phase.value != "busy"


def wait_import() -> bool:
    REPORT["objects"] = sorted(f"{made.type}" for made in bpy.context.scene.objects)
    return "VOLUME" in REPORT["objects"]


def cancel() -> bool:
    REPORT["cancel"] = sorted(pressed("cancel"))
    return True


def check_backend() -> bool:
    if session().current.finding is None:
        if session().current.check is None:
            pressed("check_backend")
        return False
    REPORT["finding"] = [sentence for _, sentence in session().current.finding.lines]
    return True


def look_at_clip() -> bool:
    if session().current.look is None:
        if session().current.clip_look is None:
            pressed("inspect_clip")
        return False
    REPORT["estimates"] = [item.to_text() for item in session().current.look.outlook.estimates]
    return True


def open_all_panels() -> bool:
    """Register the panels again, open: a click on each heading would do the same."""
    panel = sys.modules[f"{MODULE}.addon.panel"]
    for made in reversed(panel.CLASSES):
        bpy.utils.unregister_class(made)
    for made in panel.CLASSES:
        made.bl_options = set()
        bpy.utils.register_class(made)
    return True


def show_preferences() -> bool:
    window, area = view_area()
    area.ui_type = "PREFERENCES"
    bpy.context.preferences.active_section = "ADDONS"
    bpy.context.window_manager.addon_search = "Wildsmoke"
    with bpy.context.temp_override(window=window, area=area):
        bpy.ops.preferences.addon_expand(module=MODULE)
    return True


def save() -> bool:
    bpy.ops.wm.save_mainfile()
    return True


def hold() -> bool:
    REPORT["holding"] = True
    return False


def quit_blender() -> bool:
    bpy.ops.wm.quit_blender()
    return True


def step() -> float | None:
    now = time.monotonic()
    if STATE["last"] is not None:
        name = STATE["steps"][0] if STATE["steps"] else "after"
        REPORT["gaps"][name] = max(REPORT["gaps"].get(name, 0.0), now - STATE["last"])
    STATE["last"] = now
    phase = status().phase.value
    if not REPORT["phases"] or REPORT["phases"][-1] != phase:
        REPORT["phases"].append(phase)
    if STATE["steps"]:
        name, _, argument = STATE["steps"][0].partition(" ")
        if shot(argument) if name == "shot" else globals()[name]():
            STATE["steps"].pop(0)
            STATE["last"] = None  # what a step does itself, such as saving, is no gap in the following
    else:
        REPORT["through"] = True
    write_report()
    return 0.05


bpy.app.timers.register(step, first_interval=0.5, persistent=True)
