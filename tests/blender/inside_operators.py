"""Checks of the add-on's operators, panel and handlers. Runs inside Blender's wheel, see conftest.py."""

from __future__ import annotations

import contextlib
import dataclasses
import io
import json
import math
import os
import subprocess
import sys
import time
import types
from collections.abc import Iterator
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import bpy
from wildsmoke.backend.contract import job as contract
from wildsmoke.backend.contract.running import is_alive, process_start

import wildsmoke

FAKE_ROOT = Path(__file__).resolve().parents[1] / "addon" / "fake_root"


@contextlib.contextmanager
def registered(*, root: Path = FAKE_ROOT, python: str = sys.executable) -> Iterator[Any]:
    """The add-on registered, with the backend that only pretends. Gives its session module."""
    wildsmoke.register()
    from wildsmoke.addon import session

    real_root = session.ROOT
    session.ROOT = root
    os.environ["WILDSMOKE_BACKEND_PYTHON"] = python
    try:
        yield session
    finally:
        session.ROOT = real_root
        del os.environ["WILDSMOKE_BACKEND_PYTHON"]
        wildsmoke.unregister()


@contextlib.contextmanager
def fake_import() -> Iterator[list[tuple]]:
    """Stands in for addon.scene; gives the list of its calls."""
    calls: list[tuple] = []

    def import_result(job_folder, *, scene, collection=None):
        calls.append((Path(job_folder), scene.name, collection))
        made = bpy.data.objects.new("Smoke", None)
        scene.collection.objects.link(made)
        return made

    name = "wildsmoke.addon.scene"
    before = sys.modules.get(name)
    sys.modules[name] = types.ModuleType(name)
    sys.modules[name].import_result = import_result
    try:
        yield calls
    finally:
        del sys.modules[name]
        if before is not None:
            sys.modules[name] = before


def set_job(folder: Path, behaviour: str) -> Any:
    settings = bpy.context.scene.wildsmoke
    settings.output_folder = str(folder / "job")
    settings.video = str(folder / f"{behaviour}.mp4")
    return settings


def message_of(operator: Any) -> str:
    """What an operator that fails says: Blender raises it in scripts."""
    try:
        outcome = operator()
    except RuntimeError as error:
        return str(error)
    raise AssertionError(f"{operator} did not fail: {outcome}")


def tick_until(session: Any, condition: Any, seconds: float = 10.0) -> None:
    deadline = time.monotonic() + seconds
    while not condition():
        assert time.monotonic() < deadline, session.current.supervisor._statuses
        session.tick()
        time.sleep(0.01)


class FakeLayout:
    """Takes a panel's drawing and remembers it. Refuses properties that do not exist."""

    def __init__(self, drawn: list[str] | None = None) -> None:
        self.drawn = [] if drawn is None else drawn

    def _part(self, **options: Any) -> FakeLayout:
        return FakeLayout(self.drawn)

    row = column = box = _part

    def label(self, *, text: str = "", icon: str = "NONE") -> None:
        assert icon in bpy.types.UILayout.bl_rna.functions["label"].parameters["icon"].enum_items, icon
        self.drawn.append(text)

    def prop(self, data: Any, name: str, **options: Any) -> None:
        assert name in data.bl_rna.properties, name
        self.drawn.append(name)

    def operator(self, name: str, *, text: str | None = None, icon: str = "NONE") -> None:
        assert icon in bpy.types.UILayout.bl_rna.functions["label"].parameters["icon"].enum_items, icon
        bpy.ops.wildsmoke.__getattr__(name.partition(".")[2]).get_rna_type()  # exists
        self.drawn.append(f"[{name}]" if text is None else f"[{text}]")

    def progress(self, *, factor: float, type: str, text: str) -> None:
        assert 0.0 <= factor <= 1.0 and type == "BAR"
        self.drawn.append(text)

    def separator(self) -> None:
        pass


def draw(name: str) -> list[str]:
    """Everything that a panel draws, as text."""
    panel = getattr(bpy.types, name)
    layout = FakeLayout()
    made = SimpleNamespace(layout=layout, section=getattr(panel, "section", None))
    context = SimpleNamespace(scene=bpy.context.scene, region=SimpleNamespace(width=280), preferences=bpy.context.preferences)
    panel.draw(made, context)
    return layout.drawn


def check_blender_gets_no_torch(folder: Path) -> None:
    with registered():
        draw("WILDSMOKE_PT_main")
        set_job(folder, "succeed")
        with fake_import():
            bpy.ops.wildsmoke.start()
    loaded = {"torch", "numba", "h5py", "cv2", "av"} & set(sys.modules)
    assert not loaded, loaded


