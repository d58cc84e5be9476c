"""Gaussians on a grid: against slow loops, with the optical mass kept, equal bytes for any number of threads."""

from __future__ import annotations

import dataclasses
import math

import numba
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.ndimage import map_coordinates

from backend.geometry.lattice import Lattice
from backend.io.particles import ParticleFrame
from backend.render.voxelize import CUTOFF, MIN_SCALE_VOXELS, rotation_matrices, splat_extents, voxelize


def particles(
    positions: np.ndarray,
    scales: np.ndarray | float,
    *,
    masses: np.ndarray | None = None,
    rotations: np.ndarray | None = None,
    seed: int = 0,
) -> ParticleFrame:
    positions = np.atleast_2d(np.asarray(positions, np.float64))
    n, chance = len(positions), np.random.default_rng(seed)
    scales = np.asarray(scales, np.float32)
    if scales.ndim == 0:
        scales = np.full(n, scales, np.float32)
    return ParticleFrame(
        positions=positions,
        velocities=chance.normal(size=(n, 3)).astype(np.float32),
        scales=scales,
        optical_masses=np.asarray(chance.random(n) + 0.1 if masses is None else masses, np.float32),
        colors=chance.random((n, 3)).astype(np.float32),
        ids=np.arange(n),
        rotations=rotations,
    )


def drawn_scale(scale: float) -> float:
    """In voxels: narrowed by what linear interpolation widens it, but not below MIN_SCALE_VOXELS."""
    return math.sqrt(max(scale**2 - 1 / 6, MIN_SCALE_VOXELS**2))


def reference(frame: ParticleFrame, lattice: Lattice) -> dict[str, np.ndarray]:
    """Loops over particles and voxels in float64, weights summed over a lattice that nothing is cut off by."""
    h, shape = lattice.voxel_size, lattice.shape
    density, velocity, color = np.zeros(shape), np.zeros((*shape, 3)), np.zeros((*shape, 3))
    turns = rotation_matrices(frame.rotations, frame.count)
    for p in range(frame.count):
        center = (frame.positions[p] - np.array(lattice.origin)) / h
        axes = np.array([drawn_scale(float(scale) / h) for scale in np.broadcast_to(frame.scales[p], 3)])
        covariance = turns[p] @ np.diag(axes**2) @ turns[p].T
        precision, half = np.linalg.inv(covariance), CUTOFF * np.sqrt(np.diag(covariance))
        ranges = [range(math.ceil(c - w), math.floor(c + w) + 1) for c, w in zip(center, half, strict=True)]
        weights = {}
        for i in ranges[0]:
            for j in ranges[1]:
                for k in ranges[2]:
                    d = np.array([i, j, k]) - center
                    squared = d @ precision @ d
                    if frame.rotations is None or squared <= CUTOFF**2:
                        weights[i, j, k] = math.exp(-0.5 * squared)
        total = sum(weights.values())
        for voxel, weight in weights.items():
            if all(0 <= v < n for v, n in zip(voxel, shape, strict=True)):
                share = frame.optical_masses[p] * weight / total / h**3
                density[voxel] += share
                velocity[voxel] += share * frame.velocities[p]
                color[voxel] += share * frame.colors[p]
    safe = np.where(density > 0, density, 1.0)[..., None]
    return {"density": density, "velocity": velocity / safe, "color": color / safe}


def cube(n: int, h: float = 1.0, origin: float = 0.0) -> Lattice:
    return Lattice(origin=(origin,) * 3, voxel_size=h, shape=(n, n, n))


@pytest.mark.parametrize("is_anisotropic", [False, True])
def test_equals_the_slow_loops(is_anisotropic: bool) -> None:
    chance = np.random.default_rng(3)
    n = 14
    scales = chance.uniform(0.02, 0.3, (n, 3) if is_anisotropic else n)  # 0.2 to 3 voxels
    rotations = chance.normal(size=(n, 4)).astype(np.float32) if is_anisotropic else None
    frame = particles(chance.uniform(-0.2, 1.4, (n, 3)), scales, rotations=rotations)  # some reach beyond the grid
    lattice = Lattice(origin=(0.03, -0.02, 0.01), voxel_size=0.1, shape=(11, 13, 12))
    found, expected = voxelize(frame, lattice, with_color=True), reference(frame, lattice)
    np.testing.assert_allclose(found["density"], expected["density"], rtol=2e-5, atol=1e-5)
    solid = expected["density"] > 1e-3
    assert solid.sum() > 300
    for name in ("velocity", "color"):
        np.testing.assert_allclose(found[name][solid], expected[name][solid], rtol=1e-4, atol=1e-4)


