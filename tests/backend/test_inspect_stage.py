"""What is decided for clips whose nature is known, that it steers the settings, and that the user has the last word."""

from __future__ import annotations

import dataclasses
import json
import math

import av
import numpy as np
import pytest

from backend.contract.decisions import Decisions, read_decisions
from backend.contract.errors import BackendError
from backend.contract.job import Config, override, preset_config
from backend.fit.colors import error_of_one_hue, hue_of
from backend.fit.stabilise import ImageMotion
from backend.fit.survey import Pace, Survey, decibels, survey
from backend.io.images import encode_srgb
from backend.io.video import open_clip
from backend.reporting import SilentReport
from backend.stages import inspect

H, W = 90, 160
LEAST = math.radians(5.0)


def write_clip(path, images) -> None:
    with av.open(str(path), "w") as container:
        stream = container.add_stream("libx264", rate=24, options={"crf": "10"})
        stream.width, stream.height, stream.pix_fmt = W, H, "yuv420p"
        for image in images:
            container.mux(stream.encode(av.VideoFrame.from_ndarray(encode_srgb(image.astype(np.float32)), format="rgb24")))
        container.mux(stream.encode())


def puffs(*, color, grows: bool, peak: float) -> list[np.ndarray]:
    y, x = np.mgrid[0:H, 0:W]
    images = []
    for k in range(24):
        size = 10 + grows * 0.8 * k
        opacity = np.clip(peak * 1.6 * np.exp(-((x - 80) ** 2 + (y - 50) ** 2) / size**2), 0, 1)
        images.append(opacity[..., None] * np.array(color) * (1 + 0.05 * np.sin(k + x / 3.0))[..., None])
    return images


def decide(path, **settings) -> Decisions:
    changes = {key.replace("__", "."): value for key, value in settings.items()}
    with open_clip(path) as clip:
        return inspect.run(clip, override(Config(), changes), SilentReport(), chosen=changes)[0]


def seen(**changes) -> Survey:
    """A clip of 640 x 360 that nothing is special about."""
    pace = Pace(decode=1e-3, reduce=1e-3, prepare=0.1, extract=1e-3, whole=0.5)
    plain = Survey(
        size=(320, 180),
        source_size=(640, 360),
        num_frames=100,
        mode="on_black",
        mode_reason="It is black.",
        measured={"black_share": 0.9},
        smoke_share=0.2,
        fullest_share=0.3,
        opaque_share=0.1,
        one_hue_error=1e-4,
        detail_errors={0.35: 1e-3, 0.5: 1e-4, 0.7: 1e-5},
        turn=0.0,
        has_cameras=True,
        motion=None,
        pace=pace,
    )
    return dataclasses.replace(plain, **changes)


def moved(displacement: float) -> ImageMotion:
    return ImageMotion(
        frames=(0, 1), to_first=np.tile(np.eye(3), (2, 1, 1)), num_tracks=50, displacement=displacement, parallax=0.0
    )


def test_a_camera_that_moves_without_being_given_is_warned_of() -> None:
    found = inspect.decide(seen(has_cameras=False, motion=moved(0.2)), Config())
    assert [entry.code for entry in found.warnings] == ["camera_moves"] and "20%" in found.warnings[0].message
    assert inspect.decide(seen(has_cameras=False, motion=moved(0.0)), Config()).warnings == ()
    mine = inspect.decide(
        seen(has_cameras=False, motion=moved(0.2)), override(Config(), {"cameras.mode": "still"}), chosen=["cameras.mode"]
    )
    assert mine.warnings == (), "the user knows"


def test_grey_smoke_on_black(tmp_path) -> None:
    write_clip(tmp_path / "a.mp4", puffs(color=[0.6, 0.6, 0.6], grows=True, peak=3.0))
    found = decide(tmp_path / "a.mp4", frames__working_size=80)
    values = {decision.name: decision.value for decision in found.decisions}
    assert values["extraction"] == "on_black" and values["camera"] == "still" and values["depth"] == "silhouette"
    assert values["color"] == "one_hue" and values["resolution"] == "at most 80 px"
    assert found["resolution"].is_overridden and not found["resolution"].sets
    followed = found.followed(Config())
    assert followed.extraction.mode == "on_black" and followed.visual.color == "one_hue" and followed.volume.use_prior
    assert followed.volume.as_deep_as_wide
    assert all(decision.reason.endswith(".") and decision.keys for decision in found.decisions)
    for decision in found.decisions:
        assert decision.reason in found.to_text() and f"--set {decision.keys[0]}" in found.to_text()


