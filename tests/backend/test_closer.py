"""A proposal on finer voxels, with motion that is seen closer."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import pytest

from backend.fit.closer import TRUST, closer
from backend.fit.region import FINER
from backend.geometry.camera import view_at
from backend.prior.predict import Proposal
from backend.prior.window import SHAPE, Stand, stand_before
from synthetic.sweep import Orbit, orbit_cameras

VIEW = view_at(orbit_cameras(Orbit(), width=72, height=128, fps=15.0, num_frames=135), 30)
MIDDLE, VOXEL = np.array([0.5, -0.3, 8.0]), 0.4
COARSE = stand_before(VIEW, MIDDLE, voxel_size=VOXEL, shape=SHAPE)
FINE = stand_before(VIEW, MIDDLE, voxel_size=VOXEL / FINER, shape=(36, 36, 60))
SLOW, FAST = np.array([0.2, 0.5, 1.0], np.float32), np.array([1.2, -0.5, 3.0], np.float32)  # m/s, along a grid's own axes


def saying(stand: Stand, centre: np.ndarray, size: np.ndarray, velocity: np.ndarray) -> Proposal:
    """A puff [3] m large at `centre` [3] m, all of which has one velocity along the grid's own axes."""
    density = np.exp(-0.5 * np.square((stand.centres() - centre) @ stand.from_world[:3, :3].T / size).sum(axis=-1))
    flow = np.broadcast_to(velocity @ stand.from_world[:3, :3], (*density.shape, 3))
    return Proposal(stand=stand, density=density.astype(np.float32), velocity=flow.astype(np.float32))


def asked(velocity: np.ndarray) -> tuple[Callable[[np.ndarray], Proposal], list[Proposal]]:
    """A prior that sees one velocity everywhere, and what it has said."""
    said: list[Proposal] = []

    def ask(middle: np.ndarray) -> Proposal:
        stand = stand_before(VIEW, middle, voxel_size=VOXEL / FINER, shape=SHAPE)
        said.append(saying(stand, middle, np.ones(3), velocity))
        return said[-1]

    return ask, said


def test_motion_across_the_view_is_believed_in_part_and_motion_along_it_is_not() -> None:
    proposal = saying(COARSE, MIDDLE, np.full(3, 0.8), SLOW)
    ask, said = asked(FAST)
    found = closer(proposal, FINE, ask)
    assert len(said) == 1
    inside = found.density > 0.1 * found.density.max()
    wanted = SLOW + TRUST * (FAST - SLOW) * (1.0, 0.0, 1.0)
    own = found.velocity[inside] @ FINE.from_world[:3, :3].T
    np.testing.assert_allclose(own, np.broadcast_to(wanted, own.shape), atol=1e-4)
    far = found.velocity[0, 0, 0] @ FINE.from_world[:3, :3].T
    np.testing.assert_allclose(far, SLOW, atol=1e-4)


def test_density_is_the_proposals_own() -> None:
    proposal = saying(COARSE, MIDDLE, np.full(3, 1.2), SLOW)
    found = closer(proposal, FINE, asked(FAST)[0])
    wanted = saying(FINE, MIDDLE, np.full(3, 1.2), SLOW)
    assert np.abs(found.density - wanted.density).max() < 0.05  # linear between larger voxels
    coarse, fine = (item.density.sum(dtype=np.float64) * item.stand.lattice.voxel_size**3 for item in (proposal, found))
    assert fine == pytest.approx(coarse, rel=0.01)


@pytest.mark.parametrize(
    ("size", "most"), [((0.5, 0.5, 0.5), 1), ((0.8, 0.8, 4.0), 2), ((3.0, 0.8, 4.0), 4), ((0.8, 3.0, 1.0), 1)]
)
def test_few_parts_hold_the_smoke(size: tuple[float, float, float], most: int) -> None:
    proposal = saying(COARSE, MIDDLE - 0.7 * np.eye(3)[2], np.array(size), SLOW)
    ask, said = asked(FAST)
    closer(proposal, FINE, ask)
    assert 1 <= len(said) <= most
    places = np.stack([part.stand.voxels(COARSE.centres()) for part in said])  # [P, X, Y, Z, 3]
    beside = np.array(SHAPE) - 0.5
    held = ((places > -0.5) & (places < beside))[..., [0, 2]].all(axis=-1).any(axis=0)
    assert proposal.density[held].sum() > 0.93 * proposal.density.sum()


def test_where_there_is_no_smoke_nobody_is_asked() -> None:
    nothing = Proposal(stand=COARSE, density=np.zeros(SHAPE, np.float32), velocity=np.zeros((*SHAPE, 3), np.float32))
    ask, said = asked(FAST)
    found = closer(nothing, FINE, ask)
    assert not said
    assert not found.density.any()
    assert not found.velocity.any()
