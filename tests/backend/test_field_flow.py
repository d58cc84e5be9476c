"""The fluid on a grid: projection exact, transport conservative and of second order, buoyant rise, threads."""

from __future__ import annotations

import numba
import numpy as np
import pytest

from backend.field import flow
from backend.geometry.lattice import Lattice


def box(count: int = 24, *, size: float = 2.4) -> Lattice:
    return Lattice(origin=(0.0, 0.0, 0.0), voxel_size=size / count, shape=(count, count, count))


def random_air(lattice: Lattice, *, seed: int = 0) -> flow.Air:
    random = np.random.default_rng(seed)
    still = flow.uniform_air(lattice)
    return flow.Air(**{name: random.normal(size=getattr(still, name).shape).astype(np.float32) for name in "uvw"})


@pytest.mark.parametrize("has_floor", [False, True])
def test_projection_leaves_no_divergence_and_does_nothing_twice(has_floor: bool) -> None:
    lattice = Lattice(origin=(0.0, 0.0, 0.0), voxel_size=0.3, shape=(12, 9, 14))
    air = random_air(lattice)
    once = flow.projected(air, lattice, has_floor=has_floor)
    twice = flow.projected(once, lattice, has_floor=has_floor)
    assert np.abs(flow.divergence(once, lattice)).max() < 1e-5 * np.abs(flow.divergence(air, lattice)).max()
    for name in "uvw":
        assert np.abs(getattr(once, name) - getattr(twice, name)).max() < 1e-5
    assert not has_floor or not once.w[:, :, 0].any()
    # It is the nearest: what was taken away is orthogonal to what is left.
    taken = sum(float(np.vdot(getattr(air, n) - getattr(once, n), getattr(once, n))) for n in "uvw")
    left = sum(float(np.vdot(getattr(once, n), getattr(once, n))) for n in "uvw")
    assert has_floor or abs(taken) < 0.35 * left  # outer faces count half in the exact statement


def test_uniform_wind_passes_unchanged() -> None:
    lattice = box(10)
    wind = flow.uniform_air(lattice, (1.0, -0.5, 0.25))
    for air in (
        flow.projected(wind, lattice, has_floor=False),
        flow.advected(wind, lattice, seconds=0.2, outside=(1.0, -0.5, 0.25)),
    ):
        for name in "uvw":
            assert np.abs(getattr(air, name) - getattr(wind, name)).max() < 1e-5
    assert np.allclose(flow.at_centres(wind), (1.0, -0.5, 0.25))


def test_mass_is_kept_and_stays_positive() -> None:
    lattice = box()
    air = flow.projected(random_air(lattice), lattice, has_floor=True)
    amounts = np.zeros(lattice.shape, np.float32)
    amounts[9:15, 9:15, 9:15] = np.random.default_rng(1).uniform(size=(6, 6, 6))
    later = flow.transported(amounts, air, lattice, seconds=0.1)
    assert later.min() > -1e-6
    assert later.sum(dtype=np.float64) == pytest.approx(amounts.sum(dtype=np.float64), rel=1e-5)
    assert np.abs(later - amounts).max() > 0.1


def test_what_leaves_is_gone() -> None:
    lattice = box(8)
    later = flow.transported(np.ones(lattice.shape), flow.uniform_air(lattice, (1.0, 0.0, 0.0)), lattice, seconds=10.0)
    assert np.abs(later).max() < 1e-3


def test_several_things_drift_alike() -> None:
    lattice = box(8)
    air = random_air(lattice)
    one, other = np.random.default_rng(2).uniform(size=(2, 8, 8, 8)).astype(np.float32)
    both = flow.transported(np.stack([one, other]), air, lattice, seconds=0.05)
    assert np.array_equal(both[0], flow.transported(one, air, lattice, seconds=0.05))
    assert np.array_equal(both[1], flow.transported(other, air, lattice, seconds=0.05))


def drifted_error(count: int) -> float:
    """Mean error of a ball that a slanting wind carries by a third of the box."""
    lattice = box(count)
    velocity, seconds = np.array([0.9, 0.6, 0.3]), 0.8

    def ball(middle: np.ndarray) -> np.ndarray:
        return np.exp(-0.5 * ((lattice.centres() - middle) ** 2).sum(-1) / 0.3**2)

    begin = np.array([0.8, 0.9, 1.0])
    found = flow.transported(ball(begin), flow.uniform_air(lattice, tuple(velocity)), lattice, seconds=seconds)
    return float(np.abs(found - ball(begin + seconds * velocity)).mean())


def test_transport_is_nearly_of_second_order() -> None:
    """The limiter takes the peak for an extremum and flattens it a little, which keeps the order below 2."""
    order = np.log2(drifted_error(24) / drifted_error(48))
    assert 1.45 < order < 2.2


def test_air_carries_itself_to_where_it_goes() -> None:
    """A gust of 1 % in a strong wind moves with the wind."""
    lattice = box(48)
    wind = flow.uniform_air(lattice, (1.0, 0.0, 0.0))
    x = lattice.voxel_size * (np.arange(49))[:, None, None]
    gust = 0.01 * np.exp(-0.5 * ((x - 0.9) / 0.25) ** 2) * np.ones((49, 48, 48))
    air = flow.Air(u=(wind.u + gust).astype(np.float32), v=wind.v, w=wind.w)
    for _ in range(6):
        air = flow.advected(air, lattice, seconds=0.1, outside=(1.0, 0.0, 0.0))
    middle = float(((air.u[:, 24, 24] - 1.0) * x[:, 0, 0]).sum() / (air.u[:, 24, 24] - 1.0).sum())
    assert middle == pytest.approx(0.9 + 0.6, abs=0.02)
    assert (air.u - 1.0).max() > 0.009


def test_a_hot_ball_rises_and_pulls_air_in() -> None:
    lattice = box()
    heat = np.exp(-0.5 * ((lattice.centres() - (1.2, 1.2, 0.7)) ** 2).sum(-1) / 0.2**2).astype(np.float32)
    air, up = flow.uniform_air(lattice), np.zeros((*lattice.shape, 3), np.float32)
    for _ in range(10):
        up[..., 2] = 3.0 * heat
        air = flow.projected(flow.pushed(air, 0.05 * up), lattice, has_floor=True)
        heat = flow.transported(heat, air, lattice, seconds=0.05)
        air = flow.projected(flow.advected(air, lattice, seconds=0.05), lattice, has_floor=True)
    height = (heat.sum((0, 1)) * lattice.axes()[2]).sum() / heat.sum()
    assert 0.75 < height < 1.2
    beside = air.u[8, 12, :]  # left of the ball: inwards below it, outwards above
    below, above = lattice.axes()[2] < height - 0.2, lattice.axes()[2] > height + 0.25
    assert beside[below].mean() > 0.0 > beside[above][:6].mean()


def test_equal_bytes_for_any_number_of_threads() -> None:
    lattice = box(16)
    air, amounts = random_air(lattice), np.random.default_rng(4).uniform(size=lattice.shape)
    kept = numba.get_num_threads()
    answers = []
    try:
        for threads in (1, kept):
            numba.set_num_threads(threads)
            moved = flow.projected(flow.advected(air, lattice, seconds=0.05), lattice, has_floor=True)
            answers.append(
                (flow.transported(amounts, moved, lattice, seconds=0.05).tobytes(), moved.u.tobytes(), moved.w.tobytes())
            )
    finally:
        numba.set_num_threads(kept)
    assert answers[0] == answers[1]
