"""The extension in a real Blender: its command line, its window, and its end. docs/addon.md says how to run this."""

from __future__ import annotations

import os
import signal
import subprocess
import time
from pathlib import Path

import pytest
from wildsmoke.backend.contract.running import is_alive

pytestmark = pytest.mark.binary
FAKE_ROOT = Path(__file__).resolve().parents[1] / "addon" / "fake_root"
MODULE = "bl_ext.user_default.wildsmoke"


def run(blender: str, environment: dict[str, str], *arguments: str) -> str:
    command = [blender, *arguments]
    ended = subprocess.run(command, env=environment, capture_output=True, text=True, timeout=120, check=False)
    assert ended.returncode == 0, ended.stdout + ended.stderr
    return ended.stdout


@pytest.fixture
def blend(blender, environment, installed, tmp_path) -> Path:
    """A .blend to open, so that no splash screen lies over the window."""
    path = tmp_path / "scene.blend"
    code = f"import bpy\nbpy.ops.wm.save_as_mainfile(filepath={str(path)!r})"
    run(blender, environment, "-b", "--python-exit-code", "1", "--python-expr", code)
    return path


@pytest.fixture
def plan(tmp_path) -> dict[str, str]:
    return {"root": str(FAKE_ROOT), "job_folder": str(tmp_path / "job"), "video": str(tmp_path / "slow.mp4")}


def wait_dead(pid: int, seconds: float) -> None:
    began = time.monotonic()
    while is_alive(pid):
        assert time.monotonic() - began < seconds, f"process {pid} lives after {seconds} s"
        time.sleep(0.01)


def test_the_command_line_validates_and_installs(blender, environment, archive, installed):
    assert "Success" in run(blender, environment, "--command", "extension", "validate", str(archive))
    assert "wildsmoke" in run(blender, environment, "--command", "extension", "list")
    code = f"import bpy, sys\nassert {MODULE!r} in bpy.context.preferences.addons\nassert 'torch' not in sys.modules\n"
    run(blender, environment, "-b", "--python-exit-code", "1", "--python-expr", code)


def test_operators_run_to_the_end_in_background_mode(blender, environment, installed, tmp_path):
    code = f"""
import bpy, os, sys
from pathlib import Path
sys.modules[{MODULE!r} + ".addon.session"].ROOT = Path({str(FAKE_ROOT)!r})
os.environ["WILDSMOKE_BACKEND_PYTHON"] = sys.executable
settings = bpy.context.scene.wildsmoke
settings.video, settings.output_folder = {str(tmp_path / "succeed.mp4")!r}, {str(tmp_path / "job")!r}
settings.import_when_done = False
assert bpy.ops.wildsmoke.start() == {{"FINISHED"}}
"""
    printed = run(blender, environment, "-b", "--python-exit-code", "1", "--python-expr", code)
    assert '"event": "done"' in printed and (tmp_path / "job" / "result.json").exists()


def test_a_run_in_the_window(gui, blend, plan):
    steps = ["open_sidebar", "use_fake_backend", "shot empty", "fill_in", "shot filled", "start", "wait_half", "shot running"]
    gui.start(blend, **plan, steps=[*steps, "cancel", "wait_end", "shot cancelled", "quit_blender"])
    report = gui.wait_for("cancel", seconds=60)
    assert report["start"] == ["FINISHED"] and report["category"] == "Wildsmoke"
    phases = gui.wait_exit()["phases"]
    # the cancelling is over in no time, and may fall between two looks
    assert [phase for phase in phases if phase != "cancelling"] == ["none", "starting", "running", "cancelled"]


def test_blender_never_freezes(gui, blend, plan):
    plan["video"] = plan["video"].replace("slow", "flood")
    steps = ["open_sidebar", "use_fake_backend", "fill_in", "rest", "measure_ticks", "start", "wait_end", "shot done", "hold"]
    gui.start(blend, **plan, steps=steps)
    report = gui.wait_for("holding", seconds=60)
    assert report["phases"][-1] == "done"
    gaps = report["gaps"]
    print(f"longest gap between ticks: at rest {gaps['rest']:.2f} s, in a flood {gaps['wait_end']:.2f} s")  # pytest -rP
    print(f"longest tick: {report['tick_seconds'] * 1000:.1f} ms of the main thread")
    assert 0.0 < report["tick_seconds"] < 0.1
    assert gaps["wait_end"] < 2.0 + gaps["rest"], "drawing in software on a busy machine takes most of it"


