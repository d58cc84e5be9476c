"""Mesh solids: the .obj reader, distances of a box and a ball against the analytic ones, bad files, smoke that stays out."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from backend.contract.errors import BackendError
from backend.physics.colliders import Box, push_out
from backend.physics.fluid import FluidState, derive_parameters, step
from backend.physics.mesh_collider import make_collider, read_collider, read_obj
from backend.physics.signed_distance import triangle_squared

CUBE = """# a cube from -1 to 1, its sides as quads
v -1 -1 -1
v 1 -1 -1
v 1 1 -1
v -1 1 -1
v -1 -1 1
v 1 -1 1
v 1 1 1
v -1 1 1
vn 0 0 1
f 1 4 3 2
f 5/1 6/2 7/3 8/4
f 1//1 2//1 6//1 5//1
f 3 4 8 7
f 1 5 8 4
f -7 -6 -2 -3
"""


def cube(tmp_path, text=CUBE):
    path = tmp_path / "cube.obj"
    path.write_text(text)
    return path


def ball(num=24):
    """A triangulated unit sphere."""
    turns, heights = np.arange(num) * 2.0 * np.pi / num, np.linspace(0.0, np.pi, num)[1:-1]
    rings = [[np.sin(h) * np.cos(t), np.sin(h) * np.sin(t), np.cos(h)] for h in heights for t in turns]
    vertices = np.array([*rings, [0.0, 0.0, 1.0], [0.0, 0.0, -1.0]])
    triangles = []
    for k in range(num):
        n = (k + 1) % num
        triangles += [(len(rings), k, n), (len(rings) + 1, len(rings) - num + n, len(rings) - num + k)]
        for row in range(len(heights) - 1):
            a, b = row * num, (row + 1) * num
            triangles += [(a + k, b + k, b + n), (a + k, b + n, a + n)]
    return vertices, np.array(triangles, np.int64)


def test_triangle_distance_by_hand():
    a, b, c = (0.0, 0.0, 0.0), (1.0, 0.0, 0.0), (0.0, 1.0, 0.0)
    for point, squared in [((0.2, 0.2, 2.0), 4.0), ((2.0, 0.0, 0.0), 1.0), ((-1.0, -1.0, 1.0), 3.0), ((1.0, 1.0, 0.0), 0.5)]:
        assert triangle_squared(point, a, b, c) == pytest.approx(squared, rel=1e-12)
    assert triangle_squared((0.0, 3.0, 4.0), a, a, a) == pytest.approx(25.0)


def test_reader(tmp_path):
    vertices, triangles = read_obj(cube(tmp_path))
    assert vertices.shape == (8, 3) and triangles.shape == (12, 3)
    assert triangles[-1].tolist() == [1, 6, 5]


def test_cube_against_the_box(tmp_path):
    solid, box = read_collider(cube(tmp_path)), Box(low=(-1.0, -1.0, -1.0), high=(1.0, 1.0, 1.0))
    points = np.random.default_rng(0).uniform(-2.0, 2.0, (2000, 3))
    found, expected = solid.distances(points)[0], box.distances(points)[0]
    assert np.array_equal(found < 0.0, expected < 0.0) or np.abs(expected[(found < 0.0) != (expected < 0.0)]).max() < 0.02
    is_near = np.abs(expected) < 0.05
    assert is_near.sum() > 50
    np.testing.assert_allclose(found[is_near], expected[is_near], atol=0.02)
    np.testing.assert_allclose(found, expected, atol=0.25)  # off the lattice the way leads by its border


def test_ball_normals_point_out():
    vertices, triangles = ball()
    solid = make_collider(3.0 * vertices + 5.0, triangles)
    directions = np.random.default_rng(1).normal(size=(500, 3))
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    for radius, error in ((1.5, 0.3), (2.9, 0.06), (3.1, 0.06)):
        distances, normals = solid.distances(5.0 + radius * directions)
        np.testing.assert_allclose(distances, radius - 3.0, atol=error)
        assert (normals * directions).sum(axis=1).min() > (0.3 if radius < 2.0 else 0.95)
    outside = push_out(5.0 + 2.9 * directions, [solid])
    np.testing.assert_allclose(np.linalg.norm(outside - 5.0, axis=1), 3.0, atol=0.05)


def test_no_particle_deep_inside(tmp_path):
    solid = read_collider(cube(tmp_path))
    positions = np.random.default_rng(2).uniform(-0.8, 0.8, (60, 3)) - [0.0, 0.0, 2.2]
    state = FluidState(
        positions=positions, velocities=np.zeros((60, 3)), masses=np.ones(60), ids=np.arange(60), born=np.zeros(60, np.int32)
    )
    parameters = replace(derive_parameters(positions), buoyancy=(0.0, 0.0, 2.0), drag=0.5, colliders=(solid,))
    for _ in range(50):
        state, _ = step(state, parameters, 0.04)
        assert np.isfinite(state.velocities).all()
        assert solid.distances(state.positions)[0].min() > -0.05
    assert state.positions[:, 2].mean() > -1.5


@pytest.mark.parametrize(
    ("text", "code"),
    [
        ("", "collider_unreadable"),
        ("hello\nworld\n", "collider_unreadable"),
        ("v 0 0 zero\n", "collider_unreadable"),
        ("v 0 0 0\nf 1 2 3\n", "collider_unreadable"),
        ("v 0 0 nan\nv 1 0 0\nv 0 1 0\nf 1 2 3\n", "collider_unreadable"),
        ("v 0 0 0\nv 0 0 0\nv 0 0 0\nf 1 2 3\n", "collider_empty"),
        ("v 0 0 0\nv 1 0 0\nv 0 1 0\nf 1 2 3\n", "collider_open"),
    ],
)
def test_bad_files_have_a_sentence(tmp_path, text, code):
    with pytest.raises(BackendError) as caught:
        read_collider(cube(tmp_path, text))
    assert caught.value.code == code and caught.value.hint


def test_missing_file_and_folder_have_a_sentence(tmp_path):
    for path, code in [(tmp_path / "none.obj", "collider_missing"), (tmp_path, "collider_unreadable")]:
        with pytest.raises(BackendError) as caught:
            read_collider(path)
        assert caught.value.code == code


def test_one_missing_face_still_has_an_inside(tmp_path):
    """Majority of three parities: the top is open, yet the inside stays inside."""
    solid = read_collider(cube(tmp_path, CUBE.replace("f 5/1 6/2 7/3 8/4\n", "")))
    assert solid.distances(np.array([[0.0, 0.0, 0.0], [0.0, 0.0, 3.0]]))[0].tolist()[0] < 0.0
    assert solid.distances(np.array([[0.0, 0.0, 3.0]]))[0][0] > 0.0
