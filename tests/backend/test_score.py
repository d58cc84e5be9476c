"""Scores and trivial answers: hand values, and what must hold whatever the picture."""

from __future__ import annotations

import json
from pathlib import Path
from typing import ClassVar

import numpy as np
import pytest

from backend.contract.errors import BackendError
from backend.geometry.camera import View
from backend.score import baselines, measures
from backend.score.compare import best_trivial, lead
from backend.score.evaluate import evaluate
from backend.score.text_table import table
from backend.score.truth_set import Volume, read_truth_set
from backend.score.volumes import camera_axes

SHIPPED = Path(__file__).resolve().parents[2] / "synthetic" / "bench"
SCENES = sorted(path.name for path in SHIPPED.glob("*"))


def camera(azimuth: float) -> View:
    """At 10 m from the origin, level, looking at it."""
    c, s = np.cos(np.radians(azimuth)), np.sin(np.radians(azimuth))
    matrix = np.eye(4)
    forward, down = np.array([-c, -s, 0.0]), np.array([0.0, 0.0, -1.0])
    matrix[:3, :3] = np.stack([np.cross(down, forward), down, forward], axis=1)
    matrix[:3, 3] = 10.0 * np.array([c, s, 0.0])
    return View(width=60, height=40, fx=50.0, fy=50.0, cx=30.0, cy=20.0, camera_to_world=matrix)


def blob(column: float, row: float, *, width: float = 3.0) -> np.ndarray:
    y, x = np.mgrid[0:40, 0:60] + 0.5
    weight = np.exp(-0.5 * ((x - column) ** 2 + (y - row) ** 2) / width**2)
    return np.repeat(weight[..., None], 4, axis=2).astype(np.float32)


def test_decibels_by_hand() -> None:
    assert measures.decibels(0.01) == pytest.approx(20.0)
    assert measures.decibels(0.0) == measures.LARGEST_DB
    assert np.isnan(measures.decibels(float("nan")))


def test_errors_are_of_coded_light_on_black() -> None:
    truth = np.zeros((40, 60, 4), np.float32)
    truth[10, 10] = (0.2140411, 0.2140411, 0.2140411, 0.5)  # codes to 0.5
    full, smoke = measures.squared_errors(np.zeros_like(truth), truth)
    assert full == pytest.approx(0.25 / truth[..., 0].size, rel=1e-5)
    assert smoke == pytest.approx(0.25 / measures.smoke_mask(truth).sum(), rel=1e-5)
    assert 40 < measures.smoke_mask(truth).sum() < 81  # a disc of 4 px


def test_without_smoke_there_is_no_smoke_figure() -> None:
    full, smoke = measures.squared_errors(np.zeros((8, 8, 4)), np.zeros((8, 8, 4)))
    assert full == 0.0 and np.isnan(smoke)


def test_correlation_by_hand() -> None:
    values = np.array([1.0, 2.0, 3.0])
    assert measures.correlation(values, 5 * values + 2) == pytest.approx(1.0)
    assert measures.correlation(values, -values) == pytest.approx(-1.0)
    assert np.isnan(measures.correlation(values, np.ones(3)))


def test_relative_error_by_hand() -> None:
    truth = np.zeros((2, 2, 2))
    truth[0, 0, 0] = 4.0
    assert measures.relative_l2(np.zeros_like(truth), truth) == pytest.approx(1.0)
    assert measures.relative_l2(0.5 * truth, truth) == pytest.approx(0.5)


def test_velocity_is_scored_inside_the_smoke_and_along_the_axes() -> None:
    random = np.random.default_rng(0)
    truth = random.normal(size=(6, 5, 4, 3))
    density = np.zeros((6, 5, 4))
    density[1:5, 1:4, 1:3] = 1.0
    ours = np.where(density[..., None] > 0, truth, 1e6)
    axes = np.linalg.qr(random.normal(size=(3, 3)))[0]
    found = measures.velocity_scores(ours, truth, density, axes)
    assert found["correlation_up"] == pytest.approx(1.0) and found["end_point_error"] == 0.0
    turned = measures.velocity_scores(np.stack([truth[..., 0], 0 * truth[..., 1], truth[..., 2]], -1), truth, density, np.eye(3))
    assert turned["correlation_sideways"] == pytest.approx(1.0) and np.isnan(turned["correlation_up"])
    assert turned["end_point_error"] == pytest.approx(np.sqrt(np.mean(truth[1:5, 1:4, 1:3, 1] ** 2)))


