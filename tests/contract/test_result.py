"""result.json: it survives the way, and a damaged one is never taken for whole."""

from __future__ import annotations

import dataclasses
import json
import math

import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from backend.contract.errors import BackendError
from backend.contract.result import VDB_NAME, Result, read_result

RESULT = Result(
    particles="particles.h5",
    cameras="cameras.json",
    vdb_folder="vdb",
    num_frames=24,
    num_forecast=6,
    frame_start=0,
    fps=24.0,
    voxel_size=0.05,
    has_color=False,
    smoke_color=(0.8, 0.8, 0.8),
    bounds=((-1.0, -1.0, 0.0), (1.0, 1.0, 3.0)),
    buoyancy=(0.0, 0.0, 1.5),
    background_plate="background.png",
    warnings=[{"code": "camera_still", "message": "The camera is taken as still."}],
)


def code_of(folder) -> str:
    with pytest.raises(BackendError) as caught:
        read_result(folder)
    return caught.value.code


def test_it_survives_the_way(tmp_path):
    (tmp_path / "result.json").write_text(RESULT.to_json(), encoding="utf-8")
    assert read_result(tmp_path) == RESULT


def test_what_is_not_finite_is_never_written():
    with pytest.raises(ValueError):
        dataclasses.replace(RESULT, fps=math.nan).to_json()


def test_no_result_is_an_unfinished_job(tmp_path):
    assert code_of(tmp_path) == code_of(tmp_path / "nowhere") == "not_finished"
    (tmp_path / "result.json").mkdir()
    assert code_of(tmp_path) == "not_finished"


@pytest.mark.parametrize("share", [0.0, 0.01, 0.3, 0.7, 0.99])
def test_a_file_that_was_cut_is_never_whole(tmp_path, share):
    text = RESULT.to_json()
    (tmp_path / "result.json").write_text(text[: int(len(text) * share)], encoding="utf-8")
    assert code_of(tmp_path) == "result_unreadable"


@pytest.mark.parametrize(
    "name", [field.name for field in dataclasses.fields(Result) if field.default is dataclasses.MISSING][:-2]
)
def test_every_required_entry_is_required(tmp_path, name):
    data = json.loads(RESULT.to_json())
    del data[name]
    (tmp_path / "result.json").write_text(json.dumps(data), encoding="utf-8")
    assert code_of(tmp_path) == "result_unreadable"


@pytest.mark.parametrize(
    "changes",
    [
        {"format_version": 2},
        {"other": 1},
        {"bounds": ["a"]},
        {"bounds": [[0.0, 0.0], [1.0, 1.0]]},
        {"bounds": [[0.0, 0.0, 0.0]] * 3},
        {"buoyancy": None},
        {"buoyancy": [0.0, 1.0]},
        {"smoke_color": {}},
        {"num_frames": "24"},
        {"num_frames": 24.0},
        {"num_frames": True},
        {"num_forecast": -1},
        {"fps": "24"},
        {"fps": 0.0},
        {"has_color": 1},
        {"particles": None},
        {"background_plate": 3},
        {"warnings": ["a"]},
        {"warnings": [{"code": 1}]},
        {"warnings": {}},
        {"fingerprint": None},
    ],
)
def test_what_else_is_refused(tmp_path, changes):
    (tmp_path / "result.json").write_text(json.dumps(json.loads(RESULT.to_json()) | changes), encoding="utf-8")
    assert code_of(tmp_path) == "result_unreadable"


any_json = st.recursive(
    st.none() | st.booleans() | st.integers() | st.floats() | st.text(),
    lambda inner: st.lists(inner, max_size=3) | st.dictionaries(st.text(), inner, max_size=3),
    max_leaves=8,
)


@settings(suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(any_json)
def test_any_other_json_is_refused(tmp_path, value):
    (tmp_path / "result.json").write_text(json.dumps(value), encoding="utf-8")
    assert code_of(tmp_path) == "result_unreadable"


@settings(suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(st.binary(max_size=200))
def test_any_bytes_are_refused(tmp_path, data):
    (tmp_path / "result.json").write_bytes(data)
    assert code_of(tmp_path) == "result_unreadable"


def test_vdb_names_count_from_one_with_four_digits():
    assert VDB_NAME.format(1) == "smoke_0001.vdb"


@pytest.mark.parametrize("changes", [{"fps": 24}, {"background_plate": None}, {"warnings": []}, {"voxel_size": 1}])
def test_what_is_as_good_is_taken(tmp_path, changes):
    (tmp_path / "result.json").write_text(json.dumps(json.loads(RESULT.to_json()) | changes), encoding="utf-8")
    assert read_result(tmp_path) == dataclasses.replace(RESULT, **changes)
