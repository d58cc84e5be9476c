"""Smoke before a still camera: as deep as wide, around where the network has it."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from backend.field.rays import optical_depth
from backend.fit.as_wide import as_deep_as_wide, larger, too_near
from backend.fit.region import Pictures, Region
from backend.fit.sharpen import agreed
from backend.geometry.camera import view_at
from backend.prior.predict import Proposal
from backend.prior.window import SHAPE, Stand, stand_before
from synthetic.sweep import Orbit, still_cameras

VIEW = view_at(still_cameras(Orbit(), turned=0.0, width=90, height=160, fps=15.0), 0)
SOURCE = np.array([0.0, 0.0, 2.0])
WIDE, DEEP = 1.0, 4.0  # m, standard deviations of a column


def stand(size: float = 0.5) -> Stand:
    return stand_before(VIEW, np.array([0.0, 0.0, 10.0]), voxel_size=size, shape=SHAPE)


def column(on: Stand, *, lean: float = 0.0, deep: float = DEEP) -> np.ndarray:
    """Much deeper than wide; the higher, the further away by `lean` of it."""
    x, y, z = np.moveaxis(on.lattice.centres(), -1, 0)
    ends = 1 / (1 + np.exp(-(z + 6.0) * 3)) / (1 + np.exp((z - 6.0) * 3))
    return (0.3 * np.exp(-0.5 * ((x / WIDE) ** 2 + ((y - lean * z) / deep) ** 2)) * ends).astype(np.float32)


def squeezed(density: np.ndarray, on: Stand, picture_of: np.ndarray | None = None) -> np.ndarray:
    depth = optical_depth(density if picture_of is None else picture_of, on.lattice, on.seen(VIEW))
    return agreed(as_deep_as_wide(density, on, depth, VIEW, SOURCE), on, depth, VIEW)


def spread(density: np.ndarray, axis: int, size: float) -> float:
    """m: standard deviation of a middle level along an axis."""
    level = density[:, :, density.shape[2] // 2].sum(axis=1 - axis, dtype=np.float64)
    at = size * np.arange(len(level))
    return float(np.sqrt(np.average(np.square(at - np.average(at, weights=level)), weights=level)))


@pytest.mark.parametrize("size", [0.5, 0.4])
def test_what_was_drawn_out_along_the_view_is_as_deep_as_wide(size: float) -> None:
    on = stand(size)
    density = column(on)
    found = squeezed(density, on)
    assert spread(density, 1, size) > 2.4 * spread(density, 0, size)
    assert spread(found, 0, size) == pytest.approx(spread(density, 0, size), rel=0.1), "across it is what the picture shows"
    assert 0.8 < spread(found, 1, size) / spread(found, 0, size) < 1.4


def test_the_picture_stays() -> None:
    on = stand()
    density = column(on)
    before, after = (optical_depth(values, on.lattice, on.seen(VIEW)) for values in (density, squeezed(density, on)))
    smoke = before > 0.1 * before.max()
    assert np.abs(after - before)[smoke].max() < 0.1 * before.max()


def test_levels_keep_their_middles() -> None:
    on = stand()
    density = column(on, lean=0.3)
    found = squeezed(density, on)
    levels = slice(8, -8, 4)
    y = np.arange(density.shape[1])
    was, now = ((y @ values.sum(axis=0) / values.sum(axis=(0, 1)))[levels] for values in (density, found))
    assert np.ptp(was) > 3.0 and np.abs(now - was).max() < 1.0, "voxels"


def test_smoke_that_the_network_does_not_see_stays_what_it_is() -> None:
    on = stand()
    nothing = np.zeros(on.lattice.shape, np.float32)
    assert not squeezed(nothing, on, picture_of=column(on)).any()
    some = column(on)
    assert np.array_equal(as_deep_as_wide(some, on, np.zeros((VIEW.height, VIEW.width), np.float32), VIEW, SOURCE), some)


def test_ten_times_as_large_and_as_far_away_is_the_same() -> None:
    on, density = stand(), column(stand())
    depth = optical_depth(density, on.lattice, on.seen(VIEW))
    matrix = VIEW.camera_to_world.copy()
    matrix[:3, 3] *= 10.0
    far = replace(VIEW, camera_to_world=matrix)
    there = stand_before(far, np.array([0.0, 0.0, 100.0]), voxel_size=5.0, shape=SHAPE)
    near = as_deep_as_wide(density, on, depth, VIEW, SOURCE)
    assert np.allclose(as_deep_as_wide(density, there, depth, far, 10.0 * SOURCE), near, rtol=1e-3, atol=1e-4)


@pytest.mark.parametrize("fineness", [1.0, 1.5])
@pytest.mark.parametrize("lean", [0.0, 0.3])
def test_smoke_stands_where_it_is_taken_to_and_looks_the_same(fineness: float, lean: float) -> None:
    """By its foot: what lies above it does not matter."""
    shape = tuple(round(fineness * size) for size in SHAPE)
    on = stand_before(VIEW, np.array([0.0, 0.0, 10.0]), voxel_size=0.5 / fineness, shape=shape)  # type: ignore[arg-type]
    density = column(on, lean=lean, deep=WIDE)
    forward = on.from_world[1, :3]
    source = VIEW.position + 1.1 * (np.array([0.0, 0.0, 10.0]) - lean * 5.5 * forward - VIEW.position)
    pictures = Pictures(depths=np.zeros((1, 4, 4), np.float32), views=(VIEW,))
    region = Region(centre=np.zeros(3), source=source, voxel_size=0.5, pictures=pictures, fineness=fineness, finer=pictures)
    said = Proposal(stand=on, density=density, velocity=np.ones((*shape, 3), np.float32))
    factor = too_near([said, said], region)
    assert factor == pytest.approx(1.1, abs=0.02)
    placed = larger(said, VIEW.position, factor)
    before, after = (optical_depth(each.density, each.stand.lattice, each.stand.seen(VIEW), step=0.5) for each in (said, placed))
    np.testing.assert_allclose(after, before, atol=1e-3 * before.max())
    assert placed.velocity[0, 0, 0, 0] == pytest.approx(factor)
    centre = on.centres()[3, 4, 5]
    np.testing.assert_allclose(placed.stand.centres()[3, 4, 5], VIEW.position + factor * (centre - VIEW.position), atol=1e-9)
    assert too_near([], region) == too_near([replace(said, density=np.zeros(shape, np.float32))], region) == 1.0
