"""Runs inside Blender's wheels, see run_checks.py: importing a finished job, and rendering it."""

from __future__ import annotations

import dataclasses
import json
import os
import shutil
from pathlib import Path

import bpy
import numpy as np
from bpy_extras.object_utils import world_to_camera_view
from mathutils import Vector
from wildsmoke.addon.scene import camera, import_result, preview, saving, volume
from wildsmoke.addon.scene.ownership import find_object
from wildsmoke.backend.contract.cameras import Cameras, read_cameras
from wildsmoke.backend.contract.errors import BackendError
from wildsmoke.backend.contract.result import read_result

JOB = Path(os.environ["WILDSMOKE_TEST_JOB"])


def imported(job: Path = JOB) -> tuple[bpy.types.Scene, bpy.types.Object]:
    scene = bpy.context.scene
    return scene, import_result(job, scene=scene)


def smoke_node(smoke: bpy.types.Object) -> bpy.types.Node:
    return smoke.data.materials[0].node_tree.nodes["Wildsmoke Smoke"]


def copied_job(folder: Path) -> Path:
    return Path(shutil.copytree(JOB, folder / "job"))


def change_result(job: Path, **changes: object) -> None:
    path = job / "result.json"
    path.write_text(json.dumps({**json.loads(path.read_text()), **changes}))


def shown_file(smoke: bpy.types.Object) -> str:
    """The file that the evaluated volume shows now."""
    grids = smoke.evaluated_get(bpy.context.evaluated_depsgraph_get()).data.grids
    return Path(grids.frame_filepath).name if grids.load() else ""


def error_code(function, *arguments, **named) -> str:
    try:
        function(*arguments, **named)
    except BackendError as error:
        return error.code
    raise AssertionError("no BackendError")


def check_every_frame_shows_its_file(folder: Path) -> None:
    del folder
    scene, smoke = imported()
    assert (scene.frame_start, scene.frame_end) == (1, 8)
    for frame in range(1, 9):
        scene.frame_set(frame)
        assert shown_file(smoke) == f"smoke_{frame:04d}.vdb", (frame, shown_file(smoke))
    grids = smoke.evaluated_get(bpy.context.evaluated_depsgraph_get()).data.grids
    assert sorted(grid.name for grid in grids) == ["color", "density", "velocity"]
    assert smoke.data.velocity_grid == "velocity"
    assert smoke.data.velocity_unit == "SECOND"


def check_a_clip_that_was_fitted_from_frame_ten_on(folder: Path) -> None:
    job = copied_job(folder)
    change_result(job, frame_start=10)
    scene, smoke = imported(job)
    assert (scene.frame_start, scene.frame_end) == (11, 18)
    assert scene.frame_current == 11
    for frame in (11, 15):
        scene.frame_set(frame)
        assert shown_file(smoke) == f"smoke_{frame - 10:04d}.vdb"


def projected(scene: bpy.types.Scene, filmed_from: bpy.types.Object, point: np.ndarray) -> np.ndarray:
    """Pixel of a world point, from the upper left corner, as Blender sees it."""
    bpy.context.view_layer.update()
    x, y, _ = world_to_camera_view(scene, filmed_from, Vector(point))
    return np.array([x * scene.render.resolution_x, (1.0 - y) * scene.render.resolution_y])


def expected_pixel(cameras: Cameras, frame: int, point: np.ndarray) -> np.ndarray:
    """x right, y down, z forward; fx x/z + cx, fy y/z + cy."""
    to_world = np.array(cameras.at(frame))
    x, y, z = (point - to_world[:3, 3]) @ to_world[:3, :3]
    return np.array([cameras.fx * x / z + cameras.cx, cameras.fy * y / z + cameras.cy])


def check_world_points_fall_on_their_pixels_on_every_frame(folder: Path) -> None:
    del folder
    scene, _ = imported()
    cameras = read_cameras(JOB / "cameras.json")
    filmed_from = scene.camera
    for frame in range(8):
        scene.frame_set(frame + 1)
        for point in ([0.0, 0.0, 0.0], [0.4, -0.3, 2.5], [-0.6, 0.9, 1.1]):
            error = projected(scene, filmed_from, np.array(point)) - expected_pixel(cameras, frame, np.array(point))
            assert np.abs(error).max() < 0.02, (frame, point, error)