def test_coloured_smoke_of_two_hues_needs_three_channels(tmp_path) -> None:
    images = puffs(color=[0.7, 0.3, 0.15], grows=False, peak=0.6)
    for image in images:
        image[:, 80:] = image[:, 80:, ::-1]
    write_clip(tmp_path / "a.mp4", images)
    assert decide(tmp_path / "a.mp4")["color"].value == "full"


def test_clip_without_smoke_is_refused(tmp_path) -> None:
    write_clip(tmp_path / "a.mp4", [np.zeros((H, W, 3))] * 8)
    with pytest.raises(BackendError) as caught:
        decide(tmp_path / "a.mp4")
    assert caught.value.code == "no_smoke"


def test_only_the_frames_that_are_fitted_are_looked_at(tmp_path) -> None:
    images = [np.zeros((H, W, 3))] * 12 + puffs(color=[0.6, 0.6, 0.6], grows=True, peak=3.0)[:12]
    write_clip(tmp_path / "a.mp4", images)
    with open_clip(tmp_path / "a.mp4") as clip:
        part = survey(clip, Config(), SilentReport(), start=12, stop=24)
        whole = survey(clip, Config(), SilentReport(), start=0, stop=24)
        assert part.num_frames == 12 and part.smoke_share > 1.8 * whole.smoke_share > 0.0
        with pytest.raises(BackendError):
            survey(clip, Config(), SilentReport(), start=0, stop=8)


@pytest.mark.parametrize(
    ("changes", "name", "value", "sets"),
    [
        ({"turn": 1.01 * LEAST}, "depth", "prior", {"volume.as_deep_as_wide": False}),
        ({"turn": 0.99 * LEAST}, "depth", "silhouette", {"volume.as_deep_as_wide": True}),
        ({"one_hue_error": 10**-6.5}, "color", "one_hue", {"visual.color": "one_hue"}),
        ({"one_hue_error": 10**-6.3}, "color", "full", {"visual.color": "full"}),
        ({"detail_errors": {0.35: 1e-3, 0.5: 1e-7}}, "resolution", "160 x 90", {"frames.working_size": 160}),
        ({"detail_errors": {0.35: 1e-3, 0.5: 1e-4}}, "resolution", "192 x 108", {}),
        ({"source_size": (150, 100)}, "resolution", "150 x 100", {}),
        ({"mode": "matte"}, "extraction", "matte", {"extraction.mode": "matte"}),
        ({}, "camera", "given", {"cameras.mode": "given"}),
        ({"has_cameras": False}, "camera", "still", {"cameras.mode": "still"}),
        ({"has_cameras": False, "motion": moved(0.0001)}, "camera", "still", {"cameras.mode": "still"}),
        ({"has_cameras": False, "motion": moved(0.2)}, "camera", "moving", {"cameras.mode": "still"}),
    ],
)
def test_each_decision_by_hand(changes, name, value, sets) -> None:
    decision = inspect.decide(seen(**changes), Config())[name]
    assert (decision.value, decision.sets, decision.is_overridden) == (value, sets, False)
    assert override(Config(), decision.sets), "the settings take it"


def test_without_the_prior_there_is_its_silhouette_whatever_the_camera_does() -> None:
    found = inspect.decide(seen(turn=10 * LEAST), override(Config(), {"volume.use_prior": False}), chosen=["volume.use_prior"])
    assert found["depth"].value == "silhouette" and found["depth"].reason.startswith("volume.use_prior is off")
    assert not found.followed(override(Config(), {"volume.use_prior": False})).volume.use_prior


def test_a_small_wisp_needs_few_particles_and_none_is_never_enough() -> None:
    some = inspect.decide(seen(fullest_share=0.01), preset_config("final"))["particles"]
    assert some.value == round(inspect.PARTICLES_A_PIXEL * 0.01 * 480 * 270) and some.sets == {"visual.num_particles": some.value}
    none = inspect.decide(seen(fullest_share=0.0), Config())["particles"]
    assert none.value == inspect.FEWEST_PARTICLES
    coarse = inspect.decide(seen(fullest_share=0.01, detail_errors={0.35: 0.0}), preset_config("final"))["particles"]
    assert coarse.value < some.value, "a smaller picture shows fewer"