@pytest.mark.parametrize("behaviour", ["error", "half_line", "succeed"])
def test_every_end_is_shown(gui, blend, plan, behaviour):
    plan["video"] = plan["video"].replace("slow", behaviour)
    steps = ["open_sidebar", "use_fake_backend", "fill_in", "start", "wait_end", f"shot end_{behaviour}", "hold"]
    gui.start(blend, **plan, steps=steps)
    report = gui.wait_for("holding", seconds=60)
    assert report["phases"][-1] == {"error": "failed", "half_line": "crashed", "succeed": "done"}[behaviour]


def test_what_to_expect_is_shown_before_start(gui, blend, plan):
    plan["video"] = plan["video"].replace("slow", "succeed")
    steps = ["open_sidebar", "use_fake_backend", "fill_in", "measure_ticks", "look_at_clip", "shot outlook", "hold"]
    gui.start(blend, **plan, steps=steps)
    report = gui.wait_for("holding", seconds=120)
    assert len(report["estimates"]) == 3 and report["tick_seconds"] < 0.1


def test_all_panels_open(gui, blend, plan):
    gui.start(blend, **plan, steps=["open_all_panels", "open_sidebar", "fill_in", "shot panels", "hold"])
    gui.wait_for("holding", seconds=60)


def test_preferences_say_what_to_do(gui, blend, plan):
    gui.start(blend, **plan, steps=["check_backend", "show_preferences", "shot preferences", "hold"])
    assert gui.wait_for("holding", seconds=60)["finding"] == ["There is no backend yet."]


def test_the_real_backend_from_clip_to_volume(gui, blend, tmp_path):
    """Needs WILDSMOKE_BACKEND_PYTHON: a Python with the backend's packages, and WILDSMOKE_CLIP: any clip of smoke."""
    clip = os.environ.get("WILDSMOKE_CLIP", "")
    if not clip or not os.environ.get("WILDSMOKE_BACKEND_PYTHON"):
        pytest.skip("WILDSMOKE_CLIP or WILDSMOKE_BACKEND_PYTHON is not set")
    small = {"use_frame_range": True, "frame_stop": 4, "config.frames.working_size": 96, "config.export.max_voxels": 48}
    small |= {"preset": "draft", "config.physical.num_particles": 300, "config.visual.num_particles": 600}
    plan = {"job_folder": str(tmp_path / "job"), "video": clip, "import": True, "settings": small}
    steps = ["open_sidebar", "check_backend", "fill_in", "start", "wait_end", "wait_import", "shot imported", "hold"]
    gui.start(blend, **plan, steps=steps)
    report = gui.wait_for("holding", seconds=400)
    assert report["phases"][-1] == "done" and "VOLUME" in report["objects"]
    assert report["gaps"]["wait_end"] < 2.0, report
    assert report["gaps"].get("wait_import", 0.0) < 3.0, report  # it reads the first VDB file


@pytest.mark.parametrize("how", ["quit", "kill"])
def test_closing_blender_ends_the_backend(gui, blend, plan, how):
    ending = ["quit_blender"] if how == "quit" else ["hold"]
    gui.start(blend, **plan, steps=["use_fake_backend", "fill_in", "start", "wait_half_second", *ending])
    report = gui.wait_for("pid", seconds=60)
    assert is_alive(report["pid"]) or how == "quit"
    if how == "kill":
        gui.wait_for("holding")
        gui.process.send_signal(signal.SIGKILL)
    gui.process.wait(30)
    wait_dead(report["pid"], 2.0)


def test_a_reopened_file_shows_what_was_interrupted(gui, blend, plan):
    steps = ["open_sidebar", "use_fake_backend", "fill_in", "save", "start", "wait_half_second", "hold"]
    gui.start(blend, **plan, steps=steps)
    gui.wait_for("holding", seconds=60)
    gui.process.send_signal(signal.SIGKILL)
    gui.process.wait(30)
    gui.start(blend, **plan, steps=["open_sidebar", "wait_busy_gone", "shot reopened", "hold"])
    assert gui.wait_for("holding", seconds=60)["phases"][-1] == "interrupted"