def check_uncommon_cameras_project_too(folder: Path) -> None:
    del folder
    scene, _ = imported()
    base, result = read_cameras(JOB / "cameras.json"), read_result(JOB)
    for changes in (
        {"fy": 260.0},
        {"fy": 120.0},
        {"width": 400, "height": 90, "cx": 230.0, "cy": 30.0, "fy": 210.0},
        {"fx": 2.0, "fy": 2.0},
        {"fx": 50000.0, "fy": 50000.0},
        {"cx": -40.0, "cy": 300.0, "fy": 333.0},
    ):
        cameras = dataclasses.replace(base, **changes)
        camera.match(scene.camera, cameras, result)
        camera.match_render(scene, scene.camera, cameras)
        scene.frame_set(4)
        point = np.array([0.1, 0.0, 1.3]) if cameras.fx > 1000 else np.array([0.3, -0.2, 1.9])
        error = projected(scene, scene.camera, point) - expected_pixel(cameras, 3, point)
        assert np.abs(error).max() < 0.05 + 2e-6 * cameras.fx, (changes, error)


def check_a_still_camera_has_no_keys(folder: Path) -> None:
    job = copied_job(folder)
    data = json.loads((job / "cameras.json").read_text())
    data["camera_to_world"] = data["camera_to_world"][:1]
    (job / "cameras.json").write_text(json.dumps(data))
    scene, _ = imported(job)
    assert scene.camera.animation_data is None or scene.camera.animation_data.action is None
    still = read_cameras(job / "cameras.json")
    point = np.array([0.2, 0.1, 1.0])
    assert np.abs(projected(scene, scene.camera, point) - expected_pixel(still, 0, point)).max() < 0.02


def check_a_camera_for_every_frame_of_the_video(folder: Path) -> None:
    """Twelve cameras, frames 4 to 10 fitted: they count from the video's first; the last stays for what has none."""
    del folder
    base, result = read_cameras(JOB / "cameras.json"), read_result(JOB)
    twelve = dataclasses.replace(base, camera_to_world=(base.camera_to_world * 2)[:12])
    later = dataclasses.replace(result, frame_start=4)
    assert [camera.camera_index(twelve, later, frame) for frame in (0, 6, 7, 8)] == [4, 10, 11, 11]
    assert [camera.camera_index(base, later, frame) for frame in (0, 6, 7, 8)] == [0, 6, 7, 7]


def check_size_rate_and_colours_of_the_scene(folder: Path) -> None:
    del folder
    scene, _ = imported()
    render = scene.render
    assert (render.resolution_x, render.resolution_y, render.resolution_percentage) == (120, 160, 100)
    assert abs(render.fps / render.fps_base - 23.976) < 1e-3
    assert (render.engine, scene.view_settings.view_transform) == ("CYCLES", "Standard")
    assert scene.world is not None
    assert scene.cycles.volume_bounces >= 4
    assert scene.camera.data.background_images[0].image is not None


def check_a_second_import_updates_and_doubles_nothing(folder: Path) -> None:
    job = copied_job(folder)
    scene, smoke = imported(job)
    names = ("objects", "volumes", "cameras", "lights", "materials", "node_groups", "collections", "images", "worlds")
    before = {name: len(getattr(bpy.data, name)) for name in names}
    smoke_node(smoke).inputs["Density"].default_value = 3.0
    change_result(job, has_color=False, smoke_color=[0.2, 0.3, 0.4], num_forecast=0)
    again = import_result(job, scene=scene)
    assert again == smoke
    assert {name: len(getattr(bpy.data, name)) for name in names} == before
    assert smoke.data.frame_duration == 7
    assert smoke_node(smoke).inputs["Density"].default_value == 3.0  # the artist's
    assert not smoke_node(smoke).inputs["Filmed Color"].is_linked
    assert np.allclose(smoke_node(smoke).inputs["Filmed Color"].default_value[:3], (0.2, 0.3, 0.4))
    other = copied_job(folder / "other")
    assert import_result(other, scene=scene) != smoke


