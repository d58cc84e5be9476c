"""Sets of cameras as truth: what is read, what is refused, and that a scene scores the same in either layout."""

from __future__ import annotations

import json
import shutil
from pathlib import Path

import cv2
import numpy as np
import pytest
from tiny_bench import NUM_FRAMES, NUM_SEEN, cameras, draw_scene, drawn, puffs

from backend.contract.errors import BackendError
from backend.contract.truth import TRUTH_FOLDER
from backend.io.images import srgb_to_linear
from backend.io.particles import ParticlesInfo, ParticlesWriter, read_particles
from backend.score import camera_set
from backend.score.camera_set import on_black, read_camera_set
from backend.score.evaluate import angles, evaluate
from backend.score.finished_job import check_world
from backend.score.particles import ParticlePrediction
from backend.score.read_truth import read_truth
from backend.score.truth_set import read_truth_set

WIND = 0.4
CENTRE = np.array([0.0, 0.0, 1.6])


def write_images(folder: Path, view: str, frames: list[int]) -> None:
    """PNG with alpha, numbered without gaps."""
    folder.mkdir(parents=True)
    for number, frame in enumerate(frames):
        cv2.imwrite(str(folder / f"{number:04d}.png"), drawn(puffs(frame, WIND), cameras(view), frame))


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    """The four views of the small scene: the input in its folder, one with a folder of frames, one beside its video."""
    scene = draw_scene(tmp_path / "scene", wind=WIND)
    place = tmp_path / "set"
    write_images(place / "input", "input", list(range(NUM_FRAMES)))
    write_images(place / "nvs" / "frames", "nvs", [0, 2, 4, 6])
    (place / "input" / "cameras.json").write_text(cameras("input").to_json())
    listed = json.loads(cameras("nvs").to_json()) | {"frames": [0, 2, 4, 6]}
    (place / "nvs" / "cameras.json").write_text(json.dumps(listed))
    write_images(place / "left" / "frames", "side", list(range(NUM_FRAMES)))
    (place / "left" / "cameras.json").write_text(cameras("side").to_json())
    shutil.copy(scene / TRUTH_FOLDER / "nvs" / "smoke.mkv", place / "again.mkv")
    (place / "again.json").write_text(json.dumps(listed))
    return place


@pytest.fixture
def prediction(tmp_path: Path):
    """The particles that the scene was drawn with."""
    path = tmp_path / "particles.h5"
    with ParticlesWriter(path) as writer:
        for frame in range(NUM_FRAMES):
            writer.append(puffs(frame, WIND), is_forecast=frame >= NUM_SEEN)
        writer.finish(ParticlesInfo(cameras=cameras("input"), gravity=(0.0, 0.0, -9.81)))
    with read_particles(path) as particles:
        yield ParticlePrediction(particles)


def test_a_set_is_read(folder: Path) -> None:
    found = read_camera_set(folder, num_seen=NUM_SEEN)
    assert list(found.frames) == ["input", "camera again", "camera left", "camera nvs"]
    assert found.frames["camera nvs"] == found.frames["camera again"] == [0, 2, 4, 6]
    assert found.fps == 10.0 and found.volume_frames() == [] and found.future_views == tuple(found.frames)
    with pytest.raises(KeyError):
        found.volume(0)
    pictures = found.pictures("camera nvs")
    assert len(pictures) == 4 and pictures[2].shape == (64, 48, 4) and pictures[2].dtype == np.float32
    again = found.pictures("camera again")
    assert np.abs(pictures[2] - again[2]).max() < 1e-4


def test_both_layouts_score_the_same(folder: Path, prediction: ParticlePrediction) -> None:
    packed = read_truth_set(folder.parent / "scene")
    of_set = evaluate(prediction, read_camera_set(folder, num_seen=NUM_SEEN), anchor=CENTRE)
    of_scene = evaluate(prediction, packed, anchor=CENTRE)
    assert of_set["volume"] == {} and of_scene["volume"]["correlation"] > 0.99
    for ours, theirs in (("camera nvs", "nvs"), ("input", "input"), ("future_camera nvs", "future_nvs")):
        assert set(of_set[ours]) == set(of_scene[theirs])
        for answer, figures in of_scene[theirs].items():
            for name in ("full_db", "smoke_db", "ssim", "dtssd"):
                value = of_set[ours][answer][name]
                assert value == pytest.approx(figures[name], abs=0.02), (ours, answer, name)
    assert of_set["by_frame_angle"]["camera nvs"] == of_scene["by_frame_angle"]["nvs"]
    assert "future_camera left" in of_set and "future_side" not in of_scene