@pytest.mark.parametrize("name", baselines.TRIVIAL)
def test_trivial_answers_have_the_shape(name: str) -> None:
    picture = blob(20.0, 15.0)
    found = baselines.trivial_view(name, picture, camera(-90.0), camera(-60.0), np.zeros(3))
    assert found.shape == picture.shape and np.isfinite(found).all()


def test_mirror_and_copy() -> None:
    picture = blob(20.0, 15.0)
    views = camera(-90.0), camera(30.0)
    assert np.array_equal(baselines.trivial_view("copy", picture, *views, np.zeros(3)), picture)
    assert np.allclose(baselines.trivial_view("mirror", picture, *views, np.zeros(3)), blob(40.0, 15.0), atol=1e-6)


def test_a_billboard_is_a_plane_in_space() -> None:
    seen, wanted = camera(-90.0), camera(-50.0)
    same = baselines.trivial_view("billboard", blob(22.0, 15.0), seen, seen, np.zeros(3))
    assert np.abs(same - blob(22.0, 15.0)).max() < 1e-3
    # What is drawn at a pixel of the picture lies where its ray meets the plane through the anchor.
    anchor = np.array([0.5, -1.0, 0.3])
    depth = seen.to_camera(anchor[None])[0, 2]
    target, _ = wanted.project(seen.unproject(np.array([[22.0, 15.0]]), np.array([depth])))
    picture = blob(22.0, 15.0, width=1.2)  # narrow: perspective moves the middle of what is wide
    moved = baselines.trivial_view("billboard", picture, seen, wanted, anchor)[..., 3].astype(np.float64)
    rows, columns = np.indices(moved.shape) + 0.5
    middle = np.array([(moved * columns).sum(), (moved * rows).sum()]) / moved.sum()
    assert np.linalg.norm(middle - target[0]) < 0.1


def test_a_billboard_behind_the_camera_is_nothing() -> None:
    found = baselines.trivial_view("billboard", blob(22.0, 15.0), camera(-90.0), camera(90.0), np.array([0.0, 30.0, 0.0]))
    assert not found.any()


@pytest.mark.parametrize("text", ["", "{}", '{"views": 3}', "[1]"])
def test_a_folder_without_truth_is_said(tmp_path: Path, text: str) -> None:
    (tmp_path / "truth").mkdir()
    (tmp_path / "truth" / "truth.json").write_text(text)
    with pytest.raises(BackendError, match="no benchmark scene"):
        read_truth_set(tmp_path)


@pytest.mark.parametrize("name", SCENES)
def test_the_set_in_the_tree_is_read(name: str) -> None:
    scene = read_truth_set(SHIPPED / name)
    assert scene.name == name and scene.num_frames == 135 and scene.num_seen == 120
    pictures = scene.pictures("side")
    assert pictures.shape == (len(scene.frames["side"]), 320, 180, 4)
    assert pictures.min() >= 0.0 and pictures.max() <= 1.0 and pictures[-1, ..., 3].max() > 0.1
    assert scene.volume_frames(with_velocity=True)[1] == 15
    volume = scene.volume(15)
    assert volume.velocity is not None and volume.velocity.shape == (*volume.density.shape, 3)
    with pytest.raises(KeyError):
        scene.volume(7)