def check_the_artists_scene_stays_where_asked(folder: Path) -> None:
    del folder
    scene = bpy.context.scene
    scene.render.resolution_x, scene.frame_end, scene.render.engine = 333, 77, "CYCLES"
    own = bpy.data.collections.new("Mine")
    scene.collection.children.link(own)
    smoke = import_result(JOB, scene=scene, collection=own, match_render=False)
    assert smoke.name in own.objects
    assert (scene.render.resolution_x, scene.frame_end) == (333, 77)
    assert scene.camera is None
    assert find_object(JOB, "camera") is not None


def check_opacity_and_colour_are_those_of_the_grid(folder: Path) -> None:
    """exp(-tau) along the rays, within what 16 samples and the denoiser leave."""
    del folder
    scene, _ = imported()
    layer = preview.render_layer(scene, frame=5, samples=16)
    expected = np.load(JOB / "expected.npz")
    solid = expected["opacity"] > 0.02
    assert solid.sum() > 1500
    assert 0.9 < expected["opacity"].max() < 0.999
    error = layer[..., 3] - expected["opacity"]
    assert np.abs(error[solid]).mean() < 0.006, np.abs(error[solid]).mean()
    assert np.abs(error).max() < 0.06, np.abs(error).max()
    assert abs(error[solid].mean()) < 0.002, error[solid].mean()
    color_error = layer[..., :3] - expected["radiance"]
    assert np.abs(color_error[solid]).mean() < 0.006, np.abs(color_error[solid]).mean()
    assert scene.frame_current == 1  # a render leaves the scene as it was
    assert scene.cycles.samples != 16


def check_relighting_keeps_the_opacity_and_is_about_as_bright(folder: Path) -> None:
    del folder
    scene, smoke = imported()
    smoke_node(smoke).inputs["Relight"].default_value = 1.0
    layer = preview.render_layer(scene, frame=5, samples=48)
    expected = np.load(JOB / "expected.npz")
    solid = expected["opacity"] > 0.02
    error = layer[..., 3] - expected["opacity"]
    assert np.abs(error[solid]).mean() < 0.03, np.abs(error[solid]).mean()
    ratio = layer[..., :3][solid].mean() / expected["radiance"][solid].mean()
    assert 0.6 < ratio < 1.6, ratio


def check_density_multiplies_the_extinction(folder: Path) -> None:
    del folder
    scene, smoke = imported()
    smoke_node(smoke).inputs["Density"].default_value = 0.5
    layer = preview.render_layer(scene, frame=5, samples=16)
    expected = 1 - np.sqrt(1 - np.load(JOB / "expected.npz")["opacity"])
    assert np.abs(layer[..., 3] - expected)[expected > 0.02].mean() < 0.006


def check_an_empty_frame_is_empty(folder: Path) -> None:
    del folder
    scene, _ = imported()
    assert not preview.render_layer(scene, frame=8, samples=1)[..., 3].any()


def check_the_preview_lies_over_the_plate(folder: Path) -> None:
    scene, _ = imported()
    preview.render_preview(scene, folder / "p.png", frame=5, samples=8, plate=JOB / "background.png")
    image = bpy.data.images.load(str(folder / "p.png"))
    pixels = np.array(image.pixels[:]).reshape(160, 120, 4)[::-1, :, :3]
    plate = np.array([30, 60, 90]) / 255
    assert np.abs(pixels[:10, :10] - plate).max() < 0.01, pixels[0, 0]
    solid = np.load(JOB / "expected.npz")["opacity"] > 0.9
    assert np.abs(pixels[solid] - plate).max(axis=1).min() > 0.2
    assert [path.name for path in folder.iterdir()] == ["p.png"]
    smaller = folder / "small.png"
    preview.render_preview(scene, smaller, frame=5, samples=1, longest_side=80, plate=JOB / "background.png")
    assert tuple(bpy.data.images.load(str(smaller)).size) == (60, 80)


