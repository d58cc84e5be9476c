"""The mean motion of the smoke on each ray: what pictures show of it is found, what they do not show stays as proposed."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from backend.field.rays import optical_depth
from backend.fit.guide import Guide
from backend.fit.ray_motion import _slope, followed
from backend.fit.state import VolumeRecord
from backend.geometry.camera import View

SECONDS = 0.1
SHAPE = (20, 14, 26)
VOXEL = 0.4
TRUE = np.array([0.9, 0.0, 1.6])  # m/s


def camera() -> View:
    """30 m before the origin; x to the right, z up."""
    matrix = np.eye(4)
    matrix[:3, :3] = np.array([[1.0, 0.0, 0.0], [0.0, 0.0, -1.0], [0.0, 1.0, 0.0]]).T
    matrix[:3, 3] = (0.0, -30.0, 0.0)
    return View(width=120, height=160, fx=360.0, fy=360.0, cx=60.0, cy=80.0, camera_to_world=matrix)


def puffs(seconds: float, *, unit: float = 1.0) -> np.ndarray:
    """[X, Y, Z] 1/m: some puffs that all go on with TRUE."""
    axes = [VOXEL * (np.arange(count) - 0.5 * (count - 1)) for count in SHAPE]
    points = np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1)
    draw = np.random.default_rng(5)
    density = np.zeros(SHAPE)
    for place in draw.uniform((-1.5, -0.8, -2.5), (1.5, 0.8, 2.5), (12, 3)):
        density += np.exp(-0.5 * np.square((points - place - seconds * TRUE) / 0.5).sum(axis=-1))
    return (0.4 / unit * density).astype(np.float32)


def guide(velocity: np.ndarray, *, unit: float = 1.0, density: np.ndarray | None = None) -> Guide:
    """Of the moment 0, with one velocity everywhere; unit: of all lengths, m."""
    field = np.broadcast_to(np.asarray(velocity, np.float32) * np.float32(unit), (*SHAPE, 3)).copy()
    record = VolumeRecord(
        density=puffs(0.0, unit=unit) if density is None else density,
        velocity=field,
        from_world=np.eye(4),
        voxel_size=np.asarray(VOXEL * unit),
    )
    return Guide(record)


def shots(*frames: int, unit: float = 1.0) -> tuple[list[np.ndarray], list[View]]:
    """Optical depths and views."""
    view = camera()
    matrix = view.camera_to_world.copy()
    matrix[:3, 3] *= unit
    view = replace(view, camera_to_world=matrix)
    lattice = guide(TRUE, unit=unit).lattice
    depths = [optical_depth(puffs(frame * SECONDS, unit=unit), lattice, view, step=0.25) for frame in frames]
    return depths, [view] * len(depths)


def off(velocity: np.ndarray) -> np.ndarray:
    """[2] m/s: root mean square error sideways and up, by density."""
    weights = np.broadcast_to(puffs(0.0)[..., None], velocity.shape)
    return np.sqrt(np.average(np.square(velocity - TRUE), axis=(0, 1, 2), weights=weights))[[0, 2]]


@pytest.mark.parametrize("frames", [(-1, 0, 1), (-1, 0), (0, 1)])
def test_a_proposal_that_is_wrong_is_corrected(frames: tuple[int, ...]) -> None:
    for wrong in ((0.0, 0.0, 0.8), (0.5, 0.0, 2.4), (1.8, 0.0, 1.6)):
        proposal = guide(np.array(wrong))
        found = followed(proposal, *shots(*frames), frames.index(0), seconds=SECONDS)
        assert np.hypot(*off(found)) < 0.6 * np.hypot(*off(proposal.velocity)), wrong


def test_a_right_one_stays_and_motion_in_depth_is_not_touched() -> None:
    proposal = guide(TRUE + np.array([0.0, 0.7, 0.0]))
    found = followed(proposal, *shots(-1, 0, 1), 1, seconds=SECONDS)
    assert np.all(off(found) < 0.12)
    np.testing.assert_array_equal(found[..., 1], proposal.velocity[..., 1])


def test_all_smoke_of_a_ray_is_changed_alike_and_where_there_is_none_hardly() -> None:
    proposal = guide(np.array([0.0, 0.0, 0.8]))
    change = followed(proposal, *shots(-1, 0, 1), 1, seconds=SECONDS) - proposal.velocity
    np.testing.assert_allclose(change, np.broadcast_to(change[:, :1], change.shape), atol=1e-6)
    assert np.abs(change[0, 0]).max() < 0.1 * np.abs(change).max()


def test_it_knows_neither_metres_nor_seconds() -> None:
    """Lengths a thousand times as large, times ten times: speeds are a hundred times as large."""
    wrong = np.array([0.0, 0.0, 0.8])
    plain = followed(guide(wrong), *shots(-1, 0, 1), 1, seconds=SECONDS)
    large = followed(guide(0.1 * wrong, unit=1000.0), *shots(-1, 0, 1, unit=1000.0), 1, seconds=10 * SECONDS)
    np.testing.assert_allclose(large / 100.0, plain, atol=2e-3)


def test_what_crosses_more_than_a_voxel_in_a_frame_keeps_its_velocity() -> None:
    proposal = guide(np.array([0.0, 0.0, 1.1 * VOXEL / SECONDS]))
    assert followed(proposal, *shots(-1, 0, 1), 1, seconds=SECONDS) is proposal.velocity


def test_no_smoke_at_all_and_none_in_the_picture_keep_it_too() -> None:
    empty = guide(TRUE, density=np.zeros(SHAPE, np.float32))
    assert followed(empty, *shots(-1, 0, 1), 1, seconds=SECONDS) is empty.velocity
    proposal = guide(TRUE)
    depths, views = shots(-1, 0, 1)
    dark = [np.zeros_like(depth) for depth in depths]
    assert followed(proposal, dark, views, 1, seconds=SECONDS) is proposal.velocity
    turned = camera().camera_to_world @ np.diag([1.0, -1.0, -1.0, 1.0])  # looks away
    behind = [replace(view, camera_to_world=turned) for view in views]
    found = followed(proposal, depths, behind, 1, seconds=SECONDS)
    np.testing.assert_array_equal(found, proposal.velocity)


def test_what_is_beside_the_picture_tells_nothing() -> None:
    """Half of the smoke is out of sight: there nothing is seen to leave or come, and nothing is changed."""
    proposal = guide(np.array([0.0, 0.0, 0.8]))
    depths, views = shots(-1, 0, 1)
    seen = [depth[:, :60] for depth in depths]
    change = followed(proposal, seen, [replace(view, width=60) for view in views], 1, seconds=SECONDS) - proposal.velocity
    assert np.abs(change[14:]).max() < 0.05 * np.abs(change).max()
    assert np.abs(change[:9]).max() == np.abs(change).max()


def test_the_slope_is_the_negative_of_its_adjoint() -> None:
    draw = np.random.default_rng(0)
    a, b = draw.normal(size=(2, 7, 9))
    for axis in (0, 1):
        assert float((_slope(a, axis) * b).sum()) == pytest.approx(-float((a * _slope(b, axis)).sum()))
    by_hand = _slope(np.arange(4.0)[None] ** 2, 1)
    np.testing.assert_allclose(by_hand, [[0.5, 2.0, 4.0, -2.0]])


def test_the_same_bytes_each_time() -> None:
    proposal = guide(np.array([0.0, 0.0, 0.8]))
    first, second = (followed(proposal, *shots(-1, 0, 1), 1, seconds=SECONDS) for _ in range(2))
    assert first.tobytes() == second.tobytes()