def test_one_particle_by_hand() -> None:
    """Drawn with 2.1 voxels; at the centre m over the cube of 1 + 2 (e^-1/8.82 + e^-4/8.82 + ... + e^-36/8.82)."""
    scale = math.sqrt(2.1**2 + 1 / 6)
    grid = voxelize(particles([[10.0, 10.0, 10.0]], scale, masses=np.array([5.0])), cube(21))["density"]
    peak = 5.0 / (1 + 2 * sum(math.exp(-v * v / 8.82) for v in range(1, 7))) ** 3
    assert peak == pytest.approx(5.0 / ((2 * math.pi) ** 1.5 * 2.1**3), rel=0.01)
    assert grid[10, 10, 10] == pytest.approx(peak, rel=1e-5)
    assert grid[12, 10, 10] == pytest.approx(peak * math.exp(-4 / 8.82), rel=1e-5)
    assert np.unravel_index(grid.argmax(), grid.shape) == (10, 10, 10)


@given(st.floats(-4, 2.3), st.floats(-3, 3), st.tuples(*[st.floats(-0.5, 0.5)] * 3), st.booleans())
@settings(max_examples=60, deadline=None)
def test_the_optical_mass_is_kept(log_scale: float, log_voxel: float, shift: tuple[float, ...], is_anisotropic: bool) -> None:
    """From a fiftieth of a voxel to ten voxels wide, wherever between the voxels, in any unit of length."""
    h, axes = math.exp(log_voxel), math.exp(log_scale) * np.array([1.0, 0.5, 0.25])
    scales = (axes * h)[None] if is_anisotropic else np.array([axes[0] * h])
    rotations = np.array([[0.9, 0.1, -0.3, 0.2]], np.float32) if is_anisotropic else None
    position = (40.0 + np.array([shift])) * h
    frame = particles(position, scales, masses=np.array([2.5]), rotations=rotations)
    grid = voxelize(frame, cube(81, h))["density"]
    assert float(grid.sum(dtype=np.float64)) * h**3 == pytest.approx(2.5, rel=1e-4)


def test_wide_particles_keep_their_mass_too() -> None:
    """Beyond 64 voxels (8 where anisotropic) an integral stands in for the sum over the lattice."""
    row = voxelize(
        particles([[0.3, 0.0, 0.0]], 64.5, masses=np.ones(1)),
        Lattice(origin=(-200.0, 0.0, 0.0), voxel_size=1.0, shape=(401, 1, 1)),
    )
    share = (
        1.0 / (math.sqrt(2 * math.pi) * drawn_scale(64.5) * math.erf(3 / math.sqrt(2))) ** 2
    )  # of the one row through the centre
    assert float(row["density"].sum(dtype=np.float64)) == pytest.approx(share, rel=1e-3)
    scales, turn = np.array([[9.0, 10.0, 12.0]]), np.array([[0.9, 0.1, -0.3, 0.2]], np.float32)
    grid = voxelize(particles([[40.3, 40.1, 39.8]], scales, masses=np.ones(1), rotations=turn), cube(81))["density"]
    assert float(grid.sum(dtype=np.float64)) == pytest.approx(1.0, rel=1e-3)


@pytest.mark.parametrize(("scale", "error"), [(0.8, 0.36), (1.25, 0.13), (3.0, 0.035)])
def test_seen_through_linear_interpolation_it_is_the_projected_gaussian(scale: float, error: float) -> None:
    """tau = m / (2 pi s^2) exp(-r^2 / 2 s^2), the pixel model of docs/method.md, along rays through the interpolated grid."""
    frame = particles([[20.2, 20.0, 19.7]], scale, masses=np.array([1.0]))
    grid = voxelize(frame, cube(41))["density"].astype(np.float64)
    fine = np.linspace(20.0 - 5 * scale, 20.0 + 5 * scale, 201)
    x, y = np.meshgrid(fine, fine, indexing="ij")
    found = map_coordinates(grid.sum(axis=2), [x, y], order=1)
    expected = np.exp(-((x - 20.2) ** 2 + (y - 20.0) ** 2) / (2 * scale**2)) / (2 * math.pi * scale**2)
    np.testing.assert_allclose(found, expected, atol=error * expected.max())
    variance = float((found * (x - 20.2) ** 2).sum() / found.sum())
    assert variance == pytest.approx(scale**2, rel=0.04)  # what lies beyond the cutoff is 2.7 % of it


def test_equal_axes_do_not_care_about_rotation() -> None:
    turned = particles([[8.2, 7.9, 8.4]], np.full((1, 3), 1.5), masses=np.ones(1), rotations=np.array([[0.3, 0.5, -0.2, 0.8]]))
    still = particles([[8.2, 7.9, 8.4]], np.full((1, 3), 1.5), masses=np.ones(1), rotations=np.array([[1.0, 0, 0, 0]]))
    np.testing.assert_allclose(voxelize(turned, cube(17))["density"], voxelize(still, cube(17))["density"], atol=1e-7)


