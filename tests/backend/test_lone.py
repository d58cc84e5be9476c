"""Gaussians that stand alone: which they are, and what becomes of them in the view that they were seen in and elsewhere."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from backend.fit.lone import drawn_out, own_shares
from backend.geometry.camera import View
from backend.io.particles import ParticleFrame
from backend.render.picture import picture


def view_from(x: float, y: float) -> View:
    """Level, towards the origin."""
    forward = -np.array([x, y, 0.0]) / np.hypot(x, y)
    right = np.cross(forward, (0.0, 0.0, 1.0))
    matrix = np.eye(4)
    matrix[:3, :3] = np.stack([right, (0.0, 0.0, -1.0), forward], axis=1)
    matrix[:3, 3] = (x, y, 0.0)
    return View(width=80, height=60, fx=200.0, fy=200.0, cx=40.0, cy=30.0, camera_to_world=matrix)


def smoke(*, size: float = 1.0) -> ParticleFrame:
    """A dense ball, and three Gaussians beside it (the last ones)."""
    random = np.random.default_rng(1)
    alone = [[1.6, 0.3, 0.2], [0.2, 1.5, 0.9], [0.4, -1.4, -0.8]]
    positions = size * np.concatenate([random.normal(0.0, 0.35, (400, 3)), alone])
    count = len(positions)
    return ParticleFrame(
        positions=positions, velocities=np.zeros((count, 3), np.float32), scales=np.full(count, 0.15 * size, np.float32),
        optical_masses=np.full(count, 0.02 * size**2, np.float32), colors=np.ones((count, 3), np.float32), ids=np.arange(count),
    )  # fmt: skip


def test_who_stands_alone() -> None:
    shares = own_shares(smoke())
    assert shares[-3:].min() > 0.75
    assert np.median(shares[:-3]) < 0.1
    twins = replace(smoke(), positions=np.repeat(smoke().positions[:1], 403, axis=0))
    assert own_shares(twins).max() < 0.01
    assert not own_shares(replace(smoke(), optical_masses=np.zeros(403, np.float32))).any()


def test_the_own_view_stays_and_beads_are_gone_from_aside() -> None:
    frame, own = smoke(), view_from(0.0, -12.0)
    drawn = drawn_out(frame, own)
    assert drawn.rotations is not None and drawn.scales.shape == (403, 3)
    assert drawn.scales[-3:, 0].min() > 3.0 * 0.15 and np.allclose(drawn.scales[:, 1:], 0.15)
    assert np.allclose(picture(drawn, own), picture(frame, own), atol=0.012)
    aside, row, column = view_from(12.0, 0.0), 16, 65  # of the second one
    before, after = picture(frame, aside)[..., 3], picture(drawn, aside)[..., 3]
    assert (
        before[row - 3 : row + 4, column - 3 : column + 4].max() > 3.0 * after[row - 3 : row + 4, column - 3 : column + 4].max()
    )
    assert after.sum() > 0.95 * before.sum()


def test_any_size_anywhere_and_none() -> None:
    own = view_from(0.0, -12.0)
    for size in (1e-4, 1e4):
        assert np.allclose(own_shares(smoke(size=size)), own_shares(smoke()), atol=1e-3)
    far = replace(smoke(), positions=smoke().positions * np.array([1.0, 1.0, 1e6]))
    assert np.isfinite(drawn_out(far, own).scales).all(), "a grid over all of it would not fit anywhere"
    behind = replace(smoke(), positions=smoke().positions + own.position)
    assert np.isfinite(drawn_out(behind, own).rotations).all()  # type: ignore[arg-type]
    none = drawn_out(ParticleFrame(**{
        name: getattr(smoke(), name)[:0] for name in ("positions", "velocities", "scales", "optical_masses", "colors", "ids")
    }), own)  # fmt: skip
    assert none.count == 0 and none.scales.shape == (0, 3) and none.rotations is not None and none.rotations.shape == (0, 4)
    once = drawn_out(smoke(), own)
    assert drawn_out(once, own) is once