@pytest.mark.parametrize(
    ("key", "value", "name"),
    [
        ("extraction.mode", "matte", "extraction"),
        ("cameras.mode", "still", "camera"),
        ("frames.working_size", 300, "resolution"),
        ("volume.as_deep_as_wide", False, "depth"),
        ("visual.color", "full", "color"),
        ("visual.num_particles", 5000, "particles"),
    ],
)
def test_the_user_has_the_last_word(key, value, name) -> None:
    clip = seen(one_hue_error=0.0, detail_errors={0.5: 0.0}, fullest_share=1e-3)
    config = override(Config(), {key: value})
    mine = inspect.decide(clip, config, chosen=[key])
    assert mine[name].is_overridden and mine[name].reason.startswith(f"You set {key}. ")
    section, _, field = key.partition(".")
    assert getattr(getattr(mine.followed(config), section), field) == value
    assert not inspect.decide(clip, config)[name].is_overridden
    left = inspect.decide(clip, override(Config(), {"follow_clip": False}))
    assert all(decision.is_overridden and not decision.sets for decision in left.decisions)


def test_auto_leaves_the_choice_to_the_clip() -> None:
    decision = inspect.decide(seen(one_hue_error=0.0), Config(), chosen=["visual.color", "extraction.mode"])["color"]
    assert decision.value == "one_hue" and not decision.is_overridden


def test_the_published_methods_decide_for_themselves() -> None:
    found = inspect.decide(seen(turn=1.0), override(Config(), {"method": "as_published"}))
    assert [decision.name for decision in found.decisions] == ["extraction", "camera", "resolution"]


def test_what_was_decided_survives_the_way(tmp_path) -> None:
    made = dataclasses.replace(inspect.decide(seen(turn=0.5), Config()), fingerprint="abc")
    (tmp_path / "decisions.json").write_text(made.to_json(), encoding="utf-8")
    assert read_decisions(tmp_path) == made


@pytest.mark.parametrize(
    "change",
    [
        {"format_version": 2},
        {"decisions": [{"name": 1}]},
        {"decisions": None},
        {"warnings": [{"code": 1, "message": ""}]},
        {"fingerprint": 3},
        {
            "decisions": [
                {"name": "a", "value": 1.5, "reason": "", "measured": {}, "sets": {}, "keys": [], "is_overridden": False}
            ]
        },
        {
            "decisions": [
                {"name": "a", "value": 1, "reason": "", "measured": {}, "sets": {"x": 1}, "keys": [], "is_overridden": False}
            ]
        },
    ],
)
def test_damaged_decisions_are_refused(tmp_path, change) -> None:
    data = json.loads(inspect.decide(seen(), Config()).to_json()) | change
    (tmp_path / "decisions.json").write_text(json.dumps(data), encoding="utf-8")
    with pytest.raises(BackendError) as caught:
        read_decisions(tmp_path)
    assert caught.value.code == "decisions_unreadable"
    with pytest.raises(BackendError) as caught:
        read_decisions(tmp_path / "nowhere")
    assert caught.value.code == "no_decisions"


def test_one_hue_by_hand() -> None:
    hue = np.array([0.9, 0.5, 0.2])
    brightness = np.random.default_rng(0).random((8, 9, 1))
    layer = np.concatenate([brightness * hue, np.ones((8, 9, 1))], axis=2).astype(np.float32)
    found = hue_of([layer, np.zeros_like(layer)])
    np.testing.assert_allclose(found / np.linalg.norm(found), hue / np.linalg.norm(hue), atol=1e-6)
    assert error_of_one_hue([layer], found) < 1e-12
    assert error_of_one_hue([layer[..., [2, 1, 0, 3]]], found) > 1e-2
    np.testing.assert_array_equal(hue_of([np.zeros_like(layer)]), np.ones(3))
    assert error_of_one_hue([np.zeros_like(layer)], np.zeros(3)) == 0.0
    assert decibels(0.0) == 99.0 and decibels(0.01) == pytest.approx(20.0)