def test_a_rotation_turns_the_long_axis_where_it_says() -> None:
    """90 degrees about z takes x to y: the particle is long along y."""
    quarter = np.array([[math.sqrt(0.5), 0.0, 0.0, math.sqrt(0.5)]])
    frame = particles([[15.0, 15.0, 15.0]], np.array([[4.0, 1.0, 1.0]]), rotations=quarter)
    grid = voxelize(frame, cube(31))["density"]
    np.testing.assert_allclose(
        splat_extents(frame, 1.0), [[3 * math.sqrt(5 / 6), 3 * math.sqrt(16 - 1 / 6), 3 * math.sqrt(5 / 6)]], atol=1e-6
    )
    assert grid[15, 20, 15] > 100 * grid[20, 15, 15]


def test_a_shift_by_whole_voxels_shifts_the_grid() -> None:
    chance = np.random.default_rng(4)
    frame = particles(chance.uniform(6, 10, (30, 3)), chance.uniform(0.3, 1.5, 30))
    moved = dataclasses.replace(frame, positions=frame.positions + np.array([4.0, -1.0, 2.0]))
    a, b = voxelize(frame, cube(24))["density"], voxelize(moved, cube(24))["density"]
    np.testing.assert_allclose(b, np.roll(a, (4, -1, 2), axis=(0, 1, 2)), rtol=1e-5, atol=1e-7)


def test_velocity_and_colour_are_means_of_what_is_there() -> None:
    chance = np.random.default_rng(5)
    frame = particles(chance.uniform(4, 12, (50, 3)), 1.0)
    same = dataclasses.replace(frame, velocities=np.tile(np.float32([1.0, -2.0, 3.0]), (50, 1)))
    grids = voxelize(same, cube(17), with_color=True)
    filled = grids["density"] > 0
    np.testing.assert_allclose(grids["velocity"][filled], np.tile([1.0, -2.0, 3.0], (filled.sum(), 1)), rtol=1e-5)
    assert not grids["velocity"][~filled].any()
    assert grids["color"].max() <= frame.colors.max() * (1 + 1e-5)
    assert "color" not in voxelize(same, cube(17))


@pytest.mark.parametrize("is_anisotropic", [False, True])
def test_any_number_of_threads_gives_equal_bytes(is_anisotropic: bool) -> None:
    chance = np.random.default_rng(6)
    rotations = chance.normal(size=(2000, 4)) if is_anisotropic else None
    scales = chance.uniform(0.3, 2, (2000, 3) if is_anisotropic else 2000)
    frame = particles(chance.uniform(0, 40, (2000, 3)), scales, rotations=rotations)
    threads = numba.get_num_threads()
    try:
        results = []
        for count in sorted({1, min(2, threads), threads}):
            numba.set_num_threads(count)
            results.append({name: grid.tobytes() for name, grid in voxelize(frame, cube(41), with_color=True).items()})
    finally:
        numba.set_num_threads(threads)
    assert all(result == results[0] for result in results)


@pytest.mark.parametrize("is_anisotropic", [False, True])
def test_extremes(is_anisotropic: bool) -> None:
    def frame(position: float, scale: float, count: int = 1) -> ParticleFrame:
        scales = np.full((count, 3) if is_anisotropic else count, scale)
        turns = np.tile([1.0, 0, 0, 0], (count, 1)) if is_anisotropic else None
        return particles(np.full((count, 3), position), scales, masses=np.ones(count), rotations=turns)

    for empty in (
        voxelize(frame(0.0, 1.0, 0), cube(5)),
        voxelize(frame(1e15, 1.0), cube(5)),
        voxelize(frame(-1e15, 1.0), cube(5)),
    ):
        assert not empty["density"].any()
    assert voxelize(frame(0.0, 1.0), cube(0))["density"].shape == (0, 0, 0)
    pile = voxelize(frame(8.5, 1.0, 20_000), cube(18))["density"]
    assert float(pile.sum(dtype=np.float64)) == pytest.approx(20_000, rel=1e-3)
    sharp = voxelize(frame(8.0, 1e-30), cube(17))["density"]
    assert float(sharp.sum(dtype=np.float64)) == pytest.approx(1.0, rel=1e-5)
    fog = voxelize(frame(8.0, 1e6), cube(17))["density"]  # far wider than the grid: nearly even, and almost all of it outside
    assert fog.min() == pytest.approx(fog.max(), rel=1e-6)
    assert fog.max() == pytest.approx(1.0 / ((2 * math.pi) ** 1.5 * 1e18), rel=0.03)


def test_what_is_not_finite_is_refused() -> None:
    frame = particles([[1.0, 2.0, 3.0]], 1.0)
    for change in (
        {"positions": np.full((1, 3), np.nan)},
        {"velocities": np.full((1, 3), np.inf)},
        {"scales": np.array([np.nan])},
    ):
        with pytest.raises(ValueError, match="NaN or infinity"):
            voxelize(dataclasses.replace(frame, **change), cube(5))
    with pytest.raises(ValueError, match="rotation"):
        voxelize(dataclasses.replace(frame, scales=np.ones((1, 3)), rotations=np.zeros((1, 4))), cube(5))
    with pytest.raises(ValueError, match="lattice"):
        voxelize(frame, cube(5, h=0.0))