def test_the_angle_between_cameras(folder: Path) -> None:
    """The input camera turns by 5 degrees a frame about the axis; level cameras, seen from a point at their height."""
    found = angles(read_camera_set(folder, num_seen=NUM_SEEN), CENTRE)
    assert found["camera nvs"] == {"0": 0.0, "2": 10.0, "4": 20.0, "6": 30.0}
    assert found["camera left"]["1"] == pytest.approx(85.0)


def test_a_large_picture_is_averaged_down(folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(camera_set, "MOST_SIDE", 32)
    found = read_camera_set(folder, num_seen=NUM_SEEN)
    assert found.pictures("input")[0].shape == (32, 24, 4)
    view = found.view("input", 3)
    assert (view.width, view.height) == (24, 32) and view.fx == pytest.approx(40.0)


def test_light_on_black() -> None:
    """Straight alpha is multiplied in linear light; without alpha, brightness says where smoke is."""
    image = np.zeros((4, 4, 4), np.uint8)
    image[1, 1] = (128, 64, 32, 51)
    straight = on_black(image, (4, 4), is_premultiplied=False)[1, 1]
    assert straight == pytest.approx([*(0.2 * srgb_to_linear(np.array([128, 64, 32]) / 255)), 0.2], abs=1e-5)
    assert on_black(image, (4, 4), is_premultiplied=True)[1, 1, 0] == pytest.approx(5 * straight[0], rel=1e-4)
    opaque = on_black(image[..., :3], (4, 4), is_premultiplied=False)
    assert opaque[1, 1, 3] == pytest.approx((128 - 5) / 255, abs=1e-5) and opaque[0, 0, 3] == 0.0


def refused(folder: Path, code: str, **options: object) -> str:
    with pytest.raises(BackendError) as caught:
        read_camera_set(folder, **{"num_seen": NUM_SEEN, **options})  # type: ignore[arg-type]
    assert caught.value.code == code and caught.value.hint
    return caught.value.message


def test_what_is_no_set_is_said(folder: Path, tmp_path: Path) -> None:
    (tmp_path / "empty").mkdir()
    refused(tmp_path / "empty", "truth_missing")
    refused(tmp_path / "nowhere", "truth_missing")
    assert "again, input, left, nvs" in refused(folder, "no_input_camera", input_name="front")
    refused(folder, "job_of_other_frames", num_seen=NUM_FRAMES + 1)
    shutil.copytree(folder / "input", tmp_path / "one" / "input")
    refused(tmp_path / "one", "truth_too_small")
    (folder / "again.json").unlink()
    refused(folder, "cameras_missing")


@pytest.mark.parametrize(
    ("frames", "code"),
    [([0, 2, 4], "frames_do_not_match"), ([0, 4, 2, 6], "frames_do_not_match"), ([6, 7, 8, 9], "no_common_frames")],
)
def test_frames_that_do_not_match(folder: Path, frames: list[int], code: str) -> None:
    path = folder / "nvs" / "cameras.json"
    path.write_text(json.dumps(json.loads(path.read_text()) | {"frames": frames}))
    refused(folder, code)


def test_pictures_that_are_missing_or_of_another_shape(folder: Path) -> None:
    (folder / "left" / "more.mkv").write_bytes((folder / "again.mkv").read_bytes())
    assert "more.mkv, frames" in refused(folder, "pictures_missing")
    (folder / "left" / "more.mkv").unlink()
    path = folder / "left" / "cameras.json"
    path.write_text(json.dumps(json.loads(path.read_text()) | {"width": 96}))
    assert "96 x 64" in refused(folder, "cameras_do_not_match")
    shutil.rmtree(folder / "left" / "frames")
    refused(folder, "pictures_missing")


def test_a_background_is_refused(folder: Path) -> None:
    for path in (folder / "left" / "frames").iterdir():
        cv2.imwrite(str(path), cv2.imread(str(path))[..., :3] // 2 + 100)
    found = read_camera_set(folder, num_seen=NUM_SEEN)
    with pytest.raises(BackendError, match="shows a background"):
        found.pictures("camera left")


def test_either_kind_of_truth(folder: Path) -> None:
    assert read_truth(folder, num_seen=NUM_SEEN, input_name="input").name == "set"
    assert read_truth(folder.parent / "scene", num_seen=3, input_name="input").num_seen == NUM_SEEN


def test_cameras_of_another_world_are_refused(folder: Path) -> None:
    truth = read_camera_set(folder, num_seen=NUM_SEEN)
    check_world(cameras("input"), truth, CENTRE)
    with pytest.raises(BackendError, match="stands elsewhere"):
        check_world(cameras("side"), truth, CENTRE)