def check_register_twice_leaves_nothing(folder: Path) -> None:
    handlers = len(bpy.app.handlers.load_post)
    for _ in range(2):
        wildsmoke.register()
        assert hasattr(bpy.types.Scene, "wildsmoke") and hasattr(bpy.types, "WILDSMOKE_PT_main")
        wildsmoke.unregister()
        assert not hasattr(bpy.types.Scene, "wildsmoke")
        assert not [name for name in dir(bpy.types) if name.startswith(("WILDSMOKE", "Wildsmoke"))]
        assert len(bpy.app.handlers.load_post) == handlers


def check_properties_mirror_the_contract(folder: Path) -> None:
    with registered():
        from wildsmoke.addon.settings import changed_settings

        mirror, config = bpy.context.scene.wildsmoke.config, contract.Config()
        fields = {field.name: getattr(config, field.name) for field in dataclasses.fields(config)}
        sections = [name for name, value in fields.items() if dataclasses.is_dataclass(value)]
        assert _own_names(mirror) == set(fields)
        _compare(mirror, config, fields.keys() - set(sections))
        for section in sections:
            group, values = getattr(mirror, section), getattr(config, section)
            names = {field.name for field in dataclasses.fields(values)}
            assert _own_names(group) == names
            _compare(group, values, names)
        assert changed_settings(mirror, "preview") == {}
        job_properties = bpy.context.scene.wildsmoke.bl_rna.properties
        assert tuple(job_properties["preset"].enum_items.keys()) == contract.PRESETS
        assert job_properties["preset"].default == contract.Job(video="a").preset
        assert tuple(job_properties["device"].enum_items.keys()) == ("preferences", *contract.DEVICES)


def _own_names(group: Any) -> set[str]:
    return {prop.identifier for prop in group.bl_rna.properties} - {"rna_type", "name"}


def _compare(group: Any, values: Any, names: set[str]) -> None:
    """Defaults equal; the whole range accepted, and nothing of it left out; every choice accepted, and all of them there."""
    for name in names:
        prop, value = group.bl_rna.properties[name], getattr(values, name)
        where = f"{type(values).__name__}.{name}"
        if prop.type in ("INT", "FLOAT"):
            assert prop.type == ("FLOAT" if isinstance(value, float) else "INT"), where
            assert math.isclose(prop.default, value, rel_tol=1e-6), where
            low, high = prop.hard_min, prop.hard_max
            for inside in (low, high):
                rounded = float(f"{inside:.7g}") if isinstance(value, float) else inside
                dataclasses.replace(values, **{name: rounded})
            span = 1 if isinstance(value, int) else max(abs(high - low) * 1e-3, 1e-6)
            outside = [high + span, low - span]
            if isinstance(value, float) and 0 < low < span:
                outside[1] = low / 2
            for bound in outside:
                try:
                    dataclasses.replace(values, **{name: bound})
                except ValueError:
                    continue
                raise AssertionError(f"{where}: the contract takes {bound}, the panel only {low} to {high}")
        elif prop.type == "ENUM":
            assert prop.default == value, where
            for item in prop.enum_items:
                dataclasses.replace(values, **{name: item.identifier})
            choices = {
                "Config": contract.METHODS,
                "ExtractionConfig": contract.EXTRACTION_MODES,
                "CamerasConfig": contract.CAMERA_MODES,
                "VisualConfig": contract.COLOR_MODES,
            }
            assert tuple(prop.enum_items.keys()) == choices[type(values).__name__], where
        else:
            assert prop.type == {bool: "BOOLEAN", str: "STRING"}[type(value)] and prop.default == value, where


def check_a_changed_setting_becomes_an_override(folder: Path) -> None:
    with registered():
        from wildsmoke.addon.settings import make_job

        settings = set_job(folder, "succeed")
        settings.config.physical.drag = 0.7
        settings.config.extraction.guided_radius = 0.01
        settings.config.seed = 7
        job = make_job(settings, device="cpu")
        assert job.overrides == {"physical.drag": 0.7, "seed": 7}, job.overrides
        assert job.device == "cpu" and job.config().physical.drag == 0.7
        settings.device = "cuda"
        settings.use_frame_range = True
        settings.frame_start, settings.frame_stop = 3, 9
        job = make_job(settings, device="cpu")
        assert (job.device, job.frame_start, job.frame_stop) == ("cuda", 3, 9)
        settings.frame_stop = 3
        assert "The frame range 3:3 is empty." in message_of(bpy.ops.wildsmoke.start)


