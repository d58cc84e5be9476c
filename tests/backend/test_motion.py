"""The velocity field of Gaussians: what their width would blur is given back, and it is known beyond them."""

import dataclasses

import numpy as np
import pytest

from backend.geometry.lattice import Lattice
from backend.io.particles import ParticleFrame
from backend.render.motion import beyond, unblurred
from backend.render.voxelize import voxelize

LATTICE = Lattice(origin=(0.0, 0.0, 0.0), voxel_size=0.1, shape=(41, 41, 41))


def vortex(count: int = 6000, *, scale: float = 0.25) -> ParticleFrame:
    """Evenly spread Gaussians [m] in waves 2 m long."""
    chance = np.random.default_rng(0)
    positions = chance.uniform(0.0, 4.0, (count, 3)).astype(np.float32)
    return ParticleFrame(
        ids=np.arange(count, dtype=np.int64),
        positions=positions,
        scales=np.full(count, scale, np.float32),
        rotations=None,
        optical_masses=np.full(count, 1e-3, np.float32),
        velocities=waves(positions).astype(np.float32),
        colors=np.full((count, 3), 0.5, np.float32),
    )


def waves(points: np.ndarray) -> np.ndarray:
    phase = np.pi * points
    return np.stack([np.sin(phase[..., 1]), np.cos(phase[..., 2]), np.sin(phase[..., 0])], axis=-1)


def inner_error(frame: ParticleFrame) -> float:
    inner = (slice(8, -8),) * 3
    wrong = voxelize(frame, LATTICE)["velocity"][inner] - waves(LATTICE.centres())[inner]
    return float(np.sqrt(np.square(wrong).mean()))


def test_gives_back_most_of_what_the_width_blurs() -> None:
    frame = vortex()
    assert inner_error(unblurred(frame)) < 0.5 * inner_error(frame)


def test_even_motion_stays_as_it_is() -> None:
    frame = dataclasses.replace(vortex(500), velocities=np.tile(np.float32([1.0, -2.0, 3.0]), (500, 1)))
    np.testing.assert_allclose(unblurred(frame).velocities, frame.velocities, atol=1e-5)


def test_nothing_but_velocities_changes() -> None:
    frame = vortex(200)
    found = unblurred(frame)
    assert all(
        np.array_equal(getattr(found, field.name), getattr(frame, field.name))
        for field in dataclasses.fields(frame)
        if field.name not in ("velocities", "rotations")
    )
    assert found.velocities.dtype == np.float32


@pytest.mark.parametrize("far", [1e3, 1e15])
def test_smoke_that_is_spread_too_wide_is_left_alone(far: float) -> None:
    frame = vortex(100)
    positions = frame.positions.copy()
    positions[0] = far
    positions[1] = -far
    spread = dataclasses.replace(frame, positions=positions)
    assert unblurred(spread) is spread


def test_no_particles() -> None:
    frame = vortex(0)
    assert unblurred(frame) is frame


def test_beyond_is_what_is_next_to_it_and_inside_nothing_changes() -> None:
    density = np.zeros((17, 9, 30), np.float32)
    density[:4], density[-4:] = 1.0, 2.0
    velocity = np.zeros((*density.shape, 3), np.float32)
    velocity[:4], velocity[-4:] = (1.0, 0.0, 0.0), (0.0, -1.0, 3.0)
    found = beyond(density, velocity)
    np.testing.assert_allclose(found[density > 0], velocity[density > 0], atol=0.01)
    assert (found[4, ..., 0] > 0.6).all() and (found[-5, ..., 1] < -0.6).all()
    assert (found[..., 0] <= 1.0).all() and (found[..., 2] >= 0.0).all() and (found[..., 2] <= 3.0).all()


def test_beyond_one_voxel_of_smoke_all_moves_with_it() -> None:
    density = np.zeros((5, 6, 7), np.float32)
    velocity = np.zeros((5, 6, 7, 3), np.float32)
    density[2, 3, 1], velocity[2, 3, 1] = 1e-6, (1.0, 2.0, 3.0)
    np.testing.assert_allclose(beyond(density, velocity), np.broadcast_to([1.0, 2.0, 3.0], velocity.shape), rtol=1e-3)


@pytest.mark.parametrize("shape", [(0, 0, 0), (1, 1, 1), (3, 1, 2)])
def test_no_smoke_does_not_move(shape: tuple[int, int, int]) -> None:
    assert not beyond(np.zeros(shape, np.float32), np.zeros((*shape, 3), np.float32)).any()
