"""A volume squeezed in depth to what its silhouette allows."""

from __future__ import annotations

import cv2
import numpy as np

from backend.field.rays import optical_depth
from backend.fit.depth_prior import DepthPrior, inflate
from backend.fit.gather import gathered
from backend.fit.guide import Guide
from backend.fit.state import VolumeRecord
from backend.geometry.camera import view_at
from backend.prior.window import stand_before
from synthetic.sweep import Orbit, orbit_cameras

VIEW = view_at(orbit_cameras(Orbit(), width=180, height=320, fps=15.0, num_frames=135), 40)
MIDDLE = np.array([0.5, -0.3, 8.0])
STAND = stand_before(VIEW, MIDDLE, voxel_size=0.4, shape=(24, 24, 40))
DEEP = 2.4  # m, standard deviation in depth; sideways and up it is WIDE
WIDE = 0.8


def smear() -> Guide:
    """A blob that is three times as deep as wide."""
    local = STAND.lattice.centres()
    density = np.exp(-0.5 * (np.square(local) / np.square((WIDE, DEEP, WIDE))).sum(axis=-1)).astype(np.float32)
    velocity = np.zeros((*density.shape, 3), np.float32)
    return Guide(VolumeRecord(density=density, velocity=velocity, from_world=STAND.from_world, voxel_size=np.asarray(0.4)))


def solid() -> DepthPrior:
    tau = np.zeros((VIEW.height, VIEW.width), np.float32)
    pixel, depth = VIEW.project(MIDDLE[None])
    cv2.circle(tau, (int(pixel[0, 0]), int(pixel[0, 1])), int(2.0 * WIDE * VIEW.fx / depth[0]), 1.0, -1)
    return inflate(tau, VIEW, MIDDLE)


def spread_of(density: np.ndarray) -> np.ndarray:
    """[3] m: standard deviations along the grid's axes."""
    local = STAND.lattice.centres()
    weight = density / density.sum()
    middle = (local * weight[..., None]).sum(axis=(0, 1, 2))
    return np.sqrt((np.square(local - middle) * weight[..., None]).sum(axis=(0, 1, 2)))


def test_it_becomes_as_deep_as_its_silhouette_allows() -> None:
    guide = smear()
    found = gathered(guide, VIEW, solid(), spread=1.0)
    before, after = spread_of(guide.density), spread_of(found)
    assert before[1] > 2.4 * WIDE
    assert after[1] < 1.3 * WIDE
    np.testing.assert_allclose(after[[0, 2]], before[[0, 2]], rtol=0.2)


def test_the_sums_along_its_rays_stay() -> None:
    guide = smear()
    own = STAND.seen(VIEW)
    before = optical_depth(guide.density, STAND.lattice, own)
    after = optical_depth(gathered(guide, VIEW, solid(), spread=1.0), STAND.lattice, own)
    inside = before > 0.2 * before.max()
    assert np.abs(after / np.maximum(before, 1e-6) - 1.0)[inside].mean() < 0.1


def test_what_is_not_too_deep_stays_as_it_is() -> None:
    guide = smear()
    found = gathered(guide, VIEW, solid(), spread=20.0)
    inner = np.s_[1:-1, 1:-1, 1:-1]
    np.testing.assert_allclose(found[inner], guide.density[inner], atol=0.02)


def test_no_smoke_stays_none() -> None:
    empty = Guide(
        VolumeRecord(
            density=np.zeros((24, 24, 40), np.float32),
            velocity=np.zeros((24, 24, 40, 3), np.float32),
            from_world=STAND.from_world,
            voxel_size=np.asarray(0.4),
        )
    )
    nothing = inflate(np.zeros((VIEW.height, VIEW.width), np.float32), VIEW, MIDDLE)
    assert gathered(empty, VIEW, nothing).max() == 0.0