@pytest.mark.parametrize("name", SCENES)
def test_true_volumes_stand_where_the_pictures_show_them(name: str) -> None:
    """The middle of the true optical depth, projected, is the middle of that in every rendered view."""
    scene = read_truth_set(SHIPPED / name)
    frame = 90
    volume = scene.volume(frame)
    cells = np.argwhere(volume.density > 0.02)
    masses = volume.density[tuple(cells.T)]
    points = volume.origin + volume.voxel_size * cells
    for view in ("input", "nvs", "side", "back"):
        place = scene.view(view, frame)
        pixels, depth = place.project(points)
        inside = (pixels > 0).all(1) & (pixels[:, 0] < place.width) & (pixels[:, 1] < place.height)
        weights = masses[inside] / depth[inside] ** 2
        expected = (weights[:, None] * pixels[inside]).sum(0) / weights.sum()
        opacity = scene.pictures(view)[scene.frames[view].index(frame), ..., 3].astype(np.float64)
        tau = -np.log1p(-np.clip(opacity, 0, 0.999))
        rows, columns = np.indices(tau.shape) + 0.5
        middle = np.array([(tau * columns).sum(), (tau * rows).sum()]) / tau.sum()
        assert np.abs(middle - expected).max() < 12.0, (view, middle, expected)


def test_truth_keeps_its_settings() -> None:
    for name in SCENES:
        truth = json.loads((SHIPPED / name / "truth" / "truth.json").read_text())
        assert truth["simulation"]["scene"]["name"] == name
        assert truth["render"]["preset"] == "bench"


class Perfect:
    """Answers with the truth, whatever it is asked, and knows no more than its pictures."""

    def __init__(self, scene: TinyTruth, *, brightness: float = 1.0) -> None:
        self.scene = scene
        self.num_frames = scene.num_frames
        self.brightness = brightness

    def picture(self, view: View, frame: int) -> np.ndarray:
        return self.scene.draw(view, frame) * np.float32(self.brightness)

    def volume(self, like: Volume, frame: int) -> tuple[np.ndarray, np.ndarray]:
        assert like.velocity is None or like.velocity.shape[:3] == like.density.shape
        real = self.scene.volume(frame)
        velocity = np.zeros((*real.density.shape, 3)) if real.velocity is None else real.velocity
        return self.brightness * real.density, velocity


class TinyTruth:
    """A ball that rises and drifts, in four views; six frames seen, two to come."""

    name, num_frames, num_seen, fps = "ball", 8, 6, 2.0
    frames: ClassVar = {"input": list(range(8)), "nvs": [0, 2, 4, 6], "side": [0, 5], "back": [0, 5]}
    future_views = ("input", "nvs")
    azimuths: ClassVar = {"nvs": -90.0, "side": 30.0, "back": 90.0}

    def view(self, name: str, frame: int) -> View:
        return camera(-90.0 + 7.0 * frame if name == "input" else self.azimuths[name])

    def draw(self, view: View, frame: int) -> np.ndarray:
        pixel, _ = view.project(np.array([[0.3 * frame - 0.5, 0.4, 0.35 * frame - 1.0]]))
        return blob(pixel[0, 0], pixel[0, 1])

    def pictures(self, name: str) -> np.ndarray:
        return np.stack([self.draw(self.view(name, frame), frame) for frame in self.frames[name]])

    def volume_frames(self, *, with_velocity: bool = False) -> list[int]:
        return [0, 3] if with_velocity else [0, 3, 6]

    def volume(self, frame: int) -> Volume:
        random = np.random.default_rng(frame)
        velocity = random.normal(size=(4, 4, 4, 3)) if frame in (0, 3) else None
        return Volume(density=random.uniform(size=(4, 4, 4)), velocity=velocity, voxel_size=0.5, origin=np.zeros(3))


def test_the_truth_itself_gets_full_marks() -> None:
    scene = TinyTruth()
    scores = evaluate(Perfect(scene), scene, anchor=np.zeros(3))  # type: ignore[arg-type]
    for view in ("input", "nvs", "side", "back", "future_input", "future_nvs"):
        assert scores[view]["ours"]["full_db"] == measures.LARGEST_DB, view
        for name, found in scores[view].items():
            assert name == "ours" or found["full_db"] < measures.LARGEST_DB, (view, name)
    volume = scores["volume"]
    assert volume["correlation"] == pytest.approx(1.0) and volume["mass_ratio"] == pytest.approx(1.0)
    assert volume["relative_l2"] == pytest.approx(0.0) and volume["velocity"]["correlation_depth"] == pytest.approx(1.0)
    assert "ours" in table(scores) and "billboard" in table(scores)
    json.dumps(scores, allow_nan=False)