def check_a_preset_keeps_what_the_user_changed(folder: Path) -> None:
    with registered():
        from wildsmoke.addon.settings import changed_settings, set_config

        settings = bpy.context.scene.wildsmoke
        for preset in contract.PRESETS:  # each setting survives the way through Blender's 32-bit properties
            set_config(settings.config, contract.preset_config(preset))
            assert changed_settings(settings.config, preset) == {}
        set_config(settings.config, contract.preset_config("preview"))
        settings.config.visual.iterations = 9
        settings.preset = "draft"
        assert settings.config.visual.iterations == 9
        assert settings.config.frames.working_size == contract.draft().frames.working_size
        assert changed_settings(settings.config, "draft") == {"visual.iterations": 9}
        bpy.ops.wildsmoke.reset_settings()
        assert changed_settings(settings.config, "draft") == {}


def check_an_output_folder_is_suggested_once(folder: Path) -> None:
    with registered():
        settings = bpy.context.scene.wildsmoke
        settings.video = str(folder / "shot_0001.png")
        assert Path(settings.output_folder) == folder / "shot_wildsmoke"
        settings.video = str(folder / "other.mp4")
        assert Path(settings.output_folder) == folder / "shot_wildsmoke"


def check_start_runs_to_the_end_and_imports(folder: Path) -> None:
    with registered() as session, fake_import() as calls:
        set_job(folder, "succeed")
        printed = io.StringIO()
        with contextlib.redirect_stdout(printed):
            assert bpy.ops.wildsmoke.start() == {"FINISHED"}
        assert calls == [(folder / "job", "Scene", None)]
        assert '"event": "done"' in printed.getvalue() and '"event": "progress"' not in printed.getvalue()
        drawn = draw("WILDSMOKE_PT_main")
        assert "Finished" in drawn and "The camera is taken as still." in " ".join(drawn)
        assert "a line for the log" in draw("WILDSMOKE_PT_log")
        assert session.current.supervisor.running_folder is None
        bpy.context.scene.wildsmoke.import_when_done = False
        assert bpy.ops.wildsmoke.start() == {"FINISHED"} and len(calls) == 1
        assert bpy.ops.wildsmoke.import_result() == {"FINISHED"} and len(calls) == 2


def check_an_error_is_said_with_its_hint(folder: Path) -> None:
    with registered(), fake_import() as calls:
        set_job(folder, "error")
        message = message_of(bpy.ops.wildsmoke.start)
        assert "12 frames; 24 are needed. Trim less of the clip." in message
        drawn = draw("WILDSMOKE_PT_main")
        assert "Failed" in drawn and "12 frames; 24 are needed." in drawn and "Trim less of the clip." in drawn
        assert not calls


def check_a_crash_shows_the_end_of_the_log(folder: Path) -> None:
    with registered():
        set_job(folder, "half_line")
        message = message_of(bpy.ops.wildsmoke.start)
        assert "exit code 139" in message and "the reason stands here" in message and "log.txt" in message, message
        assert "[Resume]" in draw("WILDSMOKE_PT_main")


def check_what_is_missing_is_named(folder: Path) -> None:
    with registered() as session:
        settings = bpy.context.scene.wildsmoke
        assert "There is no output folder." in message_of(bpy.ops.wildsmoke.start)
        settings.output_folder = "//job"  # relative to a file that was never saved
        assert "to be saved first" in message_of(bpy.ops.wildsmoke.start)
        settings.output_folder = str(folder / "job")
        assert "There is no clip." in message_of(bpy.ops.wildsmoke.start)
        assert "holds no finished job" in message_of(bpy.ops.wildsmoke.import_result)
        assert bpy.ops.wildsmoke.cancel() == {"CANCELLED"}
        settings.video = str(folder / "succeed.mp4")
        os.environ["WILDSMOKE_BACKEND_PYTHON"] = str(folder / "nowhere")
        assert "cannot be started" in message_of(bpy.ops.wildsmoke.start)
        os.environ["WILDSMOKE_BACKEND_PYTHON"] = ""
        assert "There is no backend yet." in message_of(bpy.ops.wildsmoke.start)
        assert session.current.supervisor.running_folder is None


def check_the_backend_is_checked(folder: Path) -> None:
    checkout = FAKE_ROOT.parents[2]
    with registered(root=checkout, python=str(folder / "nowhere")) as session:
        message = message_of(bpy.ops.wildsmoke.check_backend)
        assert "nowhere cannot be started" in message and "requirements.txt" in message and "-m venv" in message
        os.environ["WILDSMOKE_BACKEND_PYTHON"] = sys.executable  # Blender's own: no torch, and it stays so
        message = message_of(bpy.ops.wildsmoke.check_backend)
        assert "torch is missing" in message
        from wildsmoke.addon.preferences import draw_finding

        layout = FakeLayout()
        draw_finding(layout, session.current.finding, width=40)
        assert "The backend cannot run yet" in layout.drawn and "torch is missing" in layout.drawn
        assert "[wildsmoke.copy_commands]" in layout.drawn


