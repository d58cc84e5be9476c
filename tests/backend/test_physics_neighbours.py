"""Neighbour lists: against scipy's tree and a brute search, at extremes, and the same for any number of threads."""

from __future__ import annotations

import numba
import numpy as np
import pytest
from scipy.spatial import cKDTree

from backend.physics.neighbours import build_grid, find_neighbours

CLOUDS = {
    "cube": (1.0, 1.0, 1.0),
    "flat": (1.0, 1.0, 1e-9),
    "line": (1.0, 0.0, 0.0),
    "long": (1e6, 1.0, 1.0),
    "tall": (1.0, 1.0, 1e6),
    "tiny": (0.1, 0.1, 0.1),
    "huge": (1e12, 1e12, 1e12),
}


def _lists(positions, radius):
    found = find_neighbours(positions, radius)
    rows = np.split(found.indices, found.starts[1:-1]) if len(positions) else []
    for row in rows:
        assert len(row) == len(np.unique(row)), "a neighbour is listed twice"
    return [set(row.tolist()) for row in rows]


@pytest.mark.parametrize("name", CLOUDS)
@pytest.mark.parametrize("offset", [0.0, -0.5, 1e5])
def test_against_scipy(name, offset):
    positions = (np.random.default_rng(1).random((700, 3)) + offset) * np.array(CLOUDS[name])
    expected = [set(row) - {i} for i, row in enumerate(cKDTree(positions).query_ball_point(positions, 0.13))]
    assert _lists(positions, 0.13) == expected


def test_lattice_by_hand():
    """Inside a cubic lattice: 6 neighbours at 1, 12 more at sqrt 2, 8 more at sqrt 3."""
    axis = np.arange(5.0)
    positions = np.stack(np.meshgrid(axis, axis, axis, indexing="ij"), axis=-1).reshape(-1, 3)
    middle = 62
    assert [len(_lists(positions, radius)[middle]) for radius in (1.01, 1.5, 1.8)] == [6, 18, 26]
    assert len(_lists(positions, 1.0)[middle]) == 0  # closer than the radius, not as far as it


@pytest.mark.parametrize("num", [0, 1, 2])
def test_few_particles(num):
    positions = np.zeros((num, 3))
    assert _lists(positions, 1.0) == [set(range(num)) - {i} for i in range(num)]


def test_no_list_is_cut():
    """A thousand particles in one place: everyone has 999 neighbours."""
    lists = find_neighbours(np.full((1000, 3), 0.3), 0.1)
    assert np.all(np.diff(lists.starts) == 999)


@pytest.mark.parametrize("far", [1e9, 1e30, 1e300])
def test_one_particle_far_away(far):
    positions = np.random.default_rng(2).random((300, 3))
    expected = [set(row) - {i} for i, row in enumerate(cKDTree(positions).query_ball_point(positions, 0.2))]
    assert _lists(np.concatenate([positions, [[far, -far, far]]]), 0.2) == [*expected, set()]


def test_grid_does_not_grow_with_the_extent():
    positions = np.random.default_rng(3).random((100, 3)) * 1e12
    grid = build_grid(positions, 1e-3)
    assert len(grid.starts) <= 2 * 100 + 100
    assert sorted(grid.order) == list(range(100))


def test_same_bytes_for_any_number_of_threads():
    if numba.config.NUMBA_NUM_THREADS < 2:
        pytest.skip("numba was started with one thread")
    positions = np.random.default_rng(4).random((20_000, 3))
    results = []
    for num_threads in (1, 2):
        numba.set_num_threads(num_threads)
        results.append(find_neighbours(positions, 0.06))
    numba.set_num_threads(numba.config.NUMBA_NUM_THREADS)
    assert results[0].starts.tobytes() == results[1].starts.tobytes()
    assert results[0].indices.tobytes() == results[1].indices.tobytes()