def test_what_is_wrong_scores_lower() -> None:
    scene = TinyTruth()
    scores = evaluate(Perfect(scene, brightness=0.7), scene, anchor=np.zeros(3))  # type: ignore[arg-type]
    assert scores["input"]["ours"]["full_db"] < 40.0
    assert scores["volume"]["mass_ratio"] == pytest.approx(0.7)
    assert scores["volume"]["relative_l2"] == pytest.approx(0.3)
    name, value = best_trivial(scores["nvs"], "full_db")
    assert name in {*baselines.TRIVIAL, "still mean"} and value == max(
        found["full_db"] for answer, found in scores["nvs"].items() if answer != "ours"
    )


def test_a_prior_is_scored_as_the_reconstruction_is() -> None:
    scene = TinyTruth()
    scores = evaluate(Perfect(scene, brightness=0.5), scene, anchor=np.zeros(3), prior=Perfect(scene))  # type: ignore[arg-type]
    assert scores["prior_volume"]["mass_ratio"] == pytest.approx(1.0) and scores["volume"]["mass_ratio"] == pytest.approx(0.5)
    assert scores["prior_volume"]["velocity"]["correlation_up"] == pytest.approx(1.0)
    assert "prior_volume" in table(scores)
    assert "prior_volume" not in evaluate(Perfect(scene), scene, anchor=np.zeros(3))  # type: ignore[arg-type]


def test_the_future_is_beside_what_is_frozen() -> None:
    """A forecast that holds the last moment still is the frozen reconstruction; frozen trivial answers know nothing later."""

    class Frozen(Perfect):
        def picture(self, view: View, frame: int) -> np.ndarray:
            return super().picture(view, min(frame, scene.num_seen - 1))

    scene = TinyTruth()
    for view in ("future_input", "future_nvs"):
        found = evaluate(Frozen(scene), scene, anchor=np.zeros(3))[view]  # type: ignore[arg-type]
        assert found["ours"] == found["frozen reconstruction"]
        assert {"frozen copy", "frozen mirror", "frozen billboard", "still mean", "black", "grey"} < set(found)
        assert "first_db" not in found["ours"]
        assert lead(found, "full_db", kind="frozen rec") == 0.0
    last = scene.num_seen - 1
    error = measures.squared_errors(scene.draw(scene.view("input", last), last), scene.draw(scene.view("nvs", 6), 6))[0]
    assert found["frozen copy"]["by_frame_db"] == {"6": pytest.approx(measures.decibels(error), abs=1e-3)}


def test_the_best_trivial_answer_is_never_ours() -> None:
    answers = {"ours": {"db": 30.0}, "copy": {"db": 25.0}, "frozen copy": {"db": 28.5}, "black": {"db": None}}
    assert best_trivial(answers, "db") == ("frozen copy", 28.5)
    assert best_trivial(answers, "db", kind="copy") == ("copy", 25.0)
    assert lead(answers, "db") == 1.5 and lead(answers, "db", kind="copy") == 5.0
    assert lead({**answers, "ours": {"db": None}}, "db") is None


def test_thirds_follow_the_seen_frames() -> None:
    scene = TinyTruth()
    copy = evaluate(Perfect(scene), scene, anchor=np.zeros(3))["nvs"]["copy"]  # type: ignore[arg-type]
    by_frame = copy["by_frame_db"]
    assert list(by_frame) == ["0", "2", "4"]  # frame 6 is the future
    assert copy["first_db"] == by_frame["0"] == measures.LARGEST_DB
    assert copy["middle_db"] == by_frame["2"] and copy["last_db"] == by_frame["4"]
    assert by_frame["4"] < by_frame["2"] < by_frame["0"]


def test_axes_of_a_view_are_level() -> None:
    axes = camera_axes(camera(-90.0))
    assert np.allclose(axes, [[1, 0, 0], [0, 0, 1], [0, 1, 0]], atol=1e-12)