def check_what_to_expect_is_told_before_start(folder: Path) -> None:
    with registered() as session:
        settings = set_job(folder, "error")
        assert "too short" in message_of(bpy.ops.wildsmoke.inspect_clip)
        assert "too short" in " ".join(draw("WILDSMOKE_PT_outlook"))
        settings.video = str(folder / "succeed.mp4")
        assert bpy.ops.wildsmoke.inspect_clip() == {"FINISHED"}
        drawn = " ".join(draw("WILDSMOKE_PT_outlook"))
        assert "Draft: 1.3 to 3 min, 0.5 GiB" in drawn and "Depth: silhouette" in drawn and "changed since" not in drawn
        settings.preset = "final"
        assert "changed since" not in " ".join(draw("WILDSMOKE_PT_outlook")), "all presets were looked at"
        settings.config.visual.iterations = 99
        assert "changed since" in " ".join(draw("WILDSMOKE_PT_outlook"))
        settings.video = ""
        assert "changed since" in " ".join(draw("WILDSMOKE_PT_outlook"))
        assert "no clip" in message_of(bpy.ops.wildsmoke.inspect_clip)
        session.current.look = None
        settings.config.visual.iterations, settings.preset = 16, "preview"


def check_the_look_is_followed_by_the_timer(folder: Path) -> None:
    with registered() as session:
        from wildsmoke.addon.settings import make_job

        settings = set_job(folder, "succeed")
        session.start_look(make_job(settings, device="auto"))
        assert "[Looking at the clip...]" in draw("WILDSMOKE_PT_outlook")
        tick_until(session, lambda: session.current.look is not None)
        assert session.current.clip_look is None and session.current.look.outlook is not None
        set_job(folder, "hang")
        session.start_look(make_job(settings, device="auto"))
        process = session.current.clip_look._process
    assert process.poll() is not None, "unregister ends it"


def check_a_job_shows_what_it_follows(folder: Path) -> None:
    with registered() as session, fake_import():
        set_job(folder, "succeed")
        bpy.ops.wildsmoke.start()
        assert "Depth: silhouette" in " ".join(draw("WILDSMOKE_PT_outlook"))
        session.current.supervisor.close()
        session.look(folder / "job")
        assert "Depth: silhouette" in " ".join(draw("WILDSMOKE_PT_outlook"))


def check_a_run_is_followed_by_the_timer(folder: Path) -> None:
    with registered() as session:
        settings = set_job(folder, "slow")
        supervisor = session.current.supervisor
        from wildsmoke.addon.settings import make_job

        supervisor.start(session.backend(), folder / "job", make_job(settings, device="cpu"))
        assert session.tick() == session.TICK_SECONDS
        status = lambda: supervisor.status(folder / "job")  # noqa: E731
        tick_until(session, lambda: status().seconds_left is not None)
        drawn = draw("WILDSMOKE_PT_main")
        assert "Fitting the look (2 of 2)" in drawn and "[wildsmoke.cancel]" in drawn
        assert any(text.endswith(" left") for text in drawn)
        assert not bpy.ops.wildsmoke.start.poll()
        settings.output_folder = str(folder / "elsewhere")
        assert any("A job is running in" in text for text in draw("WILDSMOKE_PT_main"))
        settings.output_folder = str(folder / "job")
        assert bpy.ops.wildsmoke.cancel() == {"FINISHED"}
        assert "Stopping" in draw("WILDSMOKE_PT_main")
        tick_until(session, lambda: not supervisor.needs_ticks)
        assert session.tick() is None
        assert {"Cancelled", "[Resume]"} <= set(draw("WILDSMOKE_PT_main"))


def check_unregister_ends_the_backend(folder: Path) -> None:
    with registered() as session:
        settings = set_job(folder, "hang")
        from wildsmoke.addon.settings import make_job

        session.current.supervisor.start(session.backend(), folder / "job", make_job(settings, device="cpu"))
        pid = session.current.supervisor.runner.pid
        assert is_alive(pid)
        began = time.monotonic()
    assert time.monotonic() - began < 2.0 and not is_alive(pid)


def check_a_finished_run_imports_into_the_scene_that_asked(folder: Path) -> None:
    with registered() as session, fake_import() as calls:
        set_job(folder, "succeed")
        other = bpy.data.scenes.new("Other")
        other.wildsmoke.output_folder = str(folder / "other")
        session.import_finished(folder / "other")
        session.import_finished(folder / "nobody")
        assert calls == [(folder / "other", "Other", None)]


