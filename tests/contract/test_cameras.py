"""cameras.json: what is taken, and that everything else is said in a sentence."""

from __future__ import annotations

import json
import math

import pytest
from hypothesis import given
from hypothesis import strategies as st

from backend.contract.cameras import Cameras, parse_cameras, read_cameras
from backend.contract.errors import BackendError

IDENTITY = [[1.0, 0.0, 0.0, 0.0], [0.0, 1.0, 0.0, 0.0], [0.0, 0.0, 1.0, 0.0], [0.0, 0.0, 0.0, 1.0]]


def turned(azimuth: float, elevation: float, position: tuple[float, float, float]) -> list[list[float]]:
    """A rotation about z, then about x, and a position."""
    ca, sa, ce, se = math.cos(azimuth), math.sin(azimuth), math.cos(elevation), math.sin(elevation)
    rotation = [[ca, -sa * ce, sa * se], [sa, ca * ce, -ca * se], [0.0, se, ce]]
    return [[*row, p] for row, p in zip(rotation, position, strict=True)] + [[0.0, 0.0, 0.0, 1.0]]


def text_of(**changes) -> str:
    data = {"axes": "opencv", "up": "z", "width": 640, "height": 480, "fx": 500.0, "fy": 500.0, "cx": 320.0, "cy": 240.0}
    return json.dumps(data | {"fps": 24.0, "camera_to_world": [IDENTITY]} | changes)


def refused(text: str, **options) -> BackendError:
    with pytest.raises(BackendError) as caught:
        parse_cameras(text, **options)
    assert caught.value.message.endswith(".") and caught.value.hint.endswith(".")
    return caught.value


angle = st.floats(-10, 10)
distance = st.floats(-1e6, 1e6)


@given(st.lists(st.builds(turned, angle, angle, st.tuples(distance, distance, distance)), min_size=1, max_size=4))
def test_rotations_survive_the_way(matrices):
    cameras = parse_cameras(text_of(camera_to_world=matrices))
    assert cameras.is_still == (len(matrices) == 1)
    assert parse_cameras(cameras.to_json()) == cameras
    assert cameras.at(len(matrices) - 1) == tuple(tuple(row) for row in matrices[-1])


def test_a_still_camera_serves_every_frame():
    cameras = parse_cameras(text_of(camera_to_world=IDENTITY), num_frames=99)
    assert cameras.is_still and cameras.at(0) == cameras.at(98)
    moving = parse_cameras(text_of(camera_to_world=[IDENTITY] * 3), num_frames=2)
    with pytest.raises(IndexError):
        moving.at(3)


@pytest.mark.parametrize("num_frames", [4, 99])
def test_too_few_cameras(num_frames):
    error = refused(text_of(camera_to_world=[IDENTITY] * 3), num_frames=num_frames)
    assert error.code == "cameras_too_few" and "3 cameras" in error.message and str(num_frames) in error.message


def changed(row: int, column: int, value: object) -> list[list[object]]:
    matrix: list[list[object]] = [list(entries) for entries in IDENTITY]
    matrix[row][column] = value
    return matrix


@pytest.mark.parametrize(
    ("matrix", "said"),
    [
        (changed(0, 0, math.nan), "NaN"),
        (changed(2, 3, math.inf), "NaN, infinity"),
        (changed(1, 1, "one"), "no number"),
        (changed(1, 1, True), "no number"),
        (changed(1, 1, None), "no number"),
        (changed(0, 0, 0.0), "singular"),
        (changed(0, 0, 1e-12), "singular"),
        (changed(0, 0, 2.0), "not a rotation"),
        (changed(0, 1, 0.1), "not a rotation"),
        (changed(0, 0, -1.0), "mirrors"),
        (changed(3, 0, 0.5), "projects"),
        (changed(3, 3, 2.0), "projects"),
        (IDENTITY[:3], "not 4x4"),
        ([row[:3] for row in IDENTITY], "not 4x4"),
        ([], "not 4x4"),
        ("matrix", "not 4x4"),
    ],
)
def test_each_bad_matrix_has_its_sentence(matrix, said):
    error = refused(text_of(camera_to_world=[IDENTITY, matrix]))
    assert error.code == "cameras_invalid" and said in error.message and "frame 1" in error.message


@pytest.mark.parametrize("key", ["width", "height", "fx", "fy", "cx", "cy", "fps"])
@pytest.mark.parametrize("value", [None, "5", True, math.nan, math.inf, -math.inf, 1e13, [], {}])
def test_each_number_must_be_one(key, value):
    error = refused(text_of(**{key: value}))
    assert error.code == "cameras_invalid" and key in error.message


@pytest.mark.parametrize("key", ["width", "height", "fx", "fy", "fps"])
@pytest.mark.parametrize("value", [0, -1.0])
def test_sizes_are_positive(key, value):
    assert "not positive" in refused(text_of(**{key: value})).message


@pytest.mark.parametrize(
    "changes", [{"width": 640.5}, {"axes": "opengl"}, {"up": "y"}, {"camera_to_world": []}, {"camera_to_world": None}]
)
def test_what_else_is_refused(changes):
    assert refused(text_of(**changes)).code == "cameras_invalid"


@pytest.mark.parametrize("text", ["", "null", "[]", "{", "3", "[" * 100_000])
def test_what_is_no_object_is_refused(text):
    assert refused(text).code == "cameras_invalid"


def test_files_that_cannot_be_read(tmp_path):
    (tmp_path / "binary").write_bytes(b"\xff\xfe\x00")
    for path in (tmp_path / "nothing.json", tmp_path, tmp_path / "binary"):
        with pytest.raises(BackendError) as caught:
            read_cameras(path)
        assert caught.value.code == "cameras_unreadable"
    (tmp_path / "cameras.json").write_text(text_of())
    assert isinstance(read_cameras(tmp_path / "cameras.json"), Cameras)


any_json = st.recursive(
    st.none() | st.booleans() | st.integers() | st.floats() | st.text(),
    lambda inner: st.lists(inner, max_size=4) | st.dictionaries(st.text(), inner, max_size=3),
    max_leaves=20,
)


@given(st.dictionaries(st.sampled_from(["width", "height", "fx", "fy", "cx", "cy", "fps", "camera_to_world", "axes"]), any_json))
def test_any_file_gives_cameras_or_an_error_for_the_user(changes):
    try:
        cameras = parse_cameras(text_of(**changes))
    except BackendError:
        assert refused(text_of(**changes)).code == "cameras_invalid"
        return
    assert parse_cameras(cameras.to_json()) == cameras


@given(st.text() | any_json.map(json.dumps))
def test_any_text_gives_cameras_or_an_error_for_the_user(text):
    assert refused(text).code == "cameras_invalid"