def check_the_blend_moves_with_its_job(folder: Path) -> None:
    job = copied_job(folder / "here")
    imported(job)
    saving.save_blend(job / "smoke.blend")
    moved = folder / "there"
    shutil.move(job.parent, moved)
    bpy.ops.wm.open_mainfile(filepath=str(moved / "job" / "smoke.blend"))
    smoke = find_object((moved / "job").resolve(), "volume")
    assert smoke is not None
    assert smoke.data.filepath.startswith("//")
    bpy.context.scene.frame_set(3)
    assert shown_file(smoke) == "smoke_0003.vdb"
    assert bpy.context.scene.camera.data.background_images[0].image.filepath.startswith("//")
    assert import_result(moved / "job", scene=bpy.context.scene) == smoke


def check_where_a_grid_is_drawn_is_made_up_for_after_another_version(folder: Path) -> None:
    del folder
    _, smoke = imported()
    right = tuple(smoke.delta_location)
    smoke.delta_location = (9.0, 9.0, 9.0)
    volume.align_all()
    assert tuple(smoke.delta_location) == right
    half = read_result(JOB).voxel_size / 2 if bpy.app.version < (5, 0, 0) else 0.0
    assert np.allclose(right, -half)


def check_what_is_missing_or_damaged_is_said(folder: Path) -> None:
    job = copied_job(folder)
    scene = bpy.context.scene
    assert error_code(import_result, folder / "nowhere", scene=scene) == "not_finished"
    first = job / "vdb" / "smoke_0001.vdb"
    data = first.read_bytes()
    for damaged in (b"", b"no smoke", data[: len(data) // 3]):
        first.write_bytes(damaged)
        assert error_code(import_result, job, scene=scene) == "vdb_damaged", len(damaged)
    first.unlink()
    assert error_code(import_result, job, scene=scene) == "vdb_missing"
    (job / "cameras.json").write_text("{}")
    assert error_code(import_result, job, scene=scene) == "cameras_invalid"
    assert len(bpy.data.objects) == len(bpy.data.volumes) == len(bpy.data.collections) == 0  # nothing half made
    assert error_code(preview.render_layer, scene, frame=1) == "no_camera"


def check_the_sun_stands_where_the_clip_s_did(folder: Path) -> None:
    """A sun shines along its -z. The light keeps the hue of faintly coloured smoke; strongly coloured smoke keeps its own."""
    towards, sun_light, sky = (-0.6, 0.48, 0.64), (0.6, 0.54, 0.48), (0.1, 0.12, 0.15)
    light = {"direction": towards, "sun": sun_light, "ambient": sky, "softness": 0.7, "explained": 0.8, "doubt_degrees": 9.0}
    light |= {"anisotropy": 0.2, "sun_share": 0.9}
    for name, color, hue in (("grey", (0.4, 0.36, 0.32), (1.0, 1.0, 1.0)), ("orange", (0.8, 0.4, 0.2), (1.0, 0.5, 0.25))):
        job = Path(shutil.copytree(JOB, folder / name))
        change_result(job, light=light, smoke_color=color)
        bpy.ops.wm.read_factory_settings(use_empty=True)
        scene = bpy.context.scene
        smoke = import_result(job, scene=scene)
        sun = find_object(job, "sun")
        assert sun is not None
        bpy.context.view_layer.update()
        assert np.allclose((sun.matrix_world.to_3x3() @ Vector((0.0, 0.0, 1.0))), towards, atol=1e-5), name
        wanted = np.array(sun_light) / hue
        assert np.allclose(sun.data.color, wanted / wanted.max(), atol=1e-5), name
        assert np.isclose(sun.data.energy, 10.0 * wanted.max(), rtol=1e-5), name
        world = scene.world.node_tree.nodes["Background"].inputs["Color"].default_value
        assert np.allclose(world[:3], 0.7 * np.array(sky) / hue, atol=1e-5), name
        albedo = smoke_node(smoke).inputs["Albedo"].default_value
        assert np.allclose(np.array(albedo[:3]) / max(albedo[:3]), hue, atol=1e-5), name
        assert np.isclose(smoke_node(smoke).inputs["Anisotropy"].default_value, 0.2), name