def check_a_reopened_file_finds_its_job(folder: Path) -> None:
    blend = folder / "scene.blend"
    job = folder / "job"
    with registered() as session:
        set_job(folder, "succeed")
        bpy.context.scene.wildsmoke.output_folder = "//job"
        bpy.ops.wm.save_as_mainfile(filepath=str(blend))
        assert _reopened(session, blend, folder) == "none"
        job.mkdir()
        (job / "job.json").write_text(contract.Job(video="a.mp4").to_json())
        (job / "log.txt").write_text("the last line\n")
        assert _reopened(session, blend, folder) == "interrupted"
        assert "[Resume]" in draw("WILDSMOKE_PT_main") and "the last line" in draw("WILDSMOKE_PT_log")
        elsewhere = subprocess.Popen([sys.executable, "-c", "input()"], stdin=subprocess.PIPE)
        mark = {"pid": elsewhere.pid, "start": process_start(elsewhere.pid)}
        (job / "running.json").write_text(json.dumps(mark))
        assert _reopened(session, blend, folder) == "busy"
        assert f"Process {elsewhere.pid}" in " ".join(draw("WILDSMOKE_PT_main"))
        elsewhere.communicate(b"\n")
        session.current.supervisor._next_look = 0.0
        session.tick()
        assert session.current.supervisor.status(job).phase.value == "interrupted"
        namespace: dict[str, Any] = {"__name__": "fake"}
        exec((FAKE_ROOT / "backend/__main__.py").read_text(), namespace)
        (job / "result.json").write_text(json.dumps(namespace["RESULT"]))
        assert _reopened(session, blend, folder) == "done"
        (job / "result.json").write_text("{ half a fil")
        assert _reopened(session, blend, folder) == "interrupted"
        assert "cannot be read" in " ".join(draw("WILDSMOKE_PT_main"))


def check_a_reopened_file_finds_its_own_run(folder: Path) -> None:
    with registered() as session:
        settings = set_job(folder, "slow")
        from wildsmoke.addon.settings import make_job

        supervisor = session.current.supervisor
        supervisor.start(session.backend(), folder / "job", make_job(settings, device="cpu"))
        tick_until(session, lambda: supervisor.status(folder / "job").phase.value == "running")
        bpy.ops.wm.save_as_mainfile(filepath=str(folder / "scene.blend"))
        bpy.ops.wm.read_homefile(use_factory_startup=True, use_empty=True)
        assert supervisor.running_folder == folder / "job"
        assert _reopened(session, folder / "scene.blend", folder) == "running"


def _reopened(session: Any, blend: Path, folder: Path) -> str:
    bpy.ops.wm.open_mainfile(filepath=str(blend))
    return session.current.supervisor.status(folder / "job").phase.value


def check_every_panel_draws_in_every_phase(folder: Path) -> None:
    with registered() as session:
        from wildsmoke.addon.status import JobStatus, Phase

        set_job(folder, "succeed")
        panels = [name for name in dir(bpy.types) if name.startswith("WILDSMOKE_PT_")]
        assert len(panels) == 4 + len({key.partition(".")[0] for key in contract.settable_keys(contract.Config()) if "." in key})
        for phase in Phase:
            status = JobStatus(phase=phase, stage="visual", stage_count=3, message="What is wrong.", hint="What to do.")
            session.current.supervisor._statuses[folder / "job"] = status
            for name in panels:
                assert draw(name), name
        bpy.context.scene.wildsmoke.config.seed = 5
        assert "1 changed from Preview" in draw("WILDSMOKE_PT_settings")


def check_a_log_that_is_not_there_is_said(folder: Path) -> None:
    with registered():
        set_job(folder, "succeed")
        assert bpy.ops.wildsmoke.open_log() == {"CANCELLED"}


def check_a_file_of_another_blender_is_aligned_when_it_is_opened(_folder: Path) -> None:
    """A smoke that was saved with another version's shift gets this version's."""
    from wildsmoke.addon.scene.volume import VOXEL_SIZE_PROPERTY

    with registered() as session:
        smoke = bpy.data.objects.new("Smoke", bpy.data.volumes.new("Smoke"))
        smoke[VOXEL_SIZE_PROPERTY] = 0.5
        smoke.delta_location = (9.0, 9.0, 9.0)
        session.on_load(None)
        expected = -0.25 if bpy.app.version < (5, 0, 0) else 0.0
        assert all(abs(value - expected) < 1e-6 for value in smoke.delta_location), tuple(smoke.delta_location)
