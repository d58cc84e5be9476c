"""The job and its settings: ranges, presets, overrides, and reading job.json whatever stands in it."""

from __future__ import annotations

import dataclasses
import json
import math

import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from backend.contract import job as contract
from backend.contract.errors import BackendError
from backend.contract.job import Config, Job, checked_job, override, preset_config, read_job, settable_keys

PARTS = [getattr(Config(), field.name) for field in dataclasses.fields(Config)]
SECTIONS = [part for part in PARTS if dataclasses.is_dataclass(part)]
NUMBERS = [
    (type(section), field.name)
    for section in SECTIONS
    for field in dataclasses.fields(section)
    if isinstance(getattr(section, field.name), (int, float)) and not isinstance(getattr(section, field.name), bool)
]


def code_of(action) -> str:
    with pytest.raises(BackendError) as caught:
        action()
    assert caught.value.message.endswith(".") and caught.value.hint.endswith(".")
    return caught.value.code


@pytest.mark.parametrize(("kind", "name"), NUMBERS)
@pytest.mark.parametrize("value", [math.nan, math.inf, -math.inf, 1e300, -1e300])
def test_every_number_has_a_range(kind, name, value):
    with pytest.raises((ValueError, TypeError)):
        kind(**{name: value})


@pytest.mark.parametrize(("kind", "name"), NUMBERS)
def test_text_is_no_number(kind, name):
    with pytest.raises((ValueError, TypeError)):
        kind(**{name: "12"})


def test_every_field_is_described():
    for section in SECTIONS:
        for field in dataclasses.fields(section):
            assert field.name in type(section).__doc__, f"{type(section).__name__}.{field.name} has no unit or meaning"


@pytest.mark.parametrize("preset", contract.PRESETS)
def test_each_preset_is_reachable_and_survives_its_overrides(preset):
    config = preset_config(preset)
    assert override(config, {}) == config
    values = {}
    for key in settable_keys(config):
        section, _, name = key.rpartition(".")
        values[key] = getattr(getattr(config, section) if section else config, name)
    assert override(Config(), values) == config
    assert override(Config(), {key: str(value) for key, value in values.items()}) == config, "as on the command line"


def test_an_unknown_preset_is_named():
    assert code_of(lambda: preset_config("best")) == "unknown_preset"


@pytest.mark.parametrize("key", ["speed", "frames.speed", "frames", "frames.", ".seed", "", "frames.working_size.x", "__class__"])
def test_an_unknown_setting_is_never_ignored(key):
    assert code_of(lambda: override(Config(), {key: 1})) == "unknown_setting"


@pytest.mark.parametrize(
    ("key", "value"),
    [
        ("frames.working_size", "wide"),
        ("frames.working_size", 12.5),
        ("frames.working_size", True),
        ("frames.working_size", 1),
        ("frames.working_size", None),
        ("frames.working_size", []),
        ("physical.drag", "nan"),
        ("physical.drag", "inf"),
        ("physical.learn_buoyancy", "perhaps"),
        ("extraction.mode", "magic"),
        ("seed", -1),
    ],
)
def test_a_bad_value_is_said_with_its_setting(key, value):
    with pytest.raises(BackendError) as caught:
        override(Config(), {key: value})
    assert caught.value.code == "bad_setting" and key in caught.value.message


def test_values_take_the_type_of_their_setting():
    config = override(Config(), {"frames.working_size": "64", "physical.drag": 2, "physical.learn_buoyancy": "off", "seed": 5.0})
    assert (config.frames.working_size, config.physical.drag, config.physical.learn_buoyancy, config.seed) == (64, 2.0, False, 5)
    assert isinstance(config.physical.drag, float) and isinstance(config.seed, int)


@given(
    st.dictionaries(st.sampled_from(settable_keys(Config())), st.none() | st.booleans() | st.integers() | st.floats() | st.text())
)
def test_any_override_gives_a_config_or_an_error_for_the_user(overrides):
    try:
        config = override(Config(), overrides)
    except BackendError:
        assert code_of(lambda: override(Config(), overrides)) == "bad_setting"
        return
    assert override(config, {}) == config


def test_a_job_survives_its_file(tmp_path):
    job = Job(video="a.mp4", preset="draft", cameras="c.json", frame_start=2, frame_stop=9, device="cpu", overrides={"seed": 3})
    (tmp_path / "job.json").write_text(job.to_json(), encoding="utf-8")
    assert read_job(tmp_path / "job.json") == job and job.config().seed == 3
    assert list(json.loads(job.to_json())) == sorted(json.loads(job.to_json())), "the same job gives the same bytes"


@pytest.mark.parametrize(
    ("text", "code"),
    [
        ("", "job_unreadable"),
        ("null", "job_unreadable"),
        ("[]", "job_unreadable"),
        ("[" * 100_000, "job_unreadable"),
        ("\x00", "job_unreadable"),
        ("{}", "job_version"),
        ('{"format_version": 2, "video": "a"}', "job_version"),
        ('{"format_version": 1}', "job_unreadable"),
        ('{"format_version": 1, "video": 3}', "job_unreadable"),
        ('{"format_version": 1, "video": "a", "frame_start": true}', "job_unreadable"),
        ('{"format_version": 1, "video": "a", "speed": 3}', "job_unreadable"),
        ('{"format_version": 1, "video": "a", "preset": "best"}', "unknown_preset"),
        ('{"format_version": 1, "video": "a", "device": "tpu"}', "unknown_device"),
        ('{"format_version": 1, "video": "a", "overrides": {"x.y": 1}}', "unknown_setting"),
        ('{"format_version": 1, "video": "a", "overrides": {"physical.drag": NaN}}', "bad_setting"),
        ('{"format_version": 1, "video": "a", "frame_start": -1}', "bad_frame_range"),
        ('{"format_version": 1, "video": "a", "frame_start": 5, "frame_stop": 5}', "bad_frame_range"),
        ('{"format_version": 1, "video": "a", "frame_stop": 0}', "bad_frame_range"),
    ],
)
def test_each_bad_job_has_its_sentence(tmp_path, text, code):
    (tmp_path / "job.json").write_text(text, encoding="utf-8")
    assert code_of(lambda: read_job(tmp_path / "job.json")) == code


def test_no_file_no_text_and_a_folder(tmp_path):
    assert code_of(lambda: read_job(tmp_path / "job.json")) == "job_missing"
    (tmp_path / "latin").write_bytes(b"\xff\xfe{}")
    assert code_of(lambda: read_job(tmp_path / "latin")) == "job_unreadable"
    assert code_of(lambda: read_job(tmp_path)) == "job_unreadable"


any_json = st.recursive(
    st.none() | st.booleans() | st.integers() | st.floats() | st.text(),
    lambda inner: st.lists(inner, max_size=3) | st.dictionaries(st.text(), inner, max_size=3),
    max_leaves=8,
)


@settings(suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(
    st.dictionaries(
        st.sampled_from(["video", "preset", "cameras", "frame_start", "frame_stop", "device", "overrides", "other"]), any_json
    )
)
def test_any_job_file_gives_a_job_or_an_error_for_the_user(tmp_path, values):
    path = tmp_path / "job.json"
    path.write_text(json.dumps(values | {"format_version": 1}), encoding="utf-8")
    try:
        job = read_job(path)
    except BackendError:
        assert code_of(lambda: read_job(path))
        return
    assert checked_job(job) == job
